"""The demo's gap: play hidden in a simulated servo, found, named and closed, in under a minute."""

from pathlib import Path
from typing import TYPE_CHECKING

from vd.page import Page

if TYPE_CHECKING:
    from vd.gap.result import Report

MODEL = "servo"
"""A single joint is enough to show it, and takes a quarter of a finger's time."""
EFFECT, PARAMETER, SIZE_RAD = "backlash", "width_rad", 0.06
RECORDING, ANALYSIS = "gap-recording", "gap"


def gap_commands(folder: Path, seed: int, device: str) -> list[list[str]]:
    """Arguments of ``vd-gap`` that make the recording and analyse it."""
    recording = str(folder / RECORDING)
    effect = f"{EFFECT}:{PARAMETER}={SIZE_RAD:g}"
    run = ["run", recording, "--out", str(folder / ANALYSIS), "--seed", str(seed)]
    return [
        ["hide", MODEL, "--effect", effect, "--out", recording, "--seed", str(seed)],
        run if device == "cpu" else [*run, "--device", device],
    ]


def find_hidden_gap(folder: Path, seed: int, device: str) -> None:
    """Hide the effect and let ``vd-gap`` find it.

    Args:
        folder: The demo's folder; the report is written below it.
        seed: Of the hidden machine and of the analysis.
        device: ``cpu`` or ``cuda``.

    Raises:
        RuntimeError: A command failed; it has said why.
    """
    from vd.gap import cli

    for arguments in gap_commands(folder, seed, device):
        if cli.main(arguments) != 0:
            raise RuntimeError(f"vd-gap {' '.join(arguments)} failed; the reason is above")


def gap_report(folder: Path) -> Path:
    """The page of the analysis."""
    return folder / ANALYSIS / "report.html"


def read_gap(folder: Path) -> "Report":
    """What the analysis found."""
    from vd.gap.result import Report

    return Report.read(folder / ANALYSIS / "report.json")


def add_gap(page: Page, folder: Path, base: Path) -> None:
    """Add what was found to the demo's page.

    Args:
        page: The demo's page.
        folder: The demo's folder.
        base: Folder of the page, from which links count.
    """
    from vd.gap.words import amount, plain, verdict_sentence

    report = read_gap(folder)
    page.section("A hidden gap, found and closed")
    page.text(
        "A simulation of a machine is wrong somewhere, and the first question is where. Here "
        f"{plain(EFFECT)} of {amount(SIZE_RAD, 'rad')} was hidden in a servo that shares no code with the "
        "simulation. vd-gap saw nothing but the recording of commands and positions. What it says:"
    )
    page.text(verdict_sentence(report))
    overlays = sorted((folder / ANALYSIS).glob("overlay_*.png"), key=lambda path: path.stat().st_mtime)
    if overlays:
        page.figure(
            overlays[0],
            "Command, measurement, and the simulation before and after; below, the difference.",
        )
    target = gap_report(folder).resolve().relative_to(base.resolve())
    page.link("The whole report: where, every candidate, what next", target.as_posix())
