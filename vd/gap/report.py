"""What the page of a gap report shows, and its figures as PNG files beside it."""

from collections.abc import Iterable
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from vd.command.files import atomic_path
from vd.command.page import FIGURE_DPI, write_html
from vd.gap import figures, words
from vd.gap.coordinates import PARAMETERS
from vd.gap.result import (
    FamilyVerdict,
    JointGap,
    NamedEffect,
    Predictions,
    Report,
    TrajectoryError,
    WholeModel,
)
from vd.gap.words import amount, mrad, percent, plain
from vd.kernels.servo.effects import EFFECTS

REPORT_JSON = "report.json"
REPORT_HTML = "report.html"
FIGURES = ("overlay_*.png", "residual_*.png")
"""Those of an earlier analysis go; other motions were drawn."""

_VERDICTS = {
    "effects": "Missing effect named",
    "no_gap": "No gap",
    "ambiguous": "Gap found, cause ambiguous",
    "under_excited": "Motions do not determine the model",
    "unknown": "Gap found, cause unknown",
}

Row = tuple[str, ...]


def write_report(report: Report, curves: Predictions, folder: Path) -> None:
    """Write ``report.json``, ``report.html`` and the figures.

    Args:
        report: What was found.
        curves: What the figures draw.
        folder: Folder to write to.
    """
    for pattern in FIGURES:
        for path in Path(folder).glob(pattern):
            path.unlink()
    report.write(folder / REPORT_JSON)

    def draw(name: str, figure: Figure) -> Path:
        path = folder / f"{name}.png"
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=FIGURE_DPI)
        return path

    overlays = []
    residuals = {}
    with mpl.rc_context(figures.STYLE):
        for joint, index in figures.chosen_overlays(report, curves):
            file = curves.files[index]
            overlay = figures.overlay_figure(report, curves, joint, index)
            overlays.append(
                (draw(f"overlay_{joint}_{Path(file).stem}", overlay), f"{joint} in {file}")
            )
            if joint not in residuals:
                residual = figures.residual_figure(report, curves, joint)
                residuals[joint] = draw(f"residual_{joint}", residual)
    write_html(
        folder / REPORT_HTML,
        "gap.html",
        report=report,
        words=words,
        headline=_headline(report),
        joints=[_joint_row(report, one) for one in report.joints],
        overlays=overlays,
        residuals=residuals,
        trajectories=[*map(_trajectory_row, report.trajectories)],
        families=[*map(_family_row, report.families)],
        models=[*map(_model_row, report.models)],
        compared=[*map(_model_row, report.compared)],
        not_tried=_not_tried(report),
        parameters=[*_parameters(report.effects), *_parameters(report.provisional, " (not named)")],
        model=_model(report),
        glossary=[(plain(name), effect.meaning) for name, effect in EFFECTS.items()],
    )


def _headline(report: Report) -> list[Row]:
    held = report.held_out
    names = dict.fromkeys(effect.name for effect in report.effects)
    answer = words.causes(names or ["nothing named"], "and")
    before = (
        f"held out, the plain servo model; {mrad(report.baseline.rmse_rad)} where it was fitted"
    )
    tiles = [
        (_VERDICTS[report.verdict], "verdict", answer),
        (mrad(held.baseline_rmse_rad), "gap before", before),
    ]
    if report.effects or report.provisional:
        note = f"held out, the identified model; {mrad(report.identified.rmse_rad)} where it was fitted"
        tiles.append((mrad(held.identified_rmse_rad), "gap after", note))
    if report.delivered is not None:
        before = mrad(report.delivered.baseline_rmse_rad)
        note = f"the layer as written, on a motion that no fit saw; the plain model {before}"
        tiles.append((mrad(report.delivered.rmse_rad), "as delivered", note))
    floor = mrad(report.noise_floor_rad)
    return [*tiles, (floor, "noise floor", "of the encoder: its counts, and its readings at rest")]


def _joint_row(report: Report, one: JointGap) -> Row:
    where = []
    for finding in report.findings:
        joint, _, text = finding.where.partition(": ")
        if joint == one.joint:
            where.append(text)
    return (
        one.joint,
        mrad(one.noise_floor_rad),
        mrad(one.baseline_rmse_rad),
        mrad(one.identified_rmse_rad),
        "; ".join(where) or "nothing",
        _VERDICTS[one.verdict].lower(),
        plain(one.reason),
    )


def _trajectory_row(row: TrajectoryError) -> Row:
    errors = mrad(row.baseline_rmse_rad), mrad(row.identified_rmse_rad)
    return row.joint, row.excitation, row.file, *errors


def _not_tried(report: Report) -> list[Row]:
    rows: list[Row] = []
    for joint, reasons in report.not_tried.items():
        for name, reason in reasons.items():
            why = plain(reason)
            rows.append((joint, plain(name), why))
    return rows


def _family_row(row: FamilyVerdict) -> Row:
    members = words.causes(row.effects) if row.effects else ""
    return row.joint, row.name, row.verdict, members, percent(row.share) if row.effects else ""


def _model_row(row: WholeModel) -> Row:
    values = []
    for key, value in row.parameters.items():
        values.append(f"{PARAMETERS[key].name} {amount(value, PARAMETERS[key].unit)}")
    return (
        row.joint,
        words.model_text(row.effects),
        mrad(row.rmse_rad),
        mrad(row.held_out_rmse_rad),
        words.mrad_range(row.difference_ci95),
        plain(row.why) or "as good as the best",
        ", ".join(values),
    )


def _parameters(effects: Iterable[NamedEffect], note: str = "") -> list[Row]:
    rows: list[Row] = []
    for effect in effects:
        head = words.joints_text(effect.joints), plain(effect.name) + note
        confidence = "" if note else percent(effect.confidence)
        for name, one in effect.parameters.items():
            rows.append((*head, f"{name} = {words.estimate(one)}", confidence))
    return rows


def _model(report: Report) -> list[Row]:
    """Parameters of the plain servo model of every joint, before and after."""
    rows: list[Row] = []
    for joint, after in report.identified.parameters.items():
        before = report.baseline.parameters[joint]
        for name, value in after.items():
            unit = words.unit_text(PARAMETERS[name].unit)
            old = f"{before[name]:.3g}" if name in before else ""
            rows.append((joint, f"{name} [{unit}]", old, f"{value:.3g}"))
    return rows
