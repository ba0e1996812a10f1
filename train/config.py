"""Settings of the learner: PPO, the networks and the run. Pure data, cheap to import.

Defaults are the paper's (Table S1), or its released code's where the paper says nothing.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from vd.config import Renamed
from vd.paper import PAPER

ACTIVATION = "elu"
"""Activation of the hidden layers, as in the paper (MLP 512-256-256 ELU)."""


@dataclass
class PpoCfg:
    """Proximal policy optimisation."""

    rollout_steps: int = PAPER.teacher.rollout_steps
    """Control steps of every world between two updates."""
    minibatch_size: int = PAPER.teacher.minibatch_size
    """Samples of an optimiser step on one GPU (at most environments x rollout steps)."""
    epochs: int = PAPER.teacher.epochs
    """Passes over a rollout."""
    actor_learning_rate: float = PAPER.teacher.actor_learning_rate
    """Actor's learning rate; the start of it with --ppo.schedule adaptive."""
    critic_learning_rate: float = PAPER.teacher.critic_learning_rate
    """Critic's learning rate, never adapted."""
    schedule: Literal["fixed", "adaptive"] = "fixed"
    """adaptive: the actor's rate follows the KL divergence of its updates."""
    desired_kl: float = 0.01
    """KL divergence that the adaptive schedule aims at."""
    clip: float = PAPER.teacher.clip
    """Bound of the probability ratio's distance from 1."""
    gamma: float = PAPER.teacher.gamma
    """Discount per control step."""
    gae_lambda: float = PAPER.teacher.gae_lambda
    """Decay of the generalised advantage estimate."""
    value_coefficient: float = PAPER.teacher.value_coefficient_code
    """Weight of the value loss; acts through the joint gradient norm only."""
    entropy_coefficient: float = 0.0
    """Weight of the entropy bonus."""
    bound_coefficient: float = 0.0
    """Weight of the squared excess of mean actions beyond [-1, 1], where the environment clips them."""
    grad_norm: float = PAPER.teacher.grad_norm_code
    """Joint gradient norm of actor and critic is clipped to this."""
    optimizer: Literal["adam", "adamw"] = "adam"
    """Optimiser: the paper says Adam, its code uses AdamW."""
    cuda_graph: bool = False
    """Record forward and backward pass of a minibatch once as a CUDA graph, and replay it: where launching
    some hundred kernels takes longer than running them, as on busy processors. On one GPU; else ignored."""
    critic_warmup_iterations: int | None = None
    """Iterations at the begin of a run in which the critic learns alone; the actor acts and stays as it is.
    None: as many as what --init begins from needs, 50 without a critic, 3 without an optimiser, else 0."""

    imitation_iterations: int = 0
    """Iterations after --init in which the actor imitates, in what it does itself, the policy that it began
    from, which sees the present state and shape (--env.observation.dynamics); the critic learns alone."""
    imitation_learning_rate: float = 1e-3
    """The actor's rate at the begin of that; it falls to zero."""


@dataclass
class PolicyCfg:
    """Networks of actor and critic."""

    RETIRED: ClassVar[dict[str, Any]] = {"activation": "elu"}
    hidden: tuple[int, ...] = PAPER.teacher.hidden
    """Width of the hidden layers, the same for actor and critic."""
    distribution: Literal["gaussian", "state-dependent"] = "gaussian"
    """gaussian: a learned std per action, as in the paper's code; state-dependent: the network's, bounded."""
    initial_std: float = math.exp(PAPER.teacher.initial_log_std_code)
    """Standard deviation of every action at the start."""
    std_range: tuple[float, float] = (1e-6, 1e6)
    """Bounds of the standard deviation; the default leaves it free, as in the paper's code."""
    quiet_std: float | None = None
    """Lower bound of the standard deviation where stillness has tightened to that of success
    (--env.curriculum.tightening); the bound falls towards it with the tightness. None: it stays."""
    normalise_observations: bool = False
    """Subtract a running mean and divide by a running std; the paper does not."""


@dataclass
class RunCfg:
    """Where, how long and how reproducibly."""

    RETIRED: ClassVar[dict[str, Any]] = {
        "run_dir": Renamed("out"),
        "keep_last": 3,
        "stagger": True,
    }
    out: Path = Path("runs/teacher")
    """Folder for configuration, checkpoints, curves and TensorBoard files."""
    device: str = "auto"
    """cpu, cuda:0, ... or auto: the first GPU, else the CPU (under torchrun: each process its own GPU)."""
    max_steps: int = 10_000_000_000
    """End after this many control steps, all environments and GPUs together, resumed ones counted."""
    max_minutes: float | None = None
    """End after this much time since the start of this command, with a checkpoint."""
    coarse_physics: bool = False
    """Learn in coarser physics than the task's (vd.sim.cfg.coarser), half as fast again on a GPU. Policies
    keep the task's own, and are judged in it."""
    save_every: int = 100
    """Iterations between checkpoints."""
    keep_every: int | None = None
    """Keep those after every so many iterations besides the last three and the best, a multiple of
    --save-every: vd-train average takes their mean."""
    tensorboard: bool = True
    """Write TensorBoard files (tensorboard --logdir RUN-DIR)."""

    def deadline(self, started: float | None) -> float | None:
        """``time.monotonic()`` at which a run that began at ``started`` has to end; None: no limit.

        Args:
            started: ``time.monotonic()``; now by default.
        """
        if self.max_minutes is None:
            return None
        return (time.monotonic() if started is None else started) + 60.0 * self.max_minutes

    def check_kept(self) -> None:
        """Refuse checkpoints to be kept that are never written.

        Raises:
            ValueError: ``keep_every`` is no multiple of ``save_every``.
        """
        if self.keep_every is not None and (self.keep_every < 1 or self.keep_every % self.save_every):
            raise ValueError(
                f"--keep-every is {self.keep_every}; give a multiple of --save-every {self.save_every}"
            )


def minibatches(ppo: PpoCfg, num_envs: int) -> int:
    """Minibatches in a rollout of ``num_envs`` environments, of at most ``minibatch_size`` samples each."""
    return max(1, math.ceil(num_envs * ppo.rollout_steps / ppo.minibatch_size))


def validate(ppo: PpoCfg, policy: PolicyCfg, run: RunCfg) -> None:
    """Refuse settings that cannot train.

    Raises:
        ValueError: The flag, its value and what it has to be.
    """
    positive = {
        "--ppo.rollout-steps": ppo.rollout_steps,
        "--ppo.minibatch-size": ppo.minibatch_size,
        "--ppo.epochs": ppo.epochs,
        "--ppo.actor-learning-rate": ppo.actor_learning_rate,
        "--ppo.critic-learning-rate": ppo.critic_learning_rate,
        "--ppo.imitation-learning-rate": ppo.imitation_learning_rate,
        "--ppo.desired-kl": ppo.desired_kl,
        "--ppo.clip": ppo.clip,
        "--ppo.grad-norm": ppo.grad_norm,
        "--policy.initial-std": policy.initial_std,
        "--policy.hidden": min(policy.hidden, default=0),
        "--max-steps": run.max_steps,
        "--save-every": run.save_every,
    }
    if run.max_minutes is not None:
        positive["--max-minutes"] = run.max_minutes
    for flag, value in positive.items():
        if not value > 0:
            raise ValueError(f"{flag} is {value}; it has to be positive")
    run.check_kept()
    not_negative = {
        "--ppo.critic-warmup-iterations": ppo.critic_warmup_iterations or 0,
        "--ppo.imitation-iterations": ppo.imitation_iterations,
        "--ppo.bound-coefficient": ppo.bound_coefficient,
    }
    for flag, value in not_negative.items():
        if value < 0:
            raise ValueError(f"{flag} is {value}; it has to be zero or positive")
    for flag, share in {"--ppo.gamma": ppo.gamma, "--ppo.gae-lambda": ppo.gae_lambda}.items():
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"{flag} is {share}; it has to be in [0, 1]")
    low, high = policy.std_range
    if not 0.0 < low < policy.initial_std < high:
        raise ValueError(
            f"--policy.std-range is {low} {high}; it has to be positive and hold --policy.initial-std "
            f"{policy.initial_std} inside"
        )
    if policy.quiet_std is not None and (
        policy.distribution != "state-dependent" or not 0.0 < policy.quiet_std <= low
    ):
        raise ValueError(
            f"--policy.quiet-std is {policy.quiet_std}; it has to be positive and at most the lower end "
            f"{low} of --policy.std-range, and needs --policy.distribution state-dependent"
        )


def rsl_rl_config(
    ppo: PpoCfg, policy: PolicyCfg, num_envs: int, groups: Sequence[str] = ("policy",)
) -> dict[str, Any]:
    """The dictionary that rsl-rl's runner builds algorithm and models from.

    Args:
        ppo: Algorithm settings.
        policy: Network settings.
        num_envs: Environments.
        groups: Groups of observations; the actor reads the first, the critic all.
    """
    from vd.train.distribution import BoundedStdGaussian, FreeStdGaussian  # imports torch
    from vd.train.ppo import TeacherPPO

    distribution: dict[str, Any] = {"init_std": policy.initial_std, "std_range": policy.std_range}
    if policy.distribution == "gaussian":
        distribution |= {"class_name": FreeStdGaussian, "std_type": "log"}
    else:
        distribution |= {"class_name": BoundedStdGaussian}
    network = {
        "class_name": "MLPModel",
        "hidden_dims": policy.hidden,
        "activation": ACTIVATION,
        "obs_normalization": policy.normalise_observations,
    }
    return {
        "num_steps_per_env": ppo.rollout_steps,
        "obs_groups": {"actor": [groups[0]], "critic": list(groups)},
        "actor": network | {"distribution_cfg": distribution},
        "critic": network,
        "algorithm": {
            "class_name": TeacherPPO,
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": minibatches(ppo, num_envs),
            "learning_rate": ppo.actor_learning_rate,
            "critic_learning_rate": ppo.critic_learning_rate,
            "schedule": ppo.schedule,
            "desired_kl": ppo.desired_kl,
            "clip_param": ppo.clip,
            "gamma": ppo.gamma,
            "lam": ppo.gae_lambda,
            "value_loss_coef": ppo.value_coefficient,
            "entropy_coef": ppo.entropy_coefficient,
            "bound_coef": ppo.bound_coefficient,
            "cuda_graph": ppo.cuda_graph,
            "max_grad_norm": ppo.grad_norm,
            "optimizer": ppo.optimizer,
            "use_clipped_value_loss": False,
        },
    }
