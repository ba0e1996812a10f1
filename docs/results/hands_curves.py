"""Draw hands-curves.png: what both hands' teachers reach on held-out shapes as training goes on.

Every figure is read from the tables of runs.md, and of first-runs.md for the way of the first two runs.
The way to a policy goes back through "starts from", from the row that says that it ships.

Run from the repository's root: python docs/results/hands_curves.py
"""

import re
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from vd.paper import PAPER

HERE = Path(__file__).parent
NUMBER = r"([\d.]+)"
RATE = re.compile(rf"{NUMBER}(?: %)?(?:\*\*)? \({NUMBER} to {NUMBER}\)")
"""A share in per cent and its interval: ``**84.8 %** (75.3 to 89.8)``."""
FIRST = {"d3": "`dclaw3`", "d4b": "`dclaw4`, minibatch 8192"}
"""What first-runs.md calls the runs that both ways begin with."""


class Point(NamedTuple):
    """Held-out episodes within 0.4 rad [%] after so many million control steps and GPU hours in all."""

    steps: float
    hours: float
    rate: float
    low: float
    high: float


def rows(page: str, heading: str) -> list[list[str]]:
    """Cells of the table under a heading, its first two lines apart."""
    section = (HERE / page).read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip(" ") for cell in line.strip("|").split("|")] for line in lines[2:]]


RUNS = {row[0]: row for row in rows("runs.md", "Hypotheses and outcomes")}


class Way(NamedTuple):
    """The points of a run and of those that led to it, from nothing, and what all of them took."""

    points: list[Point]
    steps: float
    hours: float


def way(run: str) -> Way:
    """The way to a run. Runs for the air, judged there, add their steps and hours and no point."""
    _, _, parent, added, hours, outcome = RUNS[run]
    before, steps, spent = Way([], 0.0, 0.0) if parent == "nothing" else way(parent.split(",")[0])
    steps, spent = steps + float(added), spent + float(hours)
    within = [
        Point(at, spent * at / steps, *found) for at, found in _first(FIRST.get(run, run)) if at < steps
    ]
    end = RATE.search(outcome)
    if end is None:
        raise ValueError(f"runs.md, row {run}: no share within 0.4 rad with its interval in {outcome!r}")
    judged_in_air = "in the air" in outcome[: end.start()]
    last = [] if judged_in_air else [Point(steps, spent, *map(float, end.groups()))]
    return Way([*before, *within, *last], steps, spent)


def _first(name: str) -> list[tuple[float, tuple[float, ...]]]:
    """What first-runs.md has of a run: million steps, and share with interval."""
    found, current = [], ""
    for label, _, _, share, *_ in rows("first-runs.md", "Rates while training"):
        match = re.match(rf"(.*), {NUMBER} M", label.strip("*"))
        if match:
            current = current if match[1] == "the same" else match[1]
            if current == name:
                found.append((float(match[2]), tuple(map(float, RATE.search(share).groups()))))  # type: ignore[union-attr]
    return found


def shipped(policy: str) -> str:
    """The run whose policy is installed under a name."""
    (run,) = (name for name, row in RUNS.items() if f"Ships as `{policy}`" in row[-1])
    return run


SERIES = (
    ("three fingers", shipped("dclaw3-table"), "#0072B2"),
    ("four fingers", shipped("dclaw4-table"), "#D55E00"),
    ("three, our own objects alone", shipped("dclaw3-procedural"), "#009E73"),
)


def main() -> None:
    """Write hands-curves.png beside this file."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
    for axis, column, label in (
        (axes[0], "steps", "control steps [million]"),
        (axes[1], "hours", "GPU hours (H200, H100)"),
    ):
        for name, run, colour in SERIES:
            points = way(run).points
            x, rate = [getattr(p, column) for p in points], [p.rate for p in points]
            spread = [[p.rate - p.low for p in points], [p.high - p.rate for p in points]]
            axis.errorbar(x, rate, yerr=spread, color=colour, marker="o", capsize=3, label=name)
        student = 100.0 * PAPER.results.table_held_out[0]
        axis.axhline(student, color="0.5", linestyle="--", label="the paper's student, three fingers")
        axis.set(xlabel=label, xlim=(0.0, None), ylim=(0.0, 100.0))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("held-out episodes within 0.4 rad [%]")
    axes[1].legend(loc="lower right", fontsize="small")
    figure.savefig(HERE / "hands-curves.png", dpi=110)


if __name__ == "__main__":
    main()
