"""Configuration of the student: noise of its clouds, and its network with presets."""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

from vd.config import Dropped
from vd.paper import PAPER

DistancePlace = Literal["before", "after"]
VoxelInput = Literal["constant", "position", "marks"]
Sense = Literal["action", "position", "velocity"]

STD_RANGE = (0.02, 1.0)
"""Standard deviation of the student's actions, as of the teachers trained here: always some exploration."""


@dataclass(frozen=True)
class NoiseCfg:
    """Augmentation of point clouds in training; each cloud draws its own, evaluation has none."""

    jitter_probability: float = PAPER.cloud.jitter_probability
    """Share of clouds with jitter."""
    jitter_std_m: float = PAPER.cloud.jitter_std_m
    """Standard deviation of the jitter of each coordinate [m]."""
    dropout_probability: float = PAPER.cloud.dropout_probability
    """Share of clouds that lose points."""
    dropout_ratio: tuple[float, float] = PAPER.cloud.dropout_ratio
    """Range of the share of points that such a cloud loses."""

    def validate(self) -> None:
        """Raise ``ValueError`` for what cannot be drawn, naming the field."""
        low, high = self.dropout_ratio
        for name, value in (
            ("jitter_probability", self.jitter_probability),
            ("dropout_probability", self.dropout_probability),
            ("dropout_ratio", low),
            ("dropout_ratio", high),
        ):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"noise.{name} = {value} must lie in [0, 1]")
        if low > high:
            raise ValueError(f"noise.dropout_ratio = {self.dropout_ratio} must be (low, high)")
        if not self.jitter_std_m >= 0.0:
            raise ValueError(f"noise.jitter_std_m = {self.jitter_std_m} must not be negative")


@dataclass(frozen=True)
class EncoderCfg:
    """Sparse residual network from voxels to one embedding of a cloud."""

    channels: tuple[int, ...] = (32, 64, 128, 128)
    """Width of each stage; every stage begins with a convolution of stride 2."""
    blocks: int = PAPER.student.blocks
    """Pre-activation residual blocks of a stage."""
    pooled_stages: int = 1
    """Stages, from the first, that halve the grid once more by max pooling after their first convolution."""
    embedding: int = PAPER.student.embedding
    """Width of the embedding."""
    inputs: tuple[VoxelInput, ...] = ("constant", "position", "marks")
    """What the network reads of every voxel. constant: the same number of each, all that the paper has; then
    only neighbours tell a voxel of the goal from one of the scene. position: where its centre is in the
    hand's base frame. marks: whether it holds points of the goal, and of the hand's own model."""
    feature: float = PAPER.cloud.feature
    """The constant feature."""

    def validate(self) -> None:
        """Raise ``ValueError`` for sizes that make no network, naming the field."""
        if not self.channels or min(self.channels) < 1:
            raise ValueError(f"encoder.channels = {self.channels} must name the width of at least one stage")
        if not self.inputs or len(set(self.inputs)) != len(self.inputs):
            raise ValueError(f"encoder.inputs = {self.inputs} must name some inputs, none twice")
        if self.blocks < 0 or self.embedding < 1:
            raise ValueError("encoder.blocks must not be negative and encoder.embedding be positive")
        if not 0 <= self.pooled_stages <= len(self.channels):
            raise ValueError(f"encoder.pooled_stages must lie in [0, {len(self.channels)}]")


@dataclass(frozen=True)
class TurnCfg:
    """Pooling that turns with a cloud, of object and goal (:mod:`vd.vision.turn`)."""

    vectors: int = 0
    """Vectors of a cloud, and tensors; 0, as in the paper: the rotation from the goal has to be read from
    the embedding of the whole cloud."""
    rounds: int = 3
    """How often points are weighted, each time by how they lie to the vectors before."""
    hidden: int = 32
    """Width of the layers that weigh a point."""
    pairs: int = 8
    """Pairs of mixtures of them; each pair makes a frame of the object and one of the goal."""
    points: int = 512
    """Voxels of object and goal that are looked at, at most."""
    match: int = 32
    """Features by which their points find each other (:mod:`vd.vision.match`); 0: they do not look."""

    def validate(self) -> None:
        """Raise ``ValueError`` for sizes that make no network, naming the field."""
        if min(self.vectors, self.match) < 0 or min(self.rounds, self.hidden, self.pairs, self.points) < 1:
            raise ValueError("turn: vectors and match must not be negative and every other size be positive")


@dataclass(frozen=True)
class StateCfg:
    """An estimate of the teacher's observation, and the teacher's layers on it (:mod:`vd.vision.state`)."""

    RETIRED: ClassVar[dict[str, Any]] = {"fingertips": False, "critic": False}
    values: int = 0
    """Length of the observation; 0, as in the paper: actions are read from the memory alone."""
    hidden: tuple[int, ...] = ()
    """Widths of the teacher's hidden layers."""
    activation: str = "elu"
    """Their activation."""
    inside: int = 256
    """Width of the layer that reads the estimate."""
    views: int = 0
    """Views in which the teacher sees its goals, one for each finger; 0: it sees the world as it is."""

    def validate(self) -> None:
        """Raise ``ValueError`` for sizes that make no network, naming the field."""
        if min(self.values, self.views) < 0 or min((self.inside, *self.hidden)) < 1:
            raise ValueError("state: values and views must not be negative and every other size be positive")


@dataclass(frozen=True)
class StudentCfg:
    """The student's network; presets are below."""

    RETIRED: ClassVar[dict[str, Any]] = {"aim": {"enabled": Dropped(False)}}
    encoder: EncoderCfg = field(default_factory=EncoderCfg)
    """From voxels to an embedding."""
    voxel_m: float = PAPER.cloud.voxel_m
    """Side of a voxel [m]."""
    goal: Literal["merged", "separate"] = "merged"
    """Goal and scene as one cloud, or with an encoder each."""
    turn: TurnCfg = field(default_factory=TurnCfg)
    """How the object is turned from the goal, read from the two directly."""
    senses: tuple[Sense, ...] = ("action", "position", "velocity")
    """What it knows besides clouds: the previous action (all that the paper has), positions and velocities of
    the joints, as the encoders report them."""
    state: StateCfg = field(default_factory=StateCfg)
    """What the teacher would observe, estimated, and the teacher's layers that act by it. Its sizes are the
    teacher's; training fills them in (``--dagger.state-weight``)."""
    action_hidden: int = 128
    """Width of the layers for the senses."""
    memory: int = PAPER.student.memory
    """Width of the GRU."""
    head_hidden: int = PAPER.student.head_hidden
    """Width of the layer after the GRU."""
    distance_hidden: int = PAPER.student.distance_hidden
    """Width of the hidden layer of a distance head."""
    distance: tuple[DistancePlace, ...] = ("before", "after")
    """Where heads predict the rotation distance: before the GRU, from this cloud alone, or after it.

    The last one is the one to stop by.
    """
    std_range: tuple[float, float] | None = STD_RANGE
    """Open interval of the standard deviation of actions; None for no bounds."""

    def validate(self) -> None:
        """Raise ``ValueError`` for what cannot be built, naming the field."""
        self.encoder.validate()
        self.turn.validate()
        self.state.validate()
        if self.turn.vectors and "marks" not in self.encoder.inputs:
            raise ValueError("student.turn needs voxels that are marked: add marks to encoder.inputs")
        if "action" not in self.senses or len(set(self.senses)) != len(self.senses):
            raise ValueError(f"student.senses = {self.senses} must hold action, and nothing twice")
        if not self.voxel_m > 0.0:
            raise ValueError(f"student.voxel_m = {self.voxel_m} must be positive")
        if len(set(self.distance)) != len(self.distance) or not self.distance:
            raise ValueError(f"student.distance = {self.distance} must name one or both of before, after")
        if min(self.action_hidden, self.memory, self.head_hidden, self.distance_hidden) < 1:
            raise ValueError("student: every width must be positive")
        if self.std_range is not None and not 0.0 < self.std_range[0] < self.std_range[1]:
            raise ValueError(f"student.std_range = {self.std_range} must be (low, high), both positive")


LEAN = StudentCfg(turn=TurnCfg(vectors=32))
"""A last stage of half the width, distance heads before and after the GRU, bounded standard deviation, and
the rotation from the goal pooled by what turns with the clouds."""

PAPER_NETWORK = replace(
    LEAN,
    turn=TurnCfg(),
    encoder=EncoderCfg(channels=PAPER.student.channels, inputs=("constant",)),
    senses=("action",),
    action_hidden=PAPER.student.action_hidden,
    distance=("before",),
    std_range=None,
)
"""The network of the paper, sizes as in its released code."""

SMALL = replace(
    LEAN,
    encoder=EncoderCfg(channels=(16, 32, 32, 32), blocks=1, embedding=64),
    memory=64,
    head_hidden=64,
    distance_hidden=64,
)
"""For processors: trains in minutes what it can."""

PRESETS = {"paper": PAPER_NETWORK, "lean": LEAN, "small": SMALL}
"""Networks by name."""
