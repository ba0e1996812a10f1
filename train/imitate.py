"""Imitation before PPO: an actor that sees late learns from what it was when it saw the present state.

While the critic learns alone, the actor repeats what the policy that it began from would do in the present
state, in the states that it comes to itself (DAgger, Ross et al. 2011).
"""

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from vd.train.config import PpoCfg
from vd.train.ppo import OBSERVED, TeacherPPO
from vd.train.vec_env import OBSERVATION_GROUP, PRIVILEGED_GROUP

LEARNING_RATE = 1e-3
"""The actor's rate at the begin; it falls to zero."""
IMITATED = "imitated_state_dict"
"""What a checkpoint calls the weights of the policy that is being imitated."""


class Imitation:
    """Lets the actor of a learner imitate itself as it is now.

    rsl-rl's Distillation has a loop and a storage of its own and no critic; its loss is repeated here. Adam
    begins fresh, and that of PPO sees none of these gradients.

    Args:
        learner: The learner, whose actor has the weights of the policy to imitate.
        inputs: Values that this policy read, the first that the actor observes. As many of the present state
            are the last that the critic is told.

    Attributes:
        teacher: The policy to imitate. It gets what the actor observes with the present state in its place;
            it has no weights for what the actor observes more.
    """

    def __init__(self, learner: TeacherPPO, inputs: int) -> None:
        self._learner, self._inputs = learner, inputs
        self.teacher: MLPModel = deepcopy(learner.actor).requires_grad_(False)
        if hasattr(self.teacher.distribution, "log_floor"):  # it falls for both as stillness tightens
            self.teacher.distribution.log_floor = learner.actor.distribution.log_floor
        self._optimizer = torch.optim.Adam(learner.actor.parameters())

    def update(self, left: float) -> dict[str, float]:
        """All epochs over the learner's latest rollout.

        Args:
            left: Share of the imitation that is left, of the rate too.

        Returns:
            ``imitation``: mean squared error of means and standard deviations of the actions.
        """
        self._optimizer.param_groups[0]["lr"] = LEARNING_RATE * left
        learner, samples = self._learner, self._learner.samples
        seen, told = samples[OBSERVED + OBSERVATION_GROUP], samples[OBSERVED + PRIVILEGED_GROUP]
        present = torch.cat((told[:, -self._inputs :], seen[:, self._inputs :]), dim=1)
        with torch.no_grad():
            wanted = _distribution(self.teacher, present)
        losses = []
        for rows in learner.minibatches():
            found = _distribution(learner.actor, seen[rows])
            loss = sum(
                nn.functional.mse_loss(own, goal[rows]) for own, goal in zip(found, wanted, strict=True)
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


def begin_imitation(
    learner: TeacherPPO, ppo: PpoCfg, present: int, state: Mapping[str, Any], path: str | Path
) -> Imitation | None:
    """What the actor of a run does first that begins from another; None: it stays as it is.

    Args:
        learner: The learner, whose actor has the weights of the file.
        ppo: Settings.
        present: Values of the present that the critic is told last.
        state: The file that the run begins from.
        path: Its name.

    Raises:
        ValueError: The policy reads other things than those.
    """
    read = state["policy"]["num_observations"]
    if ppo.imitation_iterations and present != read:
        raise ValueError(
            f"--ppo.imitation-iterations: {path} reads {read} values, and the critic is told {present} of "
            "the present; give --env.observation.dynamics critic, and --init a policy of state and shape"
        )
    return Imitation(learner, present) if ppo.imitation_iterations else None


def _distribution(actor: MLPModel, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and standard deviations of the actions for observed values [M, O], shape [M, D] each."""
    observed = TensorDict({OBSERVATION_GROUP: values}, batch_size=[len(values)])
    actor.distribution.update(actor.mlp(actor.get_latent(observed)))
    return actor.output_mean, actor.output_std
