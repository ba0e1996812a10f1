"""Proximal policy optimisation as the paper runs it, on top of rsl-rl's."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import nn

from vd.train.config import PolicyCfg, PpoCfg, minibatches
from vd.train.distribution import BoundedStdGaussian, FreeStdGaussian
from vd.train.graphed import Recorded
from vd.train.vec_env import ReorientVecEnv

MIN_LEARNING_RATE, MAX_LEARNING_RATE = 1e-5, 1e-2
"""Bounds of the adaptive schedule, as in rsl-rl."""
KL_STEP = 1.5
"""Factor by which the adaptive schedule changes the actor's learning rate, once an update."""
KL_BAND = 2.0
"""The rate is left alone while the KL divergence is within this factor of the wanted one."""
RUNAWAY_KL = 4.0
"""An update ends with the epoch whose KL divergence passes this many times the wanted one (ours):
the rate is lowered from twice on, and takes three updates for as much; an update that diverged by
13 undid a training.
"""

ACTION_BOUND = 1.0
"""The environment clips actions to this; a mean beyond it changes nothing but how far it is to come
back.
"""
STATISTICS = ("surrogate", "value", "entropy", "kl", "clip_fraction", "beyond_bound", "grad_norm")
"""What every minibatch reports."""
OBSERVED = "observed "
"""How the names of samples begin that are observations, before that of their group."""
ACTOR_GROUP, CRITIC_GROUP = 0, 1
"""Optimiser groups. rsl-rl reads the learning rate it reports from group 0, so the actor is
first.
"""


class TeacherPPO(PPO):
    """PPO with two learning rates, an unclipped value loss and one gradient norm for both networks.

    What differs from rsl-rl's PPO, and why:

    * actor and critic have their own learning rates (Table S1: 3e-4 and 1e-3) in one optimiser.
      rsl-rl's adaptive schedule writes one rate into every group; here it moves the actor's only,
      since the KL divergence it follows says nothing about the critic. It moves once an update, by
      the divergence of the last epoch: rsl-rl moves it in every minibatch, and since the divergence
      within an update only accumulates, one large first step there sends the rate to its lower
      bound for the rest of it. An update that runs away (:data:`RUNAWAY_KL`) ends early;
    * the gradient is clipped by the joint norm of actor and critic, as in the paper's code. The
      value coefficient acts through that norm alone, because Adam ignores the scale of a gradient;
    * samples are permuted in every epoch (rsl-rl repeats the same minibatches), and statistics stay
      on the device until the end of the update (rsl-rl waits for the device after each minibatch);
    * forward and backward pass of a minibatch can be a CUDA graph (:mod:`vd.train.graphed`).
      Outside stay what several GPUs exchange, and the optimiser's step: its rates are numbers that
      change, and its state is that of any checkpoint.

    Time-outs: rsl-rl adds ``gamma * V(s_t)`` to the reward of a step that timed out and treats it
    as terminal. The value belongs to the stored observation *before* the step, because the
    observation returned after it is already the new episode's. That stands in for ``V(s_{t+1})`` of
    the state that was cut off, one control step later: a small error in one step of an episode, and
    no bias towards zero.

    Attributes:
        actor_learns: Whether updates change the actor. A critic that knows nothing yet gives random
            advantages, which would unlearn an actor that has learned; so it learns alone first. The
            actor's gradients go through Adam meanwhile, at a rate of zero: its first step then has
            moments to go by. One without would move every weight by the whole rate, whatever its
            gradient.
        samples: The latest rollout as rows, by name; observations begin with :data:`OBSERVED`.
    """

    optimizer: Any
    learning_rate: float

    def __init__(
        self,
        actor: MLPModel,
        critic: MLPModel,
        storage: RolloutStorage,
        cfg: PpoCfg,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            actor,
            critic,
            storage,
            num_learning_epochs=cfg.epochs,
            num_mini_batches=minibatches(cfg, storage.num_envs),
            learning_rate=cfg.actor_learning_rate,
            schedule=cfg.schedule,
            desired_kl=cfg.desired_kl,
            clip_param=cfg.clip,
            gamma=cfg.gamma,
            lam=cfg.gae_lambda,
            value_loss_coef=cfg.value_coefficient,
            entropy_coef=cfg.entropy_coefficient,
            max_grad_norm=cfg.grad_norm,
            **kwargs,
        )
        self.bound_coef = cfg.bound_coefficient
        self.actor_learns = True
        self._parameters = [*self.actor.parameters(), *self.critic.parameters()]
        # The rollout as rows of samples, in the same memory in every update, and the rows of a
        # minibatch.
        self.samples: dict[str, torch.Tensor] = {}
        self._rows = torch.zeros(self._minibatch_size, dtype=torch.long, device=self.device)
        self._gradients: Callable[[], torch.Tensor] = self._compute_gradients
        if cfg.cuda_graph and self.device.startswith("cuda"):
            self._gradients = Recorded(self._compute_gradients, self._parameters)
        self.optimizer = torch.optim.Adam(
            [
                {"params": list(self.actor.parameters()), "lr": cfg.actor_learning_rate},
                {"params": list(self.critic.parameters()), "lr": cfg.critic_learning_rate},
            ]
        )

    @property
    def critic_learning_rate(self) -> float:
        """The critic's learning rate."""
        return self.optimizer.param_groups[CRITIC_GROUP]["lr"]

    def set_learning_rates(self, actor: float, critic: float) -> None:
        """Go on with these rates; a checkpoint brings those it was saved with."""
        self.learning_rate = actor
        self.optimizer.param_groups[ACTOR_GROUP]["lr"] = actor
        self.optimizer.param_groups[CRITIC_GROUP]["lr"] = critic

    def update(self) -> dict[str, float]:
        """Run all epochs over the rollout, or those until the actor runs away.

        Returns:
            Means over the minibatches that were run: ``surrogate``, ``value``, ``entropy``, ``kl``
            (old to new policy), ``clip_fraction``, ``grad_norm`` (before clipping),
            ``beyond_bound`` (share of mean actions), and ``explained_variance`` of the returns by
            the values of the rollout.
        """
        group = self.optimizer.param_groups[ACTOR_GROUP]
        group["lr"] = self.learning_rate if self.actor_learns else 0.0
        self.take_samples()
        watched = self.actor_learns and self.schedule == "adaptive"
        divergence = 0.0
        steps = []
        for rows in self.minibatches():
            steps.append(self.minibatch_step(rows))
            if watched and len(steps) % self.num_mini_batches == 0:
                divergence = self._divergence(steps[-self.num_mini_batches :])
                if divergence > RUNAWAY_KL * self.desired_kl:
                    break
        group["lr"] = self.learning_rate
        if watched:
            self._adapt_learning_rate(divergence)
        if self.actor_learns:
            self._update_normalisation(self.actor)
        self._update_normalisation(self.critic)
        returns = self.storage.returns
        values = self.storage.values
        explained = 1.0 - (returns - values).var() / returns.var().clamp_min(1e-8)
        self.storage.clear()
        names = (*STATISTICS, "explained_variance")
        return dict(
            zip(
                names,
                torch.cat((torch.stack(steps).mean(dim=0), explained[None])).tolist(),
                strict=True,
            )
        )

    @property
    def _minibatch_size(self) -> int:
        storage = self.storage
        return storage.num_envs * storage.num_transitions_per_env // self.num_mini_batches

    def take_samples(self) -> None:
        """Copy the rollout into the memory that minibatches are gathered from."""
        storage = self.storage
        assert storage.distribution_params is not None, "there is no rollout"
        rollout = {
            "actions": storage.actions.flatten(0, 1),
            "log_prob": storage.actions_log_prob.flatten(),
            "advantages": storage.advantages.flatten(),
            "returns": storage.returns.flatten(),
        }
        rollout |= {
            OBSERVED + key: value.flatten(0, 1) for key, value in storage.observations.items()
        }
        rollout |= {
            f"old {i}": value.flatten(0, 1) for i, value in enumerate(storage.distribution_params)
        }
        if not self.samples:
            self.samples = {name: torch.empty_like(tensor) for name, tensor in rollout.items()}
        for name, tensor in rollout.items():
            self.samples[name].copy_(tensor)

    def minibatches(self) -> Iterator[torch.Tensor]:
        """Rows of samples, permuted anew in every epoch; a remainder is left out at random."""
        samples = self.storage.num_envs * self.storage.num_transitions_per_env
        size = self._minibatch_size
        for _ in range(self.num_learning_epochs):
            order = torch.randperm(samples, device=self.device)
            yield from order[: size * self.num_mini_batches].split(size)

    def minibatch_step(self, rows: torch.Tensor) -> torch.Tensor:
        """One optimiser step on these samples.

        Returns:
            :data:`STATISTICS`, shape [7], on the device.
        """
        self._rows.copy_(rows)
        statistics = self._gradients()
        if self.is_multi_gpu:
            self.reduce_parameters()
        grad_norm = nn.utils.clip_grad_norm_(self._parameters, self.max_grad_norm)
        self.optimizer.step()
        return torch.cat((statistics, grad_norm[None]))

    def _compute_gradients(self) -> torch.Tensor:
        """Gradients of the loss over the samples in ``_rows``; nothing else changes.

        All it reads stays where it is in memory, and nothing waits for the device: it can be
        recorded.

        Returns:
            :data:`STATISTICS` but the last, shape [6], on the device.
        """
        for parameter in self._parameters:
            parameter.grad = None
        batch = {name: tensor[self._rows] for name, tensor in self.samples.items()}
        observed = {
            name.removeprefix(OBSERVED): t for name, t in batch.items() if name.startswith(OBSERVED)
        }
        observations = TensorDict(observed, batch_size=[len(self._rows)])
        old = tuple(tensor for name, tensor in batch.items() if name.startswith("old "))
        # Without the sample that the actor's own forward pass would draw.
        self.actor.distribution.update(self.actor.mlp(self.actor.get_latent(observations)))
        log_ratio = self.actor.get_output_log_prob(batch["actions"]) - batch["log_prob"]
        entropy = self.actor.output_entropy.mean()
        with torch.no_grad():
            kl = self.actor.get_kl_divergence(old, self.actor.output_distribution_params).mean()
        ratio = torch.exp(log_ratio)
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        advantages = batch["advantages"]
        surrogate = -torch.minimum(advantages * ratio, advantages * clipped).mean()
        errors = batch["returns"] - self.critic(observations).squeeze(-1)
        value = errors.square().mean()
        excess = (self.actor.output_mean.abs() - ACTION_BOUND).clamp_min(0.0)
        loss = surrogate + self.value_loss_coef * value - self.entropy_coef * entropy
        if self.bound_coef:
            loss = loss + self.bound_coef * excess.square().sum(dim=-1).mean()

        loss.backward()
        # Or this pass would outlive itself, and a recording.
        self.actor.distribution._distribution = None
        with torch.no_grad():
            clip_fraction = ((ratio - 1.0).abs() > self.clip_param).float().mean()
            beyond = (excess > 0.0).float().mean()
            return torch.stack((surrogate, value, entropy, kl, clip_fraction, beyond)).detach()

    def _update_normalisation(self, network: MLPModel) -> None:
        """Let a network's normaliser learn from the rollout.

        Its numbers stay where they are in memory.
        """
        normaliser = network.obs_normalizer
        std = getattr(normaliser, "_std", None)
        network.update_normalization(self.storage.observations.flatten(0, 1))
        # rsl-rl makes a new tensor of it, which a recorded graph would not read.
        if std is not None:
            std.copy_(normaliser._std)
            normaliser._std = std

    def _divergence(self, epoch: list[torch.Tensor]) -> float:
        """Mean KL divergence of an epoch's minibatches; waits for the device."""
        kl = torch.stack(epoch)[:, STATISTICS.index("kl")].mean()
        if self.is_multi_gpu:
            # Every rank sees the same mean and so takes the same decision.
            torch.distributed.all_reduce(kl)
            kl = kl / self.gpu_world_size
        return float(kl)

    def _adapt_learning_rate(self, divergence: float) -> None:
        """Move the actor's learning rate towards updates whose KL divergence is ``desired_kl``."""
        if divergence > self.desired_kl * KL_BAND:
            self.learning_rate = max(MIN_LEARNING_RATE, self.learning_rate / KL_STEP)
        elif 0.0 < divergence < self.desired_kl / KL_BAND:
            self.learning_rate = min(MAX_LEARNING_RATE, self.learning_rate * KL_STEP)
        self.optimizer.param_groups[ACTOR_GROUP]["lr"] = self.learning_rate


def make_learner(
    env: ReorientVecEnv, ppo: PpoCfg, policy: PolicyCfg, *, rank: int, world_size: int
) -> TeacherPPO:
    """A learner with new networks, on the environment's device.

    The actor reads the first group of observations, the critic all.
    """
    observations = env.get_observations()
    device = env.device
    groups = list(observations.keys())
    distribution: dict[str, Any] = {"init_std": policy.initial_std, "std_range": policy.std_range}
    if policy.distribution == "gaussian":
        distribution |= {"class_name": FreeStdGaussian, "std_type": "log"}
    else:
        distribution |= {"class_name": BoundedStdGaussian}
    shape: dict[str, Any] = {
        "hidden_dims": policy.hidden,
        "activation": "elu",  # as of vd.policy.actor.perceptron
        "obs_normalization": policy.normalise_observations,
    }
    return TeacherPPO(
        MLPModel(
            observations,
            {"actor": groups[:1]},
            "actor",
            env.num_actions,
            distribution_cfg=distribution,
            **shape,
        ),
        MLPModel(observations, {"critic": groups}, "critic", 1, **shape),
        RolloutStorage(
            "rl", env.num_envs, ppo.rollout_steps, observations, [env.num_actions], device
        ),
        ppo,
        device=device,
        multi_gpu_cfg={"global_rank": rank, "world_size": world_size} if world_size > 1 else None,
    )
