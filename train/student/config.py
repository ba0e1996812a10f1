"""Settings of the student's training and their presets. Pure data, cheap to import."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from vd.config import Renamed
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.train.config import RunCfg
from vd.vision.cfg import LEAN, PAPER_NETWORK, EncoderCfg, NoiseCfg, StudentCfg

Stage = Literal[0, 1, 2]
PresetName = Literal["gpu", "paper", "cpu-demo", "cpu-overfit"]

PRETRAINING, SYNTHETIC, RENDERED = 0, 1, 2
"""Stages: random scenes without simulation; complete clouds; clouds of a depth camera."""
STUDENT_NAME = "student.pt"
"""The student of a run, in its folder: what later stages start from, without optimiser and environments."""
RUNS = Path("runs/student")
"""Parent of the default folders stage0, stage1 and stage2."""


@dataclass
class DaggerCfg:
    """Imitation of the teacher on what the student does (DAgger), stages 1 and 2."""

    rollout_steps: int = PAPER.dagger.rollout_steps
    """Control steps of every world between two updates; gradients flow through all of them."""
    RETIRED: ClassVar[dict[str, Any]] = {
        "minibatch_worlds": Renamed("minibatch_envs"),
        "validation_worlds": Renamed("validation_envs"),
    }
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
    state_weight: float = 0.0
    """Weight of the squared error of an estimate of the teacher's observation, normalised, on which the
    teacher's own layers act (:mod:`vd.vision.state`). 0, as in the released code: no such head. A student
    to begin from decides for itself whether it has one."""
    match_weight: float = 0.0
    """Weight of how far points of the object are found from where they are on the goal, for a network whose
    points look for each other (``--network.turn.match``)."""
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
    same_scene: bool = False
    """Begin every rollout in the same states, with the same disturbances: can they be learned by heart?"""
    validation_envs: int = 0
    """Environments that nothing is learned from: their first episode is the fixed set of ``validation/*``."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of the encoder's products; memory, heads, losses and weights stay in fp32."""


@dataclass
class PretrainCfg:
    """Stage 0: random joints, objects, poses and goals, without simulation."""

    batch: int = 512
    """Clouds of an optimiser step on one GPU."""
    steps: int = 50
    """Optimiser steps of an iteration."""
    learning_rate: float = PAPER.dagger.learning_rate
    """Of AdamW, until the decay."""
    decay_after_steps: int = 0
    """Optimiser steps after which the learning rate falls as 1 / sqrt(steps); 0: never."""
    amsgrad: bool = True
    """Never forget the largest gradients, as in imitation."""
    grad_norm: float = PAPER.dagger.grad_norm
    """Gradient norm is clipped to this."""
    distance: Literal["scalar", "6d"] = "scalar"
    """Predict the angle to the goal, or the relative rotation by two columns of its matrix (Zhou 2019)."""
    embedding: Literal["single", "split"] = "single"
    """All predictions from the whole embedding, or each from parts of it: object, goal, hand."""
    category_weight: float = 1.0
    """Weight of the cross-entropy of the object's category; 0 leaves the prediction out."""
    distance_weight: float = 1.0
    """Weight of the squared error of the distance (or of the two columns); 0 leaves it out."""
    joint_weight: float = 1.0
    """Weight of the squared error of joint positions, scaled to [-1, 1]; 0 leaves it out."""
    match_weight: float = 0.0
    """Weight of how far points are found from where they are on the goal, as in imitation."""
    near_share: float = 0.0
    """Share of goals at an angle uniform in [0, pi]. The others are uniform on SO(3), where near goals are
    rare: 1 in 300 lies within 0.4 rad."""
    rendered_share: float = 0.0
    """Share of the scenes that are seen by the depth camera; the others are whole, as in stage 1."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of the encoder's products."""


@dataclass
class StudentTaskCfg:
    """The environments; physics, actions and hand are those of the teacher's training."""

    RETIRED: ClassVar[dict[str, Any]] = {"num_worlds": Renamed("num_envs")}
    objects: tuple[str, ...] = ()
    """Object sets: names or folders of object USDs; the teacher's by default."""
    num_envs: int = PAPER.dagger.synthetic_envs
    """Environments simulated side by side."""
    seed: int = 0
    """Seed of every random draw."""
    randomise: bool | None = None
    """Domain randomisation and disturbances; as the teacher was trained by default. The teacher always sees
    the state without noise."""
    at_rest: bool | None = None
    """Start objects at rest on the table; as the teacher was trained by default."""
    max_goal_angle_rad: float | None = None
    """Largest angle from object to goal [rad]; as the teacher was trained by default."""


@dataclass
class StudentTrainCfg:
    """Train the student."""

    preset: PresetName = "gpu"
    """Settings to start from; every other flag overrides one of them."""
    stage: Stage = 1
    """0: pre-train the encoder on random scenes; 1: imitate on complete synthetic clouds; 2: on clouds of a
    depth camera and of the hand's own joints."""
    teacher: str | None = None
    """Policy to imitate, also the source of hand and task: a policy.pt, a run's folder, or the name of an
    installed one."""
    init: Path | None = None
    """Student to begin from: student.pt or a checkpoint. Stage 2 takes ../stage1/student.pt of --out by
    default."""
    from_scratch: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let stage 2 begin with a policy of random weights: several times slower than stage 1 first."""
    resume: str | None = None
    """Go on from a checkpoint of --out: latest (a bare --resume), a file, or auto: the latest, and a new
    run where there is none."""
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the optical frame (x right, y down, z forward) in the hand's base frame, for stage 2: position
    [m] and quaternion xyzw; the hand's own camera by default."""
    run: Annotated[RunCfg, tyro.conf.arg(name="")] = field(default_factory=RunCfg)
    dagger: DaggerCfg = field(default_factory=DaggerCfg)
    pretrain: PretrainCfg = field(default_factory=PretrainCfg)
    task: StudentTaskCfg = field(default_factory=StudentTaskCfg)
    network: StudentCfg = field(default_factory=StudentCfg)
    noise: NoiseCfg = field(default_factory=NoiseCfg)
    depth: DepthCameraCfg = field(default_factory=DepthCameraCfg)


def paper(stage: Stage) -> StudentTrainCfg:
    """Network and numbers of the paper's released code."""
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
    epochs=2,
    learning_rate=1e-3,
    warmup_steps=100,
    amsgrad=False,
    grad_norm=1.0,
    imitation="squared",
    pose_weight=2.0,
    state_weight=2.0,
    match_weight=1.0,
    clip_labels=True,
    teacher_share=1.0,
    teacher_share_last=0.2,
    teacher_share_iterations=20,
    keep_rollouts=8,
    reset=False,
)
"""What learns soonest: a part of each episode at a time, learned with those before, the teacher at first."""


def gpu(stage: Stage) -> StudentTrainCfg:
    """One GPU: the lean network, the student's own joints, rollouts kept, half precision.

    The numbers of the released code do not learn in hours.
    """
    start = paper(stage)
    dagger, network = SHORT_ROLLOUTS, LEAN
    if stage == RENDERED:  # it begins from a student that acts already
        dagger = replace(dagger, learning_rate=5e-4, teacher_share=dagger.teacher_share_last)
    return replace(
        start,
        preset="gpu",
        dagger=replace(
            dagger,
            rollout_steps=20,
            minibatch_envs=80,
            decay_after_steps=2000,
            keep_rollouts=10,
            validation_envs=40,
            precision="bf16",
        ),
        task=replace(start.task, num_envs=GPU_WORLDS),
        pretrain=PretrainCfg(
            batch=1024,
            learning_rate=1e-3,
            decay_after_steps=1000,
            amsgrad=False,
            distance="6d",
            match_weight=1.0,
            near_share=0.5,
            precision="bf16",
        ),
        network=network,
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
        dagger=replace(
            SHORT_ROLLOUTS,
            rollout_steps=20,
            minibatch_envs=4,
            epochs=4,
            keep_rollouts=50,
            validation_envs=2,
        ),
        pretrain=PretrainCfg(
            batch=64, steps=10, learning_rate=1e-3, amsgrad=False, distance="6d", near_share=0.5
        ),
        task=StudentTaskCfg(num_envs=16),
        network=SMALL_NETWORK,
        depth=DepthCameraCfg(points=2000),
    )


def cpu_overfit(stage: Stage) -> StudentTrainCfg:
    """One scene again and again, on the CPU: a check that all between clouds and labels is joined up.

    The teacher acts, so that it is the same sequence of states every time: the action error has to vanish.
    """
    start = cpu_demo(stage)
    return replace(
        start,
        preset="cpu-overfit",
        run=replace(start.run, out=RUNS / f"cpu-overfit-stage{stage}", max_minutes=2.0, max_steps=800),
        dagger=replace(
            start.dagger,
            minibatch_envs=1,
            epochs=8,
            keep_rollouts=1,
            teacher_share_last=1.0,
            validation_envs=0,
            reset=True,
            same_scene=True,
        ),
        task=replace(start.task, num_envs=1),
    )


SMALL_NETWORK = StudentCfg(
    encoder=EncoderCfg(channels=(16, 32, 32), blocks=1, embedding=64),
    voxel_m=0.01,
    action_hidden=16,
    memory=64,
    head_hidden=64,
    distance_hidden=32,
)
"""A hundredth of the paper's network, on voxels of 1 cm."""

PRESETS: dict[str, Callable[[Stage], StudentTrainCfg]] = {
    "gpu": gpu,
    "paper": paper,
    "cpu-demo": cpu_demo,
    "cpu-overfit": cpu_overfit,
}


def validate(cfg: StudentTrainCfg) -> None:
    """Refuse settings that cannot train.

    Raises:
        ValueError: The flag, its value and what it has to be.
    """
    dagger, pretrain, run = cfg.dagger, cfg.pretrain, cfg.run
    positive = {
        "--dagger.rollout-steps": dagger.rollout_steps,
        "--dagger.minibatch-envs": dagger.minibatch_envs,
        "--dagger.epochs": dagger.epochs,
        "--dagger.keep-rollouts": dagger.keep_rollouts,
        "--dagger.learning-rate": dagger.learning_rate,
        "--dagger.grad-norm": dagger.grad_norm,
        "--pretrain.batch": pretrain.batch,
        "--pretrain.steps": pretrain.steps,
        "--pretrain.learning-rate": pretrain.learning_rate,
        "--pretrain.grad-norm": pretrain.grad_norm,
        "--num-envs": cfg.task.num_envs,
        "--max-steps": run.max_steps,
        "--save-every": run.save_every,
        "--max-minutes": 1.0 if run.max_minutes is None else run.max_minutes,
    }
    for flag, value in positive.items():
        if not value > 0:
            raise ValueError(f"{flag} is {value}; it has to be positive")
    run.check_kept()
    weights = {
        "--dagger.distance-weight": dagger.distance_weight,
        "--dagger.pose-weight": dagger.pose_weight,
        "--dagger.state-weight": dagger.state_weight,
        "--dagger.match-weight": dagger.match_weight,
        "--dagger.teacher-share-iterations": dagger.teacher_share_iterations,
        "--dagger.warmup-steps": dagger.warmup_steps,
        "--dagger.decay-after-steps": dagger.decay_after_steps,
        "--dagger.validation-envs": dagger.validation_envs,
        "--pretrain.decay-after-steps": pretrain.decay_after_steps,
        "--pretrain.category-weight": pretrain.category_weight,
        "--pretrain.distance-weight": pretrain.distance_weight,
        "--pretrain.joint-weight": pretrain.joint_weight,
        "--pretrain.match-weight": pretrain.match_weight,
    }
    for flag, value in weights.items():
        if value < 0:
            raise ValueError(f"{flag} is {value}; it must not be negative")
    shares = {
        "--dagger.teacher-share": dagger.teacher_share,
        "--dagger.teacher-share-last": dagger.teacher_share_last,
        "--pretrain.near-share": pretrain.near_share,
        "--pretrain.rendered-share": pretrain.rendered_share,
    }
    for flag, share in shares.items():
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"{flag} is {share}; it has to be in [0, 1]")
    if dagger.same_scene and not dagger.reset:
        raise ValueError(
            "--dagger.same-scene begins episodes with every rollout; leave --dagger.no-reset out"
        )
    if cfg.camera is not None and cfg.stage != RENDERED:
        raise ValueError("--camera is for --stage 2; the other stages see complete clouds")
    cfg.network.validate()
    cfg.noise.validate()
    cfg.depth.validate()
