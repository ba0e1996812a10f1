"""Imitation before PPO: an actor that sees late learns from what it was when it saw the present state.

While the critic learns alone, the actor repeats what the policy that it began from would do in the
present state, in the states that it comes to itself (DAgger, Ross et al. 2011).
"""

from copy import deepcopy

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from vd.train.ppo import OBSERVED, TeacherPPO
from vd.train.vec_env import OBSERVATION_GROUP, PRIVILEGED_GROUP

LEARNING_RATE = 1e-3
"""The actor's rate at the begin; it falls to zero."""
IMITATED = "imitated_state_dict"
"""What a checkpoint calls the weights of the policy that is being imitated."""


class Imitation:
    """Lets the actor of a learner imitate itself as it is now.

    rsl-rl's Distillation has a loop and a storage of its own and no critic; its loss is repeated
    here. Adam begins fresh, and that of PPO sees none of these gradients. The last that the
    learner's critic is told is what the actor observes, of the present state.

    Attributes:
        teacher: The policy to imitate.
    """

    def __init__(self, learner: TeacherPPO) -> None:
        self._learner = learner
        self.teacher: MLPModel = deepcopy(learner.actor).requires_grad_(False)
        if hasattr(
            self.teacher.distribution, "log_floor"
        ):  # it falls for both as stillness tightens
            self.teacher.distribution.log_floor = learner.actor.distribution.log_floor
        self._optimizer = torch.optim.Adam(learner.actor.parameters())

    def update(self, left: float) -> dict[str, float]:
        """All epochs over the learner's latest rollout, at ``left``, from 1 to 0, of the rate.

        Returns:
            ``imitation``: mean squared error of means and standard deviations of the actions.
        """
        self._optimizer.param_groups[0]["lr"] = LEARNING_RATE * left
        learner, samples = self._learner, self._learner.samples
        seen, told = samples[OBSERVED + OBSERVATION_GROUP], samples[OBSERVED + PRIVILEGED_GROUP]
        with torch.no_grad():
            wanted = _distribution(self.teacher, told[:, -seen.shape[1] :])
        losses = []
        for rows in learner.minibatches():
            found = _distribution(learner.actor, seen[rows])
            loss = sum(
                nn.functional.mse_loss(own, goal[rows])
                for own, goal in zip(found, wanted, strict=True)
            )
            self._optimizer.zero_grad()
            loss.backward()
            if learner.is_multi_gpu:
                learner.reduce_parameters()
            nn.utils.clip_grad_norm_(learner.actor.parameters(), learner.max_grad_norm)
            self._optimizer.step()
            losses.append(loss.detach())
        learner.actor.distribution._distribution = self.teacher.distribution._distribution = None
        return {"imitation": float(torch.stack(losses).mean())}


def _distribution(actor: MLPModel, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and standard deviations of the actions for observed values [M, O], shape [M, D] each."""
    observed = TensorDict({OBSERVATION_GROUP: values}, batch_size=[len(values)])
    actor.distribution.update(actor.mlp(actor.get_latent(observed)))
    return actor.output_mean, actor.output_std
