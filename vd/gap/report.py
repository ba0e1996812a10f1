"""What the page of a gap report shows, and its figures as PNG files beside it."""

import math
from collections.abc import Iterable
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from vd.files import atomic_path
from vd.gap import figures, words
from vd.gap.result import UNITS, Candidate, NamedEffect, Predictions, Report, parameters_of
from vd.gap.words import amount, mrad, percent, plain
from vd.kernels.servo.effects import EFFECTS
from vd.page import FIGURE_DPI, write_html

REPORT_JSON, REPORT_HTML = "report.json", "report.html"
FIGURES = ("gap.png", "overlay_*.png", "residual_*.png", "evidence_*.png")
"""Those of an earlier analysis go; other motions were drawn."""

_VERDICTS = {
    "effects": "Missing effect named",
    "no_gap": "No gap",
    "ambiguous": "Gap found, cause ambiguous",
    "under_excited": "Motions do not determine the model",
    "unknown": "Gap found, cause unknown",
}
_DECISIONS = {"named": "accepted: ", "tied": "", "rejected": "rejected: "}

Row = tuple[str, ...]


def write_report(report: Report, curves: Predictions | None, folder: Path) -> list[Path]:
    """Write ``report.json``, ``report.html`` and the figures.

    Args:
        report: What was found.
        curves: Curves of the overlays; None leaves them out.
        folder: Folder to write to.

    Returns:
        The files written.
    """
    for path in (path for pattern in FIGURES for path in Path(folder).glob(pattern)):
        path.unlink()
    report.write(folder / REPORT_JSON)
    with mpl.rc_context(figures.STYLE):
        chosen = figures.chosen_overlays(report, curves) if curves else []
        gap = _picture(folder / "gap.png", figures.gap_figure(report))
        overlays = [
            (
                _picture(
                    folder / f"overlay_{joint}_{Path(curves.files[index]).stem}.png",
                    figures.overlay_figure(report, curves, joint, index),
                ),
                f"{joint} in {curves.files[index]}",
            )
            for joint, index in chosen
        ]
        residuals = [
            (
                _picture(folder / f"residual_{joint}.png", figures.residual_figure(report, curves, joint)),
                joint,
            )
            for joint in dict.fromkeys(joint for joint, _ in chosen)
        ]
    evidence = sorted(
        report.evidence, key=lambda row: (*_round(row), -row.gain if row.gain == row.gain else math.inf)
    )
    won = {_round(row) for row in evidence if row.decision == "named"}
    write_html(
        folder / REPORT_HTML,
        "gap.html",
        report=report,
        words=words,
        headline=_headline(report),
        joints=[(one.joint, _VERDICTS[one.verdict].lower(), plain(one.reason)) for one in report.joints],
        gap=gap,
        overlays=overlays,
        residuals=residuals,
        trajectories=[
            (one.joint, one.excitation, one.file, mrad(one.baseline_rmse_rad), mrad(one.identified_rmse_rad))
            for one in report.trajectories
        ],
        evidence=[_evidence_row(row) for row in evidence],
        kept=[
            _evidence_row(row)[:-1] for row in evidence if _round(row) in won and row.decision != "rejected"
        ],
        not_fitted=[plain(name) for name in EFFECTS if name not in {row.name for row in evidence}],
        parameters=[*_parameters(report.effects), *_parameters(report.provisional, " (not named)")],
        alternatives=[
            (
                plain(effect.name),
                plain(one.name),
                mrad(one.held_out_rmse_rad),
                words.mrad_range(one.difference_ci95),
            )
            for effect in report.effects
            for one in effect.alternatives
        ],
        model=_model(report),
        glossary=[(plain(name), effect.meaning) for name, effect in EFFECTS.items()],
    )
    return [folder / REPORT_HTML, folder / REPORT_JSON, gap, *(path for path, _ in (*overlays, *residuals))]


def _picture(path: Path, figure: Figure) -> Path:
    """Write a figure as a PNG file, whose bytes the page embeds."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=FIGURE_DPI)
    return path


def _headline(report: Report) -> list[Row]:
    held = report.held_out
    answer = words.listing(
        [plain(n) for n in dict.fromkeys(e.name for e in report.effects)] or ["nothing named"]
    )
    if not report.effects and report.open_sets:
        answer = "; ".join(words.causes(group) for group in report.open_sets)
    tiles = [
        (_VERDICTS[report.verdict], "verdict", answer),
        (mrad(held.baseline_rmse_rad), "gap before", "error on held-out motions, plain servo model fitted"),
    ]
    if report.effects or report.provisional:
        note = f"{percent(held.reduction)} less (95 %: {words.percent_range(held.ci95)})"
        tiles.append((mrad(held.identified_rmse_rad), "gap after", note))
    floor = mrad(report.noise_floor_rad)
    return [*tiles, (floor, "noise floor", "what no model can explain: resolution, repeatability")]


def _round(row: Candidate) -> tuple[tuple[str, ...], int]:
    return row.joints, row.round


def _evidence_row(row: Candidate) -> Row:
    units = parameters_of(row.name)
    known = math.isfinite(row.gain)
    return (
        words.joints_text(row.joints),
        plain(row.name) + (" (placebo)" if row.placebo else ""),
        ", ".join(map(plain, row.given)),
        mrad(row.held_out_rmse_rad) if known else "not fitted",
        f"{percent(row.gain)} ({words.percent_range(row.gain_ci95)})" if known else "",
        f"{_DECISIONS[row.decision]}{plain(row.reason)}",
        ", ".join(f"{key} {amount(value, units[key].unit)}" for key, value in row.parameters.items()),
    )


def _parameters(effects: Iterable[NamedEffect], note: str = "") -> list[Row]:
    return [
        (
            words.joints_text(effect.joints),
            plain(effect.name) + note,
            f"{name} = {words.estimate(one)}",
            "" if note else percent(effect.confidence),
        )
        for effect in effects
        for name, one in effect.parameters.items()
    ]


def _model(report: Report) -> list[Row]:
    """Parameters of the plain servo model of every joint, before and after."""
    return [
        (
            joint,
            f"{name} [{words.unit_text(UNITS[name])}]",
            f"{before[name]:.3g}" if name in before else "",
            f"{after[name]:.3g}",
        )
        for joint, after in report.identified.parameters.items()
        for before in [report.baseline.parameters[joint]]
        for name in after
    ]
