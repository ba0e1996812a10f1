"""Presets of the teacher: the paper's settings, and settings for machines at hand."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vd.envs.cfg import CurriculumCfg, GoalCfg, RandomisationCfg, ReorientCfg, RewardCfg, StartCfg, SuccessCfg
from vd.paper import PAPER
from vd.train.config import PolicyCfg, PpoCfg, RunCfg

PresetName = Literal["paper", "cpu-demo", "cube", "gpu", "multi-gpu"]

TRAINING_SET = ("procedural-150-seed0",)
"""Objects of the paper's task: as many as the paper trained on, and authored on first use."""


@dataclass
class TeacherCfg:
    """Train the teacher: PPO on the simulator's state."""

    preset: PresetName = "paper"
    """Settings to start from; every other flag overrides one of them."""
    resume: str | None = None
    """Go on from a checkpoint of --run-dir: latest (a bare --resume), best, a file, or auto: the latest, and
    a new run where there is none."""
    init: Path | None = None
    """Begin a new run with the networks, optimiser and curriculum of another run's checkpoint, at this run's
    learning rates. It may have observed less: what is new (--env.observation.shape) starts without effect."""
    smoke: bool = False
    """Check the installation: the cpu-demo preset, tiny, on the CPU, for at most a minute."""
    run: Annotated[RunCfg, tyro.conf.arg(name="")] = field(default_factory=RunCfg)
    ppo: PpoCfg = field(default_factory=PpoCfg)
    policy: PolicyCfg = field(default_factory=PolicyCfg)
    env: ReorientCfg = field(default_factory=ReorientCfg)


def paper() -> TeacherCfg:
    """Table S1 as it stands, and the released code where the paper is silent."""
    return TeacherCfg(
        preset="paper",
        run=RunCfg(run_dir=Path("runs/paper")),
        env=ReorientCfg(num_worlds=PAPER.teacher.num_worlds, objects=TRAINING_SET),
    )


def gpu() -> TeacherCfg:
    """One GPU: the paper's task, reached by a curriculum and a reward that shows the way.

    In short runs many optimiser steps per sample (short rollouts, small minibatches) helped most, then a
    large divergence for the actor's rate to follow and a reward for turning towards the goal.
    """
    return TeacherCfg(
        preset="gpu",
        run=RunCfg(run_dir=Path("runs/gpu")),
        ppo=PpoCfg(
            rollout_steps=8,
            minibatch_size=16384,
            epochs=5,
            schedule="adaptive",
            desired_kl=0.02,
            clip=0.2,
            gamma=0.97,
            value_coefficient=1.0,
            entropy_coefficient=1e-3,
        ),
        policy=PolicyCfg(
            distribution="state-dependent",
            initial_std=0.8,
            std_range=(0.02, 1.0),
            # Positions and velocities of the object vary by 0.02, those of the goal by 0.5.
            normalise_observations=True,
        ),
        env=ReorientCfg(
            num_worlds=16384,
            objects=TRAINING_SET,
            # About one in 40 million was seen, always of a slim object, and ended the run.
            failures_per_million=1.0,
            reward=RewardCfg(
                rotation_epsilon_rad=PAPER.reward.rotation_epsilon_rad_code,
                fingertip=-10.0,
                fingertip_mean_distance=True,
                energy=-1.0,
                energy_clip_w=PAPER.reward.energy_clip_w_code,
                fall=-300.0,
                table_contact=0.0,
                progress=300.0,
                scale=0.01,
            ),
            curriculum=CurriculumCfg(enabled=True, raise_at=0.5, lower_at=0.25),
        ),
    )


def cube() -> TeacherCfg:
    """The first thing to learn on one GPU: near goals of a cube on the table, nothing randomised."""
    base = gpu()
    return replace(
        base,
        preset="cube",
        run=RunCfg(run_dir=Path("runs/cube")),
        ppo=replace(base.ppo, minibatch_size=8192),
        # As measured: a std that is the same in all states.
        policy=replace(base.policy, distribution="gaussian", initial_std=0.8, std_range=(0.02, 1.5)),
        env=replace(
            base.env,
            objects=("cube",),
            num_worlds=8192,
            start=StartCfg(at_rest=True),
            goal=GoalCfg(max_angle_rad=1.0),
            randomisation=RandomisationCfg(enabled=False),
        ),
    )


def multi_gpu() -> TeacherCfg:
    """The gpu preset on every GPU of a torchrun: worlds and minibatches are per GPU."""
    return replace(gpu(), preset="multi-gpu", run=RunCfg(run_dir=Path("runs/multi-gpu")))


def cpu_demo() -> TeacherCfg:
    """Minutes on two cores, on an easier task: from rest, goals about the vertical, no stillness test."""
    return TeacherCfg(
        preset="cpu-demo",
        run=RunCfg(run_dir=Path("runs/cpu-demo"), device="cpu", max_steps=200_000, save_every=10),
        # Many optimiser steps per sample: samples are what a CPU is short of.
        ppo=PpoCfg(
            rollout_steps=8,
            minibatch_size=256,
            epochs=5,
            actor_learning_rate=1e-3,
            schedule="adaptive",
            desired_kl=0.02,
            clip=0.2,
            gamma=0.97,
            value_coefficient=1.0,
            entropy_coefficient=1e-3,
        ),
        policy=PolicyCfg(
            hidden=(256, 128, 64),
            distribution="state-dependent",
            initial_std=0.8,
            std_range=(0.02, 1.0),
            normalise_observations=True,
        ),
        env=ReorientCfg(
            num_worlds=256,
            reward=RewardCfg(
                success=10.0,
                fingertip=-10.0,
                fingertip_mean_distance=True,
                energy=-0.1,
                fall=-10.0,
                table_contact=0.0,
                progress=30.0,
                scale=0.1,
            ),
            success=SuccessCfg(
                joint_speed_rad_s=0.0, object_speed_m_s=0.0, object_spin_rad_s=0.0, action_norm=0.0
            ),
            start=StartCfg(at_rest=True),
            goal=GoalCfg(max_angle_rad=1.0, about_vertical=True),
            curriculum=CurriculumCfg(enabled=False),
            randomisation=RandomisationCfg(enabled=False),
        ),
    )


PRESETS: dict[str, Callable[[], TeacherCfg]] = {
    "paper": paper,
    "cpu-demo": cpu_demo,
    "cube": cube,
    "gpu": gpu,
    "multi-gpu": multi_gpu,
}
"""Presets by name."""


def smoke() -> TeacherCfg:
    """The cpu-demo preset shrunk to run through everything in at most a minute."""
    cfg = cpu_demo()
    return replace(
        cfg,
        smoke=True,
        run=replace(
            cfg.run,
            run_dir=Path("runs/smoke"),
            max_steps=2048,
            max_minutes=1.0,
            save_every=1,
            tensorboard=False,
        ),
        ppo=replace(cfg.ppo, minibatch_size=128, epochs=2),
        env=replace(cfg.env, num_worlds=16),
    )
