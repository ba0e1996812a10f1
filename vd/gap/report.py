"""What the page of a gap report shows, and its figures as PNG files beside it."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from vd.files import atomic_path
from vd.gap import figures
from vd.gap.result import UNITS, Candidate, NamedEffect, Predictions, Report, parameter_of
from vd.gap.words import (
    MAX_SETS,
    amount,
    decision_text,
    estimate,
    joints_text,
    listing,
    mrad,
    mrad_range,
    next_step,
    open_questions,
    percent,
    percent_range,
    plain,
    sentences,
    training_layer,
    unit_text,
    verdict_sentence,
    where_text,
)
from vd.kernels.servo.effects import EFFECTS
from vd.page import write_html

REPORT_JSON, REPORT_HTML = "report.json", "report.html"
FIGURES = ("gap.png", "overlay_*.png", "residual_*.png", "evidence_*.png")
FIGURE_DPI = 150
MAX_FINDINGS = 3
"""Shown of each joint, the largest first; report.json has all."""
MAX_ALTERNATIVES = 5
"""Shown beside a named effect; the evidence table has all."""

_VERDICT_WORDS = {
    "effects": "Missing effect named",
    "no_gap": "No gap",
    "ambiguous": "Gap found, cause ambiguous",
    "under_excited": "Motions do not determine the model",
    "unknown": "Gap found, cause unknown",
}


def write_report(report: Report, curves: Predictions | None, folder: Path) -> list[Path]:
    """Write ``report.json``, ``report.html`` and the figures.

    Args:
        report: What was found.
        curves: Curves of the overlays; None leaves them out.
        folder: Folder to write to.

    Returns:
        The files written.
    """
    for pattern in FIGURES:  # of an earlier analysis, of which other motions were drawn
        for path in Path(folder).glob(pattern):
            path.unlink()
    report.write(folder / REPORT_JSON)
    pictures = _Pictures(folder)
    write_html(
        folder / REPORT_HTML,
        "gap.html",
        report=report,
        verdict=verdict_sentence(report),
        headline=_headline(report),
        steps=sentences(next_step(report)),
        open=open_questions(report),
        findings=_findings(report),
        joints=[(one.joint, _VERDICT_WORDS[one.verdict].lower(), plain(one.reason)) for one in report.joints],
        gap_picture=pictures.add("gap", figures.gap_figure(report)) if report.joints else None,
        trajectories=_trajectories(report),
        **_curves(pictures, report, curves),
        **_evidence(pictures, report),
        parameters=_parameters(report),
        alternatives=_alternatives(report),
        model=_model(report),
        closing_errors=_closing_errors(report),
        layer=training_layer(report) if report.closing else None,
        method=_method(report),
        glossary=_glossary(report),
    )
    return [folder / REPORT_HTML, folder / REPORT_JSON, *pictures.files]


class _Pictures:
    """Writes each figure to a PNG file, whose bytes the page embeds."""

    def __init__(self, folder: Path):
        self._folder = folder
        self.files: list[Path] = []

    def add(self, name: str, figure: Figure) -> Path:
        path = self._folder / f"{name}.png"
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=FIGURE_DPI)
        self.files.append(path)
        return path


def _answer(report: Report) -> str:
    """What is named, or what is in question, in a few words."""
    if report.effects:
        return listing([plain(name) for name in dict.fromkeys(e.name for e in report.effects)])
    if len(report.open_sets) > MAX_SETS:
        return f"{len(report.open_sets)} sets of causes"
    return listing([", ".join(map(plain, group)) for group in report.open_sets] or ["nothing named"])


def _headline(report: Report) -> list[tuple[str, str, str]]:
    held, floor = report.held_out, report.noise_floor_rad
    tiles = [
        (_VERDICT_WORDS[report.verdict], "verdict", _answer(report)),
        (mrad(held.baseline_rmse_rad), "gap before", "error on held-out motions, plain servo model fitted"),
    ]
    if report.effects or report.provisional:
        note = f"{percent(held.reduction)} less (95 %: {percent_range(held.ci95)})"
        tiles.append((mrad(held.identified_rmse_rad), "gap after", note))
    return [*tiles, (mrad(floor), "noise floor", "what no model can explain: resolution, repeatability")]


def _findings(report: Report) -> list[tuple[str, str]]:
    rows = []
    for joint in dict.fromkeys(finding.joint for finding in report.findings):
        found = [where_text(finding) for finding in report.findings if finding.joint == joint]
        rows += [(joint if i == 0 else "", where) for i, where in enumerate(found[:MAX_FINDINGS])]
    return rows


def _closing_errors(report: Report) -> list[str]:
    """Before and after, of the simulation with the identified layer."""
    closing = report.closing
    return [mrad(closing.baseline_rmse_rad), mrad(closing.identified_rmse_rad)] if closing else []


def _trajectories(report: Report) -> list[tuple[str, ...]]:
    return [
        (
            row.joint,
            row.excitation,
            row.file,
            "yes" if row.held_out else "no",
            mrad(row.baseline_rmse_rad),
            mrad(row.identified_rmse_rad),
        )
        for row in report.trajectories
    ]


def _curves(pictures: _Pictures, report: Report, curves: Predictions | None) -> dict[str, Any]:
    """Pictures with their joint, file, and whether the fit has not seen it; and pictures with their joint."""
    if curves is None:
        return {"curves": False}
    held = {(row.joint, row.file) for row in report.trajectories if row.held_out}
    overlays, residuals = [], []
    chosen = figures.chosen_overlays(report, curves)
    for joint, index in chosen:
        file = curves.files[index]
        figure = figures.overlay_figure(report, curves, joint, index)
        image = pictures.add(f"overlay_{joint}_{Path(file).stem}", figure)
        overlays.append((image, joint, file, (joint, file) in held))
    for joint in dict.fromkeys(joint for joint, _ in chosen):
        figure = figures.residual_figure(report, curves, joint)
        residuals.append((pictures.add(f"residual_{joint}", figure), joint))
    return {"curves": True, "overlays": overlays, "residuals": residuals}


def _evidence(pictures: _Pictures, report: Report) -> dict[str, Any]:
    """Pictures and rows of the candidates by their joints, and what was not tried."""
    tried = {row.name for row in report.evidence}
    evidence = []
    for joints in dict.fromkeys(row.joints for row in report.evidence):
        image = pictures.add(f"evidence_{'_'.join(joints)}", figures.evidence_figure(report, joints))
        rows = [row for row in report.evidence if row.joints == joints]
        rows.sort(key=lambda row: (row.round, -row.gain))
        evidence.append((image, joints_text(joints), [_evidence_row(row) for row in rows]))
    return {"evidence": evidence, "not_fitted": [plain(name) for name in EFFECTS if name not in tried]}


def _evidence_row(row: Candidate) -> tuple[str, ...]:
    fitted = ", ".join(
        f"{key.rpartition('.')[2]} {amount(value, parameter_of(key, row.name).unit)}"
        for key, value in row.parameters.items()
    )
    return (
        plain(row.name) + (" (placebo)" if row.placebo else ""),
        str(row.round),
        mrad(row.held_out_rmse_rad),
        f"{percent(row.gain)} ({percent_range(row.gain_ci95)})",
        decision_text(row),
        fitted,
    )


def _parameters(report: Report) -> list[tuple[str, ...]]:
    def rows(effects: Iterable[NamedEffect], note: str = "") -> list[tuple[str, ...]]:
        return [
            (
                joints_text(effect.joints),
                plain(effect.name) + note,
                f"{name} = {estimate(one)}",
                "" if note else percent(effect.confidence),
            )
            for effect in effects
            for name, one in effect.parameters.items()
        ]

    return rows(report.effects) + rows(report.provisional, " (not named)")


def _alternatives(report: Report) -> list[tuple[str, list[tuple[str, ...]]]]:
    return [
        (
            plain(effect.name),
            [
                (plain(one.name), mrad(one.held_out_rmse_rad), mrad_range(one.difference_ci95))
                for one in effect.alternatives[:MAX_ALTERNATIVES]
            ],
        )
        for effect in report.effects
        if effect.alternatives
    ]


def _model(report: Report) -> list[tuple[str, ...]]:
    """Parameters of the plain servo model of every joint, before and after: a header and rows."""
    names = list(dict.fromkeys(n for fit in report.identified.parameters.values() for n in fit))
    if not names:
        return []
    before, after = report.baseline.parameters, report.identified.parameters
    rows = [
        ("joint", *(f"{name} [{unit_text(UNITS.get(name, '1'))}]" for name in names)),
        *(
            (joint, *(_before_after(before.get(joint, {}).get(n), values.get(n)) for n in names))
            for joint, values in after.items()
        ),
    ]
    if len(names) > len(after):  # the longer side goes down the page
        return [("parameter", *after), *list(zip(*rows, strict=True))[1:]]
    return rows


def _before_after(before: float | None, after: float | None) -> str:
    if after is None:
        return "–"  # noqa: RUF001
    if before is None or abs(before - after) <= 1e-3 * abs(after):
        return f"{after:.3g}"
    return f"{before:.3g} → {after:.3g}"


def _method(report: Report) -> list[tuple[str, str]]:
    source, held = report.recording, report.held_out
    return [
        ("recording", source.path),
        ("machine", f"{source.model}{', ' + source.servo if source.servo else ''}"),
        ("joints", ", ".join(source.joints)),
        ("motions", f"{source.trajectories}, {source.seconds:.0f} s, {source.samples} samples"),
        ("held out", _held_out_text(held.trajectories, source.trajectories)),
        ("started from", report.hand_layer or "the nominal model"),
        ("error", "root mean square of simulated minus recorded position, over whole motions"),
        ("intervals", "95 %, from resampling whole motions: samples of one motion are not independent"),
        (
            "time",
            f"{report.seconds:.0f} s; {report.rollouts} simulated motions, {report.rollouts_per_s:.0f} a "
            "second",
        ),
        ("seed", str(report.seed)),
        *report.software.items(),
    ]


def _held_out_text(files: tuple[str, ...], total: int) -> str:
    if len(files) == total:
        return "every motion once: each was predicted by a model fitted without motions of its kind"
    return ", ".join(files) or "none"


def _glossary(report: Report) -> list[tuple[str, str]]:
    named = [e.name for e in report.effects] + [name for group in report.ambiguous for name in group]
    return [(plain(name), EFFECTS[name].meaning) for name in dict.fromkeys([*named, *EFFECTS])]
