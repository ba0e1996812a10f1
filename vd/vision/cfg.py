"""Settings of the network that sees."""

from dataclasses import dataclass, fields

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
