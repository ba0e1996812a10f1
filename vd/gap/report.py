"""What the page of a gap report shows, and its figures as PNG files beside it."""

import math
from collections.abc import Iterable
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from vd.command.files import atomic_path
from vd.command.page import FIGURE_DPI, write_html
from vd.gap import figures, words
from vd.gap.coordinates import BASELINE_PARAMETERS
from vd.gap.result import Candidate, JointGap, NamedEffect, Predictions, Report, parameters_of
from vd.gap.words import amount, mrad, percent, plain
from vd.kernels.servo.effects import EFFECTS

REPORT_JSON, REPORT_HTML = "report.json", "report.html"
FIGURES = ("gap.png", "overlay_*.png", "residual_*.png")
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


def write_report(report: Report, curves: Predictions, folder: Path) -> None:
    """Write ``report.json``, ``report.html`` and the figures.

    Args:
        report: What was found.
        curves: What the figures draw.
        folder: Folder to write to.
    """
    for path in (path for pattern in FIGURES for path in Path(folder).glob(pattern)):
        path.unlink()
    report.write(folder / REPORT_JSON)

    def draw(name: str, figure: Figure) -> Path:
        path = folder / f"{name}.png"
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=FIGURE_DPI)
        return path

    overlays, residuals = [], {}
    with mpl.rc_context(figures.STYLE):
        gap = draw("gap", figures.gap_figure(report))
        for joint, index in figures.chosen_overlays(report, curves):
            file = curves.files[index]
            overlay = figures.overlay_figure(report, curves, joint, index)
            overlays.append(
                (draw(f"overlay_{joint}_{Path(file).stem}", overlay), f"{joint} in {file}")
            )
            if joint not in residuals:
                residual = figures.residual_figure(report, curves, joint)
                residuals[joint] = draw(f"residual_{joint}", residual)
    joints = [one.joint for one in report.joints]
    evidence = sorted(
        report.evidence,
        key=lambda r: (joints.index(r.joints[0]), r.round, math.isnan(r.gain), -r.gain),
    )
    rivals = {
        ((one.joint,), name) for one in report.joints for group in one.open_sets for name in group
    }
    kept = [
        _evidence_row(row)[:-1]
        for row in evidence
        if row.decision == "named" or (row.decision == "tied" and (row.joints, row.name) in rivals)
    ]
    write_html(
        folder / REPORT_HTML,
        "gap.html",
        report=report,
        words=words,
        headline=_headline(report),
        joints=[_joint_row(report, one) for one in report.joints],
        gap=gap,
        overlays=overlays,
        residuals=residuals,
        trajectories=[
            (
                one.joint,
                one.excitation,
                one.file,
                mrad(one.baseline_rmse_rad),
                mrad(one.identified_rmse_rad),
            )
            for one in report.trajectories
        ],
        evidence=[_evidence_row(row) for row in evidence],
        kept=kept,
        not_fitted=[plain(name) for name in EFFECTS if name not in {row.name for row in evidence}],
        parameters=[*_parameters(report.effects), *_parameters(report.provisional, " (not named)")],
        alternatives=[
            (
                effect.name,
                other.name,
                mrad(other.held_out_rmse_rad),
                words.mrad_range(other.difference_ci95),
            )
            for effect in report.effects
            for other in effect.alternatives
        ],
        model=_model(report),
        glossary=[(plain(name), effect.meaning) for name, effect in EFFECTS.items()],
    )


def _headline(report: Report) -> list[Row]:
    held = report.held_out
    answer = words.listing(
        [plain(n) for n in dict.fromkeys(e.name for e in report.effects)] or ["nothing named"]
    )
    if not report.effects and report.open_sets:
        answer = "; ".join(words.causes(group) for group in report.open_sets)
    tiles = [
        (_VERDICTS[report.verdict], "verdict", answer),
        (
            mrad(held.baseline_rmse_rad),
            "gap before",
            "error on held-out motions, plain servo model fitted",
        ),
    ]
    if report.effects or report.provisional:
        note = f"{percent(held.reduction)} less (95 %: {words.percent_range(held.ci95)})"
        tiles.append((mrad(held.identified_rmse_rad), "gap after", note))
    floor = mrad(report.noise_floor_rad)
    return [*tiles, (floor, "noise floor", "what no model can explain: resolution, repeatability")]


def _joint_row(report: Report, one: JointGap) -> Row:
    where = [
        f.where.removeprefix(f"{one.joint}: ") for f in report.findings if f.joint == one.joint
    ]
    return (
        one.joint,
        "; ".join(where) or "nothing",
        _VERDICTS[one.verdict].lower(),
        plain(one.reason),
    )


def _evidence_row(row: Candidate) -> Row:
    units = parameters_of(row.name)
    known = math.isfinite(row.gain)
    return (
        words.joints_text(row.joints),
        plain(row.name),
        ", ".join(map(plain, row.given)),
        mrad(row.held_out_rmse_rad) if known else "not fitted",
        f"{percent(row.gain)} ({words.percent_range(row.gain_ci95)})" if known else "",
        f"{_DECISIONS[row.decision]}{plain(row.reason)}",
        ", ".join(
            f"{key} {amount(value, units[key].unit)}" for key, value in row.parameters.items()
        ),
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
            f"{name} [{words.unit_text(BASELINE_PARAMETERS[name].unit)}]",
            f"{before[name]:.3g}" if name in before else "",
            f"{after[name]:.3g}",
        )
        for joint, after in report.identified.parameters.items()
        for before in [report.baseline.parameters[joint]]
        for name in after
    ]
