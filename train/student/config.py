"""Settings of the student's training and their presets. Pure data, cheap to import."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vd.evaluate.conditions import OBSERVATION_LATENCY_S
from vd.paper import PAPER
from vd.sensors.cfg import LATENCY_S
from vd.train.config import RunCfg, StageTaskCfg, require
from vd.train.presets import SMOKE_RUN
from vd.vision.cfg import StudentCfg

Stage = Literal[0, 1, 2]
PresetName = Literal["gpu", "cpu-demo"]

MADE: Stage = 0
COMPLETE: Stage = 1
RENDERED: Stage = 2
"""Stages: of shapes without simulation; in simulation by complete clouds; by rendered depth."""
RUNS = Path("runs/student")
"""Parent of the default folders stage0, stage1 and stage2."""


@dataclass
class LearnCfg:
    """What all stages learn, and how. Nothing here is tuned yet."""

    window: int = 16
    """Steps of a sequence, through which gradients flow."""
    batch: int = 512
    """Looks of an optimiser step that learns to see."""
    sequences: int = 256
    """Sequences of an optimiser step that learns to act."""
    learning_rate: float = 1e-3
    """Of AdamW, after the warm-up; it falls to nearly 0 along a cosine until --max-steps or
    --max-minutes.
    """
    warmup_steps: int = 100
    """Optimiser steps over which the learning rate rises from 0, linearly."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of the convolutions' products."""

    def validate(self) -> None:
        """Refuse settings that cannot train, naming the flag, its value and what it has to be."""
        require(self, "--learn.", "positive", "window batch sequences learning_rate")
        require(self, "--learn.", "zero or positive", "warmup_steps")


@dataclass
class CloudsCfg:
    """Clouds of objects and goals, and stage 0, which has nothing else."""

    points: int = PAPER.cloud.object_points
    """Points of a cloud, of the goal as of the object."""
    noise_m: float = 0.001
    """Noise of the object's points in stages 0 and 1 [m]."""
    scan_share: float = 0.25
    """Share of goals as from scans: 4 mm of noise, and a fifth of the surface missing."""
    seen_share: float = 0.75
    """Stage 0: share of looks in which a camera sees one side; in others the surface is whole, which
    is learned sooner."""
    shapes: int = 1024
    """Stage 0: shapes of an iteration, half made and half deformed objects."""
    hands: int = 1024
    """Stage 0: random postures of the hand; 0.15 GB."""
    updates: int = 50
    """Stage 0: optimiser steps of an iteration."""
    validate_every: int = 20
    """Stage 0: iterations from one measurement to the next."""

    def validate(self) -> None:
        """Refuse settings that cannot train, naming the flag, its value and what it has to be."""
        require(self, "--clouds.", "positive", "points shapes hands updates validate_every")
        require(self, "--clouds.", "zero or positive", "noise_m")
        require(self, "--clouds.", "in [0, 1]", "scan_share seen_share")


@dataclass
class SimulatedCfg:
    """Stages 1 and 2: what the student does in simulation, labelled by the teacher (DAgger)."""

    epochs: int = 4
    """Passes over what was done in an iteration."""
    looks: int = 4096
    """Looks of an iteration to learn to see from, of steps and environments at random."""
    belief_rad: float = 0.2
    """Stage 1: deviation of what is believed of rotations about each axis, at most [rad]."""
    belief_m: float = 0.004
    """Stage 1: deviation of what is believed of places along each axis, at most [m]."""
    blank_probability: float = 0.02
    """Stage 2: chance in a step that the camera goes blank for a while."""
    blank_steps: int = 8
    """Stage 2: longest such while [control steps]."""
    latency_s: tuple[float, float] = (LATENCY_S[0], OBSERVATION_LATENCY_S)
    """Stage 2: range of the images' age [s], from a D415's to that of *mixed*."""

    def validate(self) -> None:
        """Refuse settings that cannot train, naming the flag, its value and what it has to be."""
        require(self, "--simulated.", "positive", "epochs looks blank_steps")
        require(self, "--simulated.", "zero or positive", "belief_rad belief_m")
        require(self, "--simulated.", "in [0, 1]", "blank_probability")


@dataclass
class StudentTrainCfg:
    """Train the student."""

    preset: PresetName = "gpu"
    """Settings to start from; every other flag overrides one of them. By default gpu, and cpu-demo
    where there is none."""
    stage: Stage = MADE
    """0: learn where objects are, from clouds that are made; 1: learn to act from a teacher in
    simulation, by beliefs that are drawn, and to see complete clouds; 2: both by a depth camera."""
    teacher: str | None = None
    """Policy that labels, also the source of hand and task: a policy.safetensors, a run's folder, or
    the name of an installed one; dclaw4 by default."""
    init: Path | None = None
    """Student to begin from: a policy.safetensors or a run's folder; of another hand's, only its eyes
    are taken. By default that of the stage before in runs/student, if it is there."""
    smoke: bool = False
    """Check the installation: the stage, tiny, on the CPU, for at most a minute. It learns nothing,
    and keeps nothing unless --out is given."""
    resume: str | None = None
    """Go on from a checkpoint of --out: latest (a bare --resume), a file, or auto: the latest, and
    a new run where there is none."""
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the optical frame (x right, y down, z forward) in the hand's base frame: position [m]
    and quaternion xyzw; the hand's own camera by default, or one that looks at where it holds objects."""
    camera_range: tuple[float, float] = (0.05, 0.087)
    """Stages 0 and 2: up to how far along [m], and turned about [rad], each of its axes a camera is from
    there, each hand's another: a person's camera is never quite in the same place."""
    run: Annotated[RunCfg, tyro.conf.arg(name="")] = field(default_factory=RunCfg)
    student: StudentCfg = field(default_factory=StudentCfg)
    learn: LearnCfg = field(default_factory=LearnCfg)
    clouds: CloudsCfg = field(default_factory=CloudsCfg)
    simulated: SimulatedCfg = field(default_factory=SimulatedCfg)
    task: StageTaskCfg = field(default_factory=StageTaskCfg)

    def validate(self) -> None:
        """Refuse settings that cannot train, naming the flag, its value and what it has to be."""
        self.run.validate()
        self.student.validate()
        self.learn.validate()
        self.clouds.validate()
        self.simulated.validate()
        self.task.validate()


def gpu(stage: Stage) -> StudentTrainCfg:
    """One GPU or several, half precision."""
    return StudentTrainCfg(
        preset="gpu",
        stage=stage,
        run=RunCfg(out=RUNS / f"stage{stage}", save_every=20, max_steps=1_000_000_000),
        learn=LearnCfg(precision="bf16"),
        task=StageTaskCfg(num_envs=1024 if stage == RENDERED else 16384),
    )


def cpu_demo(stage: Stage) -> StudentTrainCfg:
    """Two CPU cores and minutes: a cube, a small network, few environments."""
    return StudentTrainCfg(
        preset="cpu-demo",
        stage=stage,
        teacher="dclaw4-cube",
        run=RunCfg(
            out=RUNS / f"cpu-stage{stage}",
            device="cpu",
            save_every=5,
            max_minutes=7.0,
            max_steps=50_000,
        ),
        student=StudentCfg(
            channels=(16, 32, 64),
            blocks=1,
            flow=64,
            senses=64,
            memory=64,
            head=64,
            voxel_m=0.008,
        ),
        learn=LearnCfg(
            window=8,
            batch=64 if stage == MADE else 16,
            sequences=8,
            warmup_steps=20,
        ),
        clouds=CloudsCfg(shapes=64, hands=32, updates=10, validate_every=10),
        simulated=SimulatedCfg(looks=16),
        task=StageTaskCfg(num_envs=16),
    )


def smoke(stage: Stage) -> StudentTrainCfg:
    """All parts of a stage in at most a minute; it learns nothing."""
    cfg = cpu_demo(stage)
    return replace(
        cfg,
        smoke=True,
        run=replace(cfg.run, out=SMOKE_RUN, max_steps=32, max_minutes=1.0, logger="none"),
        student=replace(cfg.student, channels=(8, 16), voxel_m=0.01),
        learn=replace(cfg.learn, window=2, batch=4, sequences=4),
        clouds=replace(cfg.clouds, shapes=4, hands=4, updates=2),
        task=replace(cfg.task, objects=("cube",), num_envs=4),
    )


PRESETS: dict[str, Callable[[Stage], StudentTrainCfg]] = {"gpu": gpu, "cpu-demo": cpu_demo}
