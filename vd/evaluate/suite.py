"""Suites: command lines of ``vd-eval`` in a file, which :mod:`vd.evaluate.suite_run` runs."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from vd.command.config import from_dict

FOLDER = Path(__file__).with_name("suites")
"""Where the suites are that have a name."""
OWN_SETS = {
    "training": ("procedural-150-seed0",),
    "held-out": ("procedural-heldout",),
    "symmetric": ("symmetric",),
}
"""By group of objects the sets where none are given: ours, made on demand; the paper's are meshes.
Choices are made on training and validation, held-out judges. For validation nothing stands in: it
is left out.
"""


@dataclass(frozen=True)
class SuiteEntry:
    """One evaluation of every policy, as ``vd-eval`` is told to run it."""

    name: str
    """Of its folder."""
    teacher: str = ""
    """The command line for policies that see the simulator's state; empty: they are left out.
    POLICY stands for each policy, SET for the objects of a group."""
    camera: str = ""
    """The same for policies that see by a camera."""
    shown: str = ""
    """Where the paper shows the same, or what is changed."""

    @property
    def lines(self) -> list[str]:
        """Its command lines."""
        return [line for line in (self.teacher, self.camera) if line]


@dataclass(frozen=True)
class Claim:
    """A figure of the paper, and how ours beside it is measured."""

    text: str
    """What it is."""
    entries: tuple[str, ...]
    """Names of the evaluations that have it."""
    measure: str
    """Where it is in a row (:func:`vd.evaluate.claims.measured`)."""
    paper: str | None = None
    """Name of the paper's figure in ``PAPER.results``; None: it gives no number."""
    unit: Literal["share", "rad", "s"] = "share"
    stopped_by: str | None = None
    """Whose rule; None: that of each policy."""


@dataclass(frozen=True)
class Suite:
    """A list of evaluations, and what the paper says of them."""

    title: str
    lines: tuple[SuiteEntry, ...]
    claims: tuple[Claim, ...] = ()
    members: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """By group of objects the names of those that it takes of its sets; others take all."""
    by_aspect: bool = False
    """Whether its figures are by aspect ratio of the objects too."""


def read_suite(name: str) -> Suite:
    """A suite by name, or the file of one's own.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is no list of command lines of ``vd-eval``; names file, entry and remedy.
    """
    import yaml

    path = FOLDER / f"{name}.yaml"
    if not path.is_file():
        path = Path(name)
    if not path.is_file():
        known = ", ".join(file.stem for file in sorted(FOLDER.glob("*.yaml")))
        raise FileNotFoundError(f"--suite: there is no {name}; give {known}, or a YAML file")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        suite = from_dict(Suite, values if isinstance(values, dict) else {})
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"--suite {path}: {error}") from error
    names = set()
    for entry in suite.lines:
        if entry.name in names:
            raise ValueError(f"--suite {path}: {entry.name} is there twice; rename one")
        names.add(entry.name)
        if not entry.lines or not all(line.startswith("vd-eval ") for line in entry.lines):
            raise ValueError(
                f"--suite {path}: {entry.name} has no line 'vd-eval POLICY ...'; give one for "
                "teacher, camera or both"
            )
    return suite
