"""Configuration of the student: noise of its clouds, and its network with presets."""

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal

from vd.config import Dropped, Renamed
from vd.paper import PAPER

DistancePlace = Literal["before", "after"]
VoxelInput = Literal["constant", "position", "marks"]
Proprioception = Literal["action", "position", "velocity"]

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
        for name in ("jitter_probability", "dropout_probability"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"noise.{name} = {getattr(self, name)} must lie in [0, 1]")
        if not 0.0 <= low <= high <= 1.0:
            raise ValueError(f"noise.dropout_ratio = {self.dropout_ratio} must be (low, high) within [0, 1]")
        if not self.jitter_std_m >= 0.0:
            raise ValueError(f"noise.jitter_std_m = {self.jitter_std_m} must not be negative")


@dataclass(frozen=True)
class EncoderCfg:
    """Sparse residual network from voxels to one embedding of a cloud."""

    RETIRED: ClassVar[dict[str, Any]] = {"feature": PAPER.cloud.feature}
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
class StudentCfg:
    """The student's network; presets are below."""

    RETIRED: ClassVar[dict[str, Any]] = {
        "aim": {"enabled": Dropped(False)},
        "senses": Renamed("proprioception"),
        "goal": "merged",
        "turn": {"vectors": 0},
        "state": {"values": 0},
    }
    encoder: EncoderCfg = field(default_factory=EncoderCfg)
    """From voxels to an embedding."""
    voxel_m: float = PAPER.cloud.voxel_m
    """Side of a voxel [m]."""
    proprioception: tuple[Proprioception, ...] = ("action", "position", "velocity")
    """What it knows besides clouds: the previous action (all that the paper has), positions and velocities of
    the joints, as the encoders report them."""
    action_hidden: int = 128
    """Width of the layers for proprioception."""
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

    @property
    def marked(self) -> bool:
        """Whether voxels are marked by whether goal or hand have points in them."""
        return "marks" in self.encoder.inputs

    def validate(self) -> None:
        """Raise ``ValueError`` for what cannot be built, naming the field."""
        self.encoder.validate()
        known = self.proprioception
        if "action" not in known or len(set(known)) != len(known):
            raise ValueError(f"student.proprioception = {known} must hold action, and nothing twice")
        if not self.voxel_m > 0.0:
            raise ValueError(f"student.voxel_m = {self.voxel_m} must be positive")
        if len(set(self.distance)) != len(self.distance) or not self.distance:
            raise ValueError(f"student.distance = {self.distance} must name one or both of before, after")
        if min(self.action_hidden, self.memory, self.head_hidden, self.distance_hidden) < 1:
            raise ValueError("student: every width must be positive")
        if self.std_range is not None and not 0.0 < self.std_range[0] < self.std_range[1]:
            raise ValueError(f"student.std_range = {self.std_range} must be (low, high), both positive")


LEAN = StudentCfg()
"""A last stage of half the width, marked voxels, distance heads before and after the GRU, and a bounded
standard deviation."""

PAPER_NETWORK = replace(
    LEAN,
    encoder=EncoderCfg(channels=PAPER.student.channels, inputs=("constant",)),
    proprioception=("action",),
    action_hidden=PAPER.student.action_hidden,
    distance=("before",),
    std_range=None,
)
"""The network of the paper, sizes as in its released code."""

SMALL = StudentCfg(
    encoder=EncoderCfg(channels=(16, 32, 32), blocks=1, embedding=64),
    voxel_m=0.01,
    action_hidden=16,
    memory=64,
    head_hidden=64,
    distance_hidden=32,
)
"""For processors: a hundredth of the paper's network, on voxels of 1 cm."""

PRESETS = {"paper": PAPER_NETWORK, "lean": LEAN, "small": SMALL}
"""Networks by name."""


@dataclass(frozen=True)
class AlignmentCfg:
    """Sizes of the network that turns a goal's cloud onto a seen one (:mod:`vd.vision.alignment`)."""

    width: int = 128
    """Numbers of a token."""
    layers: int = 4
    """Layers of attention among the tokens of both clouds."""
    heads: int = 4
    """Heads of each; they divide the width."""
    tokens: int = 96
    """Patches of a cloud. The larger network that was tried has 128, 6 layers and a width of 192."""
    neighbours: int = 16
    """Points of a patch: of some hundred they reach about 2 cm."""
    patch: int = 64
    """Width of what reads the points of a patch."""

    def validate(self) -> None:
        """Raise ``ValueError`` for what cannot be built, naming the field."""
        for field_ in fields(self):
            if getattr(self, field_.name) < 1:
                raise ValueError(f"--align.network.{field_.name} must be positive")
        if self.width % self.heads:
            raise ValueError(f"--align.network.heads = {self.heads} must divide the width {self.width}")


@dataclass(frozen=True)
class SearchCfg:
    """How rotations are searched for with that network."""

    passes: int = 2
    """Passes that each of the 24 starts of a first look takes."""
    kept: int = 2
    """Hypotheses kept from look to look: the best, and others that may turn out better."""
    restart_looks: int = 3
    """Looks after which the last hypothesis begins anew elsewhere: a start has come as near as it will."""
