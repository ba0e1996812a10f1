"""Settings of the demo, :mod:`vd.train.demo`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

OBJECTS = ("cube",)
"""Built-in sets that the demo trains on. On two cores a second shape needs more time than there is."""


class DemoError(RuntimeError):
    """A stage failed; the message says which and what to do."""


@dataclass
class DemoCfg:
    """Author, train, evaluate, record: one page of results from the machine at hand."""

    out: Path = Path("demo")
    """Folder of everything the demo writes; the page is index.html."""
    minutes: float = 14.6
    """Time for everything [min]; training gets what the other stages leave, from about 6 on."""
    seed: int = 0
    """Seed of assets, training and evaluation."""
    meshes: Path | None = None
    """Folder of OBJ, STL, PLY or GLB files to import, smallest first, and to try the policy on."""
    objects: tuple[str, ...] = OBJECTS
    """Built-in object sets to train on."""
    preset: Literal["auto", "cpu-demo", "cube", "gpu"] = "auto"
    """Preset of vd-train; auto takes cube where there is a GPU, which learns within minutes there."""
    num_worlds: int | None = None
    """Worlds of the training; the preset's by default."""
    max_steps: int | None = None
    """Control steps after which training ends at the latest; the preset's by default."""

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        if self.minutes <= 0.0:
            raise ValueError(f"--minutes is {self.minutes}; it has to be positive")
        if self.meshes is not None and not self.meshes.exists():
            raise ValueError(
                f"--meshes: there is no {self.meshes}; name a folder of OBJ, STL, PLY or GLB files"
            )
        for flag, value in {"--num-worlds": self.num_worlds, "--max-steps": self.max_steps}.items():
            if value is not None and value < 1:
                raise ValueError(f"{flag} is {value}; it has to be positive")
        if not self.objects:
            raise ValueError("--objects is empty; name a set, such as cube")
