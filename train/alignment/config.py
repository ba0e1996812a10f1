"""Settings of the training of alignment and their presets. Pure data, cheap to import."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vd.train.config import RunCfg, StageTaskCfg, require
from vd.train.presets import SMOKE_RUN
from vd.vision.cfg import SEEN_POINTS, AlignmentCfg

Stage = Literal[0, 1]
PresetName = Literal["gpu", "cpu-demo"]

MADE, SIMULATED = 0, 1
"""Stages: of clouds without simulation; of what a camera sees while the policy acts, besides."""
ALIGNMENT_NAME = "alignment.pt"
"""The network of a run, in its folder."""
RUNS = Path("runs/alignment")
"""Parent of the default folders stage0 and stage1."""


@dataclass
class AlignCfg:
    """Turning a goal's cloud onto what a camera sees, learned from shapes without simulation."""

    batch: int = 768
    """Pairs of clouds of an optimiser step on one GPU."""
    steps: int = 50
    """Optimiser steps of an iteration."""
    learning_rate: float = 6e-4
    """Of AdamW, after the warm-up; it falls to nearly 0 along a cosine until --max-steps or
    --max-minutes.
    """
    warmup_steps: int = 300
    """Optimiser steps over which the learning rate rises from 0, linearly."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of the network's products."""
    shapes: int = 40_000
    """Shapes in memory, half made and half deformed objects; 0.6 GB. With 159 the errors of shapes
    that were not learned from are half as large again."""
    fresh_shapes: int = 256
    """Of these, how many are replaced in each iteration."""
    hands: int = 1024
    """Random postures of the hand that hide shapes; 0.15 GB."""
    points: int = 512
    """Points of each cloud."""
    validate_every: int = 20
    """Iterations from one measurement to the next."""
    views: int = 64
    """Views of each object that is measured on."""
    network: AlignmentCfg = field(default_factory=AlignmentCfg)

    def validate(self) -> None:
        """Refuse settings that cannot train.

        Raises:
            ValueError: The flag, its value and what it has to be.
        """
        positive = "batch steps learning_rate shapes hands points validate_every views"
        require(self, "--align.", "positive", positive)
        require(self, "--align.", "zero or positive", "warmup_steps fresh_shapes")
        self.network.validate()
        if self.points < max(self.network.tokens, self.network.neighbours):
            raise ValueError(
                f"--align.points is {self.points}; it has to be at least the tokens and neighbours "
                "of --align.network"
            )


@dataclass
class LooksCfg:
    """Stage 1: what a camera sees in simulation while the policy acts by the network (DAgger)."""

    steps: int = 8
    """Control steps of every environment before an iteration's optimiser steps."""
    kept: int = 400_000
    """Latest looks in memory, to learn from: those of the last 25 iterations of 2048 environments;
    1.3 GB.
    """

    def validate(self) -> None:
        """Refuse settings that cannot train.

        Raises:
            ValueError: The flag, its value and what it has to be.
        """
        require(self, "--looks.", "positive", "steps kept")


@dataclass
class AlignmentTrainCfg:
    """Train the network of alignment."""

    preset: PresetName = "gpu"
    """Settings to start from; every other flag overrides one of them. By default gpu, and cpu-demo
    where there is none."""
    stage: Stage = 0
    """0: learn to turn a goal's cloud onto a seen one, without simulation; 1: also from what a
    depth camera sees while the teacher acts by the network of --init."""
    teacher: str | None = None
    """Policy that acts, also the source of hand and task: a policy.safetensors, a run's folder, or
    the name of an installed one; dclaw4 by default."""
    init: Path | None = None
    """Network to begin from, the alignment.pt of a run or an installed vision policy. Of stage 1 by
    default that of runs/alignment/stage0, or the one that is installed for the hand."""
    smoke: bool = False
    """Check the installation: the stage, tiny, on the CPU, for at most a minute. It learns nothing,
    and keeps nothing unless --out is given."""
    resume: str | None = None
    """Go on from a checkpoint of --out: latest (a bare --resume), a file, or auto: the latest, and
    a new run where there is none."""
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the optical frame (x right, y down, z forward) in the hand's base frame: position [m]
    and quaternion xyzw; the hand's own camera by default."""
    run: Annotated[RunCfg, tyro.conf.arg(name="")] = field(default_factory=RunCfg)
    align: AlignCfg = field(default_factory=AlignCfg)
    looks: LooksCfg = field(default_factory=LooksCfg)
    task: StageTaskCfg = field(default_factory=StageTaskCfg)

    def validate(self) -> None:
        """Refuse settings that cannot train.

        Raises:
            ValueError: The flag, its value and what it has to be.
        """
        self.run.validate()
        self.align.validate()
        self.looks.validate()
        self.task.validate()
        if self.stage == SIMULATED and self.init is None:
            raise ValueError(
                "--stage 1 begins from a network of stage 0; give its alignment.pt as --init"
            )
        if self.stage == SIMULATED and self.align.points > SEEN_POINTS:
            raise ValueError(
                f"--align.points is {self.align.points}; policies look at {SEEN_POINTS}, at most"
            )


def gpu(stage: Stage) -> AlignmentTrainCfg:
    """One GPU or several, half precision."""
    run = RunCfg(out=RUNS / f"stage{stage}", save_every=20, max_steps=1_000_000_000)
    cfg = AlignmentTrainCfg(preset="gpu", stage=stage, run=run, align=AlignCfg(precision="bf16"))
    if stage == SIMULATED:  # it begins from a network that sees already
        return replace(cfg, align=replace(cfg.align, learning_rate=2e-4))
    return cfg


def cpu_demo(stage: Stage) -> AlignmentTrainCfg:
    """Two CPU cores and minutes: a cube, small batches, few shapes."""
    return AlignmentTrainCfg(
        preset="cpu-demo",
        stage=stage,
        teacher="dclaw4-cube",
        run=RunCfg(
            out=RUNS / f"cpu-stage{stage}",
            device="cpu",
            save_every=5,
            max_minutes=7.0,
            max_steps=16_000,
        ),
        align=AlignCfg(
            batch=64,
            steps=5,
            shapes=256,
            fresh_shapes=8,
            hands=32,
            points=256,
            validate_every=10,
            views=4,
        ),
        looks=LooksCfg(kept=2000),
        task=StageTaskCfg(num_envs=16),
    )


def smoke(stage: Stage) -> AlignmentTrainCfg:
    """All parts of a stage in at most a minute; it learns nothing."""
    cfg = cpu_demo(stage)
    run = replace(cfg.run, out=SMOKE_RUN, max_steps=32, max_minutes=1.0, logger="none")
    network = AlignmentCfg(width=32, layers=1, tokens=32, patch=16)  # of --init another
    align = replace(
        cfg.align,
        batch=8,
        steps=2,
        shapes=16,
        fresh_shapes=2,
        hands=4,
        views=1,
        network=network,
    )
    looks = replace(cfg.looks, steps=2)
    task = replace(cfg.task, objects=("cube",), num_envs=4)
    return replace(cfg, smoke=True, run=run, align=align, looks=looks, task=task)


PRESETS: dict[str, Callable[[Stage], AlignmentTrainCfg]] = {"gpu": gpu, "cpu-demo": cpu_demo}
