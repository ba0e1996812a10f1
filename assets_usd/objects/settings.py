"""How meshes are imported: the options of ``vd-assets import``."""

from dataclasses import dataclass
from typing import Literal

from vd.assets_usd.hands import check_hand_name
from vd.assets_usd.objects.geometry import MeshError
from vd.command.config import require

LEAST_THRESHOLD = 0.01
"""CoACD takes no smaller one."""

DENSITIES_KG_M3 = (10.0, 23000.0)
"""Least and largest density of an object: from foam to osmium. What is beyond is a mistaken
unit.
"""


@dataclass(frozen=True)
class ImportSettings:
    """What decides the objects that are made of meshes."""

    units: Literal["auto", "mm", "cm", "m", "in"] = "auto"
    """Unit of the meshes. auto: what the file declares (GLB, USD), else m, mm or cm, whichever
    needs the least rescaling. Inches are never guessed."""
    hand: str = "dclaw3"
    """Hand that the objects have to fit: its name or USD file."""
    keep_size: bool = False
    """Keep the real size, also of what does not fit the hand. The unit must be known."""
    density: float | None = None
    """Density that gives each object its mass [kg/m3]; plastic has about 1000, aluminium 2700,
    steel 7850.
    """
    mass: float | None = None
    """Mass of each object [kg]; without this and --density 0.1. Training draws masses of its own
    unless its randomisation is off."""
    max_hulls: int = 32
    """Most convex parts per object. Eight are tried first, and more where these are off by more
    than 15 %.
    """
    threshold: float = 0.08
    """CoACD's concavity threshold, 0.01-1: smaller is finer and slower."""
    mcts_iterations: int = 20
    """CoACD's search effort; more is finer and slower."""
    time_limit: float = 120.0
    """Processor time [s] of one decomposition, after which a mesh falls back to a coarser one."""
    licence: str = "unknown"
    """Licence to record where no objects.csv (columns name, source) lies with the meshes."""

    def check(self) -> None:
        """Refuse what cannot be meant.

        Raises:
            ValueError: Names the option.
        """
        check_hand_name(self.hand)
        if self.density is not None and self.mass is not None:
            raise MeshError("--density and --mass both give the mass; leave one out")
        low, high = DENSITIES_KG_M3
        if self.density is not None and not low <= self.density <= high:
            raise MeshError(
                f"--density {self.density:g}: {low:g} to {high:g} kg/m3 are possible; water has "
                f"1000"
            )
        if not LEAST_THRESHOLD <= self.threshold <= 1.0:
            raise MeshError(f"--threshold {self.threshold:g}: give {LEAST_THRESHOLD:g} to 1")
        require(self, "--", "positive", "mass max_hulls mcts_iterations time_limit")

    def check_unit(self, declared: float | None) -> None:
        """Refuse to keep the size of a mesh whose unit (``declared``, m) is not known.

        Raises:
            MeshError: Its reason names the option.
        """
        if self.keep_size and self.units == "auto" and declared is None:
            raise MeshError(
                "its file declares no unit, so its real size is not known; add --units mm (cm, m, "
                "in)"
            )
