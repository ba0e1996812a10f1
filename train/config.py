"""Settings of the learner: PPO, the networks and the run. Pure data, cheap to import.

Defaults are the paper's (Table S1), or its released code's where the paper says nothing.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vd.command.config import require
from vd.paper import PAPER


@dataclass
class PpoCfg:
    """Proximal policy optimisation, with Adam as in the paper."""

    rollout_steps: int = PAPER.teacher.rollout_steps
    """Control steps of every environment between two updates."""
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
    late_kl: float | None = None
    """The same where the curriculum has come to its end; geometric in between. None: it stays."""
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
    """Weight of the squared excess of mean actions beyond [-1, 1], where the environment clips
    them.
    """
    grad_norm: float = PAPER.teacher.grad_norm_code
    """Joint gradient norm of actor and critic is clipped to this."""
    cuda_graph: bool = False
    """Record forward and backward pass of a minibatch once as a CUDA graph, and replay it: where
    launching some hundred kernels takes longer than running them, as on busy processors. Ignored on
    a CPU.
    """


@dataclass
class PolicyCfg:
    """Networks of actor and critic."""

    hidden: tuple[int, ...] = PAPER.teacher.hidden
    """Width of the hidden layers, the same for actor and critic."""
    distribution: Literal["gaussian", "state-dependent"] = "gaussian"
    """gaussian: a learned std per action, as in the paper's code; state-dependent: the network's,
    bounded.
    """
    initial_std: float = math.exp(PAPER.teacher.initial_log_std_code)
    """Standard deviation of every action at the start."""
    std_range: tuple[float, float] = (1e-6, 1e6)
    """Bounds of the standard deviation; the default leaves it free, as in the paper's code."""
    quiet_std: float | None = None
    """Lower bound of the standard deviation where success asks for its full stillness (of the
    curriculum); the bound falls towards it with that level. None: it stays."""
    normalise_observations: bool = False
    """Subtract a running mean and divide by a running std; the paper does not."""


@dataclass
class RunCfg:
    """Where, how long and how reproducibly."""

    out: Path = Path("runs/teacher")
    """Folder for configuration, checkpoints and TensorBoard files."""
    device: str = "auto"
    """cpu, cuda:0, ... or auto: the first GPU, else the CPU (under torchrun: each process its own
    GPU).
    """
    max_steps: int = 10_000_000_000
    """End after this many control steps, all environments and GPUs together, resumed ones
    counted.
    """
    max_minutes: float | None = None
    """End after this much time, with a checkpoint; counted from the end of this command's first
    iteration, since kernels compile until then."""
    coarse_physics: bool = False
    """Learn in coarser physics than the task's (vd.sim.cfg.coarser), half as fast again on a GPU.
    Policies keep the task's own, and are judged in it."""
    save_every: int = 100
    """Iterations between checkpoints."""
    logger: Literal["tensorboard", "none"] = "tensorboard"
    """Where curves go beside progress.jsonl: files for tensorboard --logdir RUN, or nowhere."""

    def validate(self) -> None:
        """Raise ValueError naming the flag, its value and what it has to be."""
        require(self, "--", "positive", "max_steps max_minutes save_every")


def minibatches(ppo: PpoCfg, num_envs: int) -> int:
    """Minibatches of at most ``minibatch_size`` samples in a rollout of ``num_envs`` environments."""
    return max(1, math.ceil(num_envs * ppo.rollout_steps / ppo.minibatch_size))


def validate(ppo: PpoCfg, policy: PolicyCfg, run: RunCfg) -> None:
    """Refuse settings that cannot train.

    Raises:
        ValueError: The flag, its value and what it has to be.
    """
    run.validate()
    require(ppo, "--ppo.", "positive", "rollout_steps minibatch_size epochs clip grad_norm")
    rates = "actor_learning_rate critic_learning_rate"
    require(ppo, "--ppo.", "positive", f"{rates} desired_kl late_kl")
    require(ppo, "--ppo.", "zero or positive", "bound_coefficient")
    require(ppo, "--ppo.", "in [0, 1]", "gamma gae_lambda")
    if not min(policy.hidden, default=0) > 0:
        raise ValueError(f"--policy.hidden is {policy.hidden}; widths have to be positive")
    low, high = policy.std_range
    if not 0.0 < low < policy.initial_std < high:
        raise ValueError(
            f"--policy.std-range is {low} {high}; it has to be positive and hold "
            f"--policy.initial-std {policy.initial_std} inside"
        )
    if policy.quiet_std is not None and (
        policy.distribution != "state-dependent" or not 0.0 < policy.quiet_std <= low
    ):
        raise ValueError(
            f"--policy.quiet-std is {policy.quiet_std}; it has to be positive and at most the "
            f"lower end {low} of --policy.std-range, and needs --policy.distribution "
            "state-dependent"
        )


@dataclass
class StageTaskCfg:
    """The environments; all else of them is as in the teacher's training, without its noise."""

    objects: tuple[str, ...] = ()
    """Object sets: names or folders of object USDs; the teacher's by default."""
    validation: tuple[str, ...] = ()
    """Object sets to measure on, names or folders, that are not learned from."""
    num_envs: int = 2048
    """Environments simulated side by side, in stages that simulate."""
    seed: int = 0
    """Seed of every random draw."""

    def validate(self) -> None:
        """Refuse settings that cannot train, naming the flag, its value and what it has to be."""
        require(self, "--", "positive", "num_envs")
        require(self, "--", "zero or positive", "seed")
