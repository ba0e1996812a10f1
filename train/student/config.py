"""Settings of the student's training and their presets. Pure data, cheap to import."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from vd.config import Dropped, Renamed
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.train.config import RunCfg, require
from vd.vision.cfg import LEAN, PAPER_NETWORK, SMALL, AlignmentCfg, NoiseCfg, SearchCfg, StudentCfg

Stage = Literal[0, 1, 2]
PresetName = Literal["gpu", "paper", "cpu-demo"]

ALIGNING, SYNTHETIC, RENDERED = 0, 1, 2
"""Stages: alignment of clouds without simulation; complete clouds; clouds of a depth camera."""
ALIGNMENT_NAME = "alignment.pt"
"""The network of a stage 0, in its folder."""
STUDENT_NAME = "student.pt"
"""The student of a run, in its folder: what later stages start from, without optimiser and environments."""
RUNS = Path("runs/student")
"""Parent of the default folders stage0, stage1 and stage2."""


@dataclass
class DaggerCfg:
    """Imitation of the teacher on what the student does (DAgger), stages 1 and 2."""

    RETIRED: ClassVar[dict[str, Any]] = {
        "minibatch_worlds": Renamed("minibatch_envs"),
        "state_weight": Dropped(0.0),
        "match_weight": Dropped(0.0),
        "same_scene": False,
        "validation_worlds": Dropped(0),
        "validation_envs": Dropped(0),
    }
    rollout_steps: int = PAPER.dagger.rollout_steps
    """Control steps of every environment between two updates; gradients flow through all of them."""
    minibatch_envs: int = PAPER.dagger.synthetic_minibatch
    """Environments of an optimiser step on one GPU, whole sequences each."""
    epochs: int = PAPER.dagger.epochs
    """Passes over a rollout."""
    learning_rate: float = PAPER.dagger.learning_rate
    """Of AdamW, after the warm-up and until the decay."""
    warmup_steps: int = 0
    """Optimiser steps over which the learning rate rises from 0, linearly; the released code has none."""
    decay_after_steps: int = 0
    """Optimiser steps after which the learning rate falls as 1 / sqrt(steps); 0: never (released code)."""
    amsgrad: bool = True
    """Never forget the largest gradients (released code). Those of the first steps are the largest of all,
    and make all later steps small."""
    grad_norm: float = PAPER.dagger.grad_norm
    """Gradient norm is clipped to this."""
    imitation: Literal["likelihood", "squared"] = "likelihood"
    """Loss: likelihood of the teacher's mean action under the student's distribution (released code), or the
    squared error of the student's mean, which teaches no standard deviation: it then acts by its mean."""
    distance_weight: float = PAPER.dagger.distance_weight
    """Weight of the squared error of the predicted rotation distance [rad^2], the mean over the heads."""
    pose_weight: float = 0.0
    """Weight of the squared error of where the object is, and how it is turned from the goal, predicted from
    the embedding by a head of the training alone. The teacher acts by these; labels alone teach the encoder
    to see them much later. 0, as in the released code: no such head."""
    clip_labels: bool = False
    """Clip the teacher's mean to [-1, 1], where the environment clips actions; the released code does not."""
    teacher_share: float = PAPER.dagger.teacher_share
    """Share of environments in which the teacher acts, drawn for every rollout, in the first iteration (beta
    of DAgger)."""
    teacher_share_last: float = 0.0
    """What that share comes to. With a rest of it the states near the goal stay among those learned from,
    which a student that is not good yet does not reach."""
    teacher_share_iterations: int = 0
    """Iterations over which it gets there, linearly; 0: it stays at the first."""
    keep_rollouts: int = 1
    """Rollouts to learn from, the latest and those before it; the released code keeps the latest alone.
    Passes stay as long: they take sequences at random from all that are kept."""
    reset: bool = True
    """Begin new episodes in all environments with every rollout (released code): no step later than
    rollout_steps is ever seen. Otherwise episodes go on, and rollouts start with the memory of the last."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of the encoder's products; memory, heads, losses and weights stay in fp32."""

    def validate(self) -> None:
        """Refuse settings that cannot train.

        Raises:
            ValueError: The flag, its value and what it has to be.
        """
        positive = "rollout_steps minibatch_envs epochs keep_rollouts learning_rate grad_norm"
        or_zero = "distance_weight pose_weight warmup_steps decay_after_steps teacher_share_iterations"
        require(self, "--dagger.", "positive", positive)
        require(self, "--dagger.", "zero or positive", or_zero)
        require(self, "--dagger.", "in [0, 1]", "teacher_share teacher_share_last")


@dataclass
class AlignCfg:
    """Stage 0: turning a goal's cloud onto what a camera sees, learned from shapes without simulation."""

    batch: int = 768
    """Pairs of clouds of an optimiser step on one GPU."""
    steps: int = 50
    """Optimiser steps of an iteration."""
    learning_rate: float = 6e-4
    """Of AdamW, after the warm-up; it falls to nearly 0 along a cosine until --max-steps or --max-minutes."""
    warmup_steps: int = 300
    """Optimiser steps over which the learning rate rises from 0, linearly."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of the network's products."""
    compile: bool = False
    """Compile the network first, which takes a minute and a C compiler; then steps are shorter."""
    shapes: int = 40_000
    """Shapes in memory, half made and half deformed objects; 0.6 GB. With 159 the errors of shapes that were
    not learned from are half as large again."""
    fresh_shapes: int = 256
    """Of these, how many are replaced in each iteration."""
    hands: int = 1024
    """Random postures of the hand that hide shapes; 0.15 GB."""
    points: int = 512
    """Points of each cloud."""
    near_share: float = 0.5
    """Share of pairs that are less than 0.9 rad apart, as in later passes; others are anywhere."""
    scan_share: float = 0.25
    """Share of goals as from scans: 4 mm of noise, and a fifth of the surface missing."""
    validation: tuple[str, ...] = ()
    """Object sets to measure on, names or folders, that are not learned from; besides made shapes."""
    validate_every: int = 20
    """Iterations from one measurement to the next."""
    views: int = 64
    """Views of each object that is measured on."""
    network: AlignmentCfg = field(default_factory=AlignmentCfg)
    search: SearchCfg = field(default_factory=SearchCfg)

    def validate(self) -> None:
        """Refuse settings that cannot train.

        Raises:
            ValueError: The flag, its value and what it has to be.
        """
        positive = "batch steps learning_rate shapes hands points validate_every views"
        require(self, "--align.", "positive", positive)
        require(self, "--align.", "zero or positive", "warmup_steps fresh_shapes")
        require(self, "--align.", "in [0, 1]", "near_share scan_share")
        self.network.validate()
        if self.points < max(self.network.tokens, self.network.neighbours):
            raise ValueError(
                f"--align.points is {self.points}; it has to be at least the tokens and neighbours of "
                "--align.network"
            )


@dataclass
class StudentTaskCfg:
    """The environments; all else of them is as in the teacher's training, without its noise."""

    RETIRED: ClassVar[dict[str, Any]] = {
        "num_worlds": Renamed("num_envs"),
        "randomise": Dropped(None),
        "at_rest": Dropped(None),
        "max_goal_angle_rad": Dropped(None),
    }
    objects: tuple[str, ...] = ()
    """Object sets: names or folders of object USDs; the teacher's by default."""
    num_envs: int = PAPER.dagger.synthetic_envs
    """Environments simulated side by side."""
    seed: int = 0
    """Seed of every random draw."""


@dataclass
class StudentTrainCfg:
    """Train the student."""

    RETIRED: ClassVar[dict[str, Any]] = {
        "from_scratch": Dropped(False),
        "pretrain": {
            "batch": Dropped(1024),
            "steps": Dropped(50),
            "learning_rate": Dropped(1e-3),
            "decay_after_steps": Dropped(1000),
            "precision": Dropped("bf16"),
        },
    }
    preset: PresetName = "gpu"
    """Settings to start from; every other flag overrides one of them."""
    stage: Stage = 1
    """0: learn to turn a goal's cloud onto a seen one; 1: imitate on complete synthetic clouds; 2: on clouds
    of a depth camera and of the hand's own joints."""
    teacher: str | None = None
    """Policy to imitate, also the source of hand and task: a policy.pt, a run's folder, or the name of an
    installed one."""
    init: Path | None = None
    """Student to begin from: student.pt or a checkpoint. Stage 2 needs one: from random weights it takes
    several times as long."""
    resume: str | None = None
    """Go on from a checkpoint of --out: latest (a bare --resume), a file, or auto: the latest, and a new
    run where there is none."""
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the optical frame (x right, y down, z forward) in the hand's base frame, for stages 0 and 2:
    position [m] and quaternion xyzw; the hand's own camera by default."""
    run: Annotated[RunCfg, tyro.conf.arg(name="")] = field(default_factory=RunCfg)
    dagger: DaggerCfg = field(default_factory=DaggerCfg)
    align: AlignCfg = field(default_factory=AlignCfg)
    task: StudentTaskCfg = field(default_factory=StudentTaskCfg)
    network: StudentCfg = field(default_factory=StudentCfg)
    noise: NoiseCfg = field(default_factory=NoiseCfg)
    depth: DepthCameraCfg = field(default_factory=DepthCameraCfg)

    def validate(self) -> None:
        """Refuse settings that cannot train.

        Raises:
            ValueError: The flag, its value and what it has to be.
        """
        self.run.validate()
        self.dagger.validate()
        self.align.validate()
        require(self.task, "--", "positive", "num_envs")
        if self.camera is not None and self.stage == SYNTHETIC:
            raise ValueError("--camera is for --stage 0 and 2; stage 1 sees complete clouds")
        if self.init is not None and self.stage == ALIGNING:
            raise ValueError("--init is for --stage 1 and 2; go on with a stage 0 by --resume")
        self.network.validate()
        self.noise.validate()
        self.depth.validate()


def paper(stage: Stage) -> StudentTrainCfg:
    """Network and numbers of the paper's released code, which has no stage 0."""
    rendered = stage == RENDERED
    constants = PAPER.dagger
    return StudentTrainCfg(
        preset="paper",
        stage=stage,
        run=RunCfg(out=RUNS / f"stage{stage}", save_every=20, max_steps=100_000_000),
        dagger=DaggerCfg(
            minibatch_envs=constants.rendered_minibatch if rendered else constants.synthetic_minibatch
        ),
        task=StudentTaskCfg(num_envs=constants.rendered_envs if rendered else constants.synthetic_envs),
        network=PAPER_NETWORK,
    )


GPU_WORLDS = 2048
"""Environments of a GPU: five times those of the released code are simulated in hardly more time."""
SHORT_ROLLOUTS = DaggerCfg(
    rollout_steps=20,
    epochs=2,
    learning_rate=1e-3,
    warmup_steps=100,
    amsgrad=False,
    grad_norm=1.0,
    imitation="squared",
    pose_weight=2.0,
    clip_labels=True,
    teacher_share=1.0,
    teacher_share_last=0.2,
    teacher_share_iterations=20,
    reset=False,
)
"""What learns soonest: a part of each episode at a time, learned with those before, the teacher at first."""


def gpu(stage: Stage) -> StudentTrainCfg:
    """One GPU: the lean network, the student's own joints, rollouts kept, half precision.

    The numbers of the released code do not learn in hours.
    """
    start, dagger = paper(stage), SHORT_ROLLOUTS
    if stage == RENDERED:  # it begins from a student that acts already
        dagger = replace(dagger, learning_rate=5e-4, teacher_share=dagger.teacher_share_last)
    return replace(
        start,
        preset="gpu",
        dagger=replace(dagger, minibatch_envs=80, decay_after_steps=2000, keep_rollouts=10, precision="bf16"),
        task=replace(start.task, num_envs=GPU_WORLDS),
        align=AlignCfg(precision="bf16"),
        network=LEAN,
    )


def cpu_demo(stage: Stage) -> StudentTrainCfg:
    """Two CPU cores and minutes: a cube, near goals, a small network on coarse voxels, short sequences."""
    return StudentTrainCfg(
        preset="cpu-demo",
        stage=stage,
        teacher="dclaw4-cube",
        run=RunCfg(
            out=RUNS / f"cpu-stage{stage}", device="cpu", save_every=5, max_minutes=7.0, max_steps=16_000
        ),
        dagger=replace(SHORT_ROLLOUTS, minibatch_envs=4, epochs=4, keep_rollouts=50),
        align=AlignCfg(
            batch=64, steps=5, shapes=256, fresh_shapes=8, hands=32, points=256, validate_every=10, views=4
        ),
        task=StudentTaskCfg(num_envs=16),
        network=SMALL,
        depth=DepthCameraCfg(points=2000),
    )


PRESETS: dict[str, Callable[[Stage], StudentTrainCfg]] = {"gpu": gpu, "paper": paper, "cpu-demo": cpu_demo}
