"""Settings of the networks that see."""

from dataclasses import dataclass, fields

from vd.paper import PAPER

SEEN_POINTS = 512
"""Points of what is seen that a policy looks at: as many as its network learns from."""


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
    """Patches of a cloud. With 128, 6 layers and a width of 192 first looks are no better."""
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
            raise ValueError(
                f"--align.network.heads = {self.heads} must divide the width {self.width}"
            )


@dataclass(frozen=True)
class StudentCfg:
    """Sizes of the student (:mod:`vd.vision.student`), by default such that one CPU core decides in time.

    The paper's are channels 32, 64, 128, 256 and two blocks.
    """

    channels: tuple[int, ...] = (32, 64, 96, 128)
    """Width of each stage; each halves the grid."""
    blocks: int = 1
    """Residual blocks of a stage."""
    flow: int = 256
    """Width of the layers that predict by how much the goal's voxels are to move."""
    senses: int = 256
    """Width of the layers that read joints, last action and belief."""
    memory: int = 256
    """Width of the GRU."""
    head: int = 512
    """Width of the layers before action and distance."""
    voxel_m: float = PAPER.cloud.voxel_m
    """Side of a voxel [m]."""
    reach_m: float = 0.12
    """Points are read up to this far from where the object is believed to be [m]: the largest
    objects reach 8 cm."""

    def validate(self) -> None:
        """Raise ``ValueError`` for what cannot be built, naming the field."""
        if not self.channels or min(self.channels) < 1:
            raise ValueError(f"student.channels = {self.channels} must name positive widths")
        if self.blocks < 0:
            raise ValueError(f"student.blocks = {self.blocks} must not be negative")
        for name in ("voxel_m", "reach_m"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"student.{name} = {getattr(self, name)} must be positive")
        for name in ("flow", "senses", "memory", "head"):
            if getattr(self, name) < 1:
                raise ValueError(f"student.{name} must be positive")
