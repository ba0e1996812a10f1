"""The gap report as one HTML page, with its figures as PNG files beside it."""

from pathlib import Path

from matplotlib.figure import Figure

from vd.files import atomic_path
from vd.gap import figures
from vd.gap.result import UNITS, Candidate, Predictions, Report, parameter_of
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
from vd.kernels.effects import EFFECTS
from vd.page import Page

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
    page = Page("Gap report: " + report.recording.model, verdict_sentence(report))
    pictures = _Pictures(page, folder)
    _headline(page, report)
    _next(page, report)
    _found(page, report)
    _gap(page, pictures, report)
    if curves is not None:
        _curves(page, pictures, report, curves)
    _evidence(page, pictures, report)
    _parameters(page, report)
    _method(page, report)
    _glossary(page, report)
    page.write(folder / REPORT_HTML)
    return [folder / REPORT_HTML, folder / REPORT_JSON, *pictures.files]


class _Pictures:
    """Puts each figure into the page and into a PNG file of the same bytes."""

    def __init__(self, page: Page, folder: Path):
        self._page, self._folder = page, folder
        self.files: list[Path] = []

    def add(self, name: str, figure: Figure, caption: str) -> None:
        path = self._folder / f"{name}.png"
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=FIGURE_DPI)
        self._page.figure(path, caption)
        self.files.append(path)


def _answer(report: Report) -> str:
    """What is named, or what is in question, in a few words."""
    if report.effects:
        return listing([plain(name) for name in dict.fromkeys(e.name for e in report.effects)])
    if len(report.open_sets) > MAX_SETS:
        return f"{len(report.open_sets)} sets of causes"
    return listing([", ".join(map(plain, group)) for group in report.open_sets] or ["nothing named"])


def _headline(page: Page, report: Report) -> None:
    held, floor = report.held_out, report.noise_floor_rad
    tiles = [
        (
            _VERDICT_WORDS[report.verdict],
            "verdict",
            _answer(report),
        ),
        (mrad(held.baseline_rmse_rad), "gap before", "error on held-out motions, plain servo model fitted"),
    ]
    if report.effects or report.provisional:
        note = f"{percent(held.reduction)} less (95 %: {percent_range(held.ci95)})"
        tiles.append((mrad(held.identified_rmse_rad), "gap after", note))
    tiles.append((mrad(floor), "noise floor", "what no model can explain: resolution, repeatability"))
    page.tiles(tiles)
    if report.warnings:
        page.points(report.warnings)


def _next(page: Page, report: Report) -> None:
    page.section("What to do next")
    steps = sentences(next_step(report))
    if len(steps) > 1:
        page.points(steps)
    else:
        page.text(steps[0])
    open_ = open_questions(report)
    if open_:
        page.text("Still open, with what this recording cannot tell apart:")
        page.points(open_)


def _found(page: Page, report: Report) -> None:
    page.section("Where simulation and measurement disagree")
    if report.findings:
        page.text(
            "Before any effect is added, the plain servo model (stiffness, damping, speed limit) is fitted. "
            "What it cannot follow:"
        )
        rows = []
        for joint in dict.fromkeys(finding.joint for finding in report.findings):
            found = [where_text(finding) for finding in report.findings if finding.joint == joint]
            rows += [(joint if i == 0 else "", where) for i, where in enumerate(found[:MAX_FINDINGS])]
        page.table(["joint", "where"], rows, words=(1,))
    else:
        page.text("Nowhere by more than noise, once the plain servo model is fitted.")
    if report.joints:
        page.table(
            ["joint", "verdict", "why"],
            [(one.joint, _VERDICT_WORDS[one.verdict].lower(), plain(one.reason)) for one in report.joints],
            words=(1, 2),
        )


def _gap(page: Page, pictures: _Pictures, report: Report) -> None:
    page.section("How large the gap is")
    if report.joints:
        pictures.add(
            "gap",
            figures.gap_figure(report),
            "Error of each joint on motions that the fit has not seen. The black line is the 95 % interval "
            "over "
            "motions, the blue mark the noise floor: a model whose bar ends there cannot be told from the "
            "machine.",
        )
    closing = report.closing
    if closing is not None:
        engine = (
            "in Newton, the simulator that training uses, with the identified layer on the hand's file"
            if closing.simulator == "newton"
            else "as the single joint that was fitted: a bare servo has no articulation to simulate beyond it"
        )
        page.text(
            f"Proof: the commands were simulated again {engine}. On held-out motions the error is "
            f"{mrad(closing.baseline_rmse_rad)} before and {mrad(closing.identified_rmse_rad)} after. "
            f"{closing.note}".strip()
        )
    rows = [
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
    if rows:
        page.table(
            ["joint", "motion", "file", "held out", "before", "after"],
            rows,
            words=(1, 2, 3),
            folded=f"Every motion ({len(rows)} rows)",
        )


def _curves(page: Page, pictures: _Pictures, report: Report, curves: Predictions) -> None:
    page.section("Curves")
    held = {(row.joint, row.file) for row in report.trajectories if row.held_out}
    chosen = figures.chosen_overlays(report, curves)
    for joint, index in chosen:
        file = curves.files[index]
        unseen = "a motion that the fit has not seen" if (joint, file) in held else "a motion of the fit"
        pictures.add(
            f"overlay_{joint}_{Path(file).stem}",
            figures.overlay_figure(report, curves, joint, index),
            f"{joint} in {file}, {unseen}. Above: what was commanded, measured, and simulated. Below: the "
            "difference; the blue band is the noise floor. Right: the shaded piece in detail.",
        )
    for joint in dict.fromkeys(joint for joint, _ in chosen):
        pictures.add(
            f"residual_{joint}",
            figures.residual_figure(report, curves, joint),
            f"The differences of {joint} in all motions, against time, speed and the distance to the "
            "command. "
            "A cause leaves its mark: a delay tilts the middle panel, friction splits it in two levels, a "
            "weak "
            "or saturated motor bends the right one.",
        )


def _evidence(page: Page, pictures: _Pictures, report: Report) -> None:
    if not report.evidence:
        return
    page.section("Every candidate, and why it was taken or not")
    page.text(
        "Each known effect is added in turn, everything is fitted again, and the model is judged on "
        "motions left "
        "out of the fit. The best one is kept if its gain is certain, and the next round starts. "
        "Candidates that "
        "do as well as the best cannot be told apart by this recording. Placebos are effects driven by "
        "shuffled "
        "time: if one of them seemed to help, the method would be fooling itself."
    )
    tried = {row.name for row in report.evidence}
    if left := [plain(name) for name in EFFECTS if name not in tried]:
        page.text(
            f"Not fitted, because they do not apply here or a first screening left them no chance: "
            f"{', '.join(left)}.",
            small=True,
        )
    for joints in dict.fromkeys(row.joints for row in report.evidence):
        rows = [row for row in report.evidence if row.joints == joints]
        pictures.add(
            f"evidence_{'_'.join(joints)}",
            figures.evidence_figure(report, joints),
            f"{joints_text(joints)}: share of the held-out error that each candidate removes, with 95 % "
            "intervals over motions.",
        )
        rows.sort(key=lambda row: (row.round, -row.gain))
        page.table(
            ["candidate", "round", "held-out error", "gain (95 %)", "outcome", "fitted"],
            [_evidence_row(row) for row in rows],
            words=(4, 5),
            folded=f"{joints_text(joints)}: the numbers of all {len(rows)} candidates",
        )


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


def _parameters(page: Page, report: Report) -> None:
    page.section("The identified model")
    rows = [
        (
            joints_text(effect.joints),
            plain(effect.name),
            f"{name} = {estimate(one)}",
            percent(effect.confidence),
        )
        for effect in report.effects
        for name, one in effect.parameters.items()
    ]
    rows += [
        (joints_text(effect.joints), f"{plain(effect.name)} (not named)", f"{name} = {estimate(one)}", "")
        for effect in report.provisional
        for name, one in effect.parameters.items()
    ]
    if rows:
        page.table(["joint", "effect", "parameter", "confidence"], rows, words=(1, 2))
        if report.provisional:
            page.text(
                "Not named: an effect that stands for its ambiguous set, so that the model can be simulated.",
                small=True,
            )
        page.text(
            "Confidence is the share of repetitions, on motions drawn anew and with the choice repeated, "
            "in which "
            "this effect is chosen.",
            small=True,
        )
    for effect in report.effects:
        if effect.alternatives:
            page.table(
                [f"in place of {plain(effect.name)}", "held-out error", "worse by (95 %)"],
                [
                    (plain(one.name), mrad(one.held_out_rmse_rad), mrad_range(one.difference_ci95))
                    for one in effect.alternatives[:MAX_ALTERNATIVES]
                ],
            )
    names = list(dict.fromkeys(n for fit in report.identified.parameters.values() for n in fit))
    if names:
        before, after = report.baseline.parameters, report.identified.parameters
        units = [f"{name} [{unit_text(UNITS.get(name, '1'))}]" for name in names]
        cells = [
            [_before_after(before.get(joint, {}).get(n), values.get(n)) for n in names]
            for joint, values in after.items()
        ]
        if len(names) > len(after):  # the longer side goes down the page
            page.table(["parameter", *after], list(zip(units, *cells, strict=True)))
        else:
            page.table(["joint", *units], [(j, *row) for j, row in zip(after, cells, strict=True)])
        page.text(
            "The plain servo model, before → after the effects joined the fit. Without the missing effect "
            "these numbers are bent to make up for it.",
            small=True,
        )
        if report.recording.relative_torques:
            page.text(
                "Torques are relative: commands and positions of a bare servo do not show how large they "
                "are. kp is held at a nominal value, and all that is in N m or kg m² would double with it. "
                "Its stiffness, as servo.kp_nm_rad in recording.json, makes them absolute.",
                small=True,
            )
    if report.closing is not None:
        layer = training_layer(report)
        page.text(
            f"All of this is in {report.closing.layer}, USD in plain text"
            + (f"; {layer} has it on every finger. " if layer != report.closing.layer else ". ")
            + ("To train with it (vd-eval and vd-play take it too), and to " if report.hand else "To ")
            + "see whether a new recording agrees with it:"
        )
        if report.hand is not None:
            page.code(f"vd-train teacher --hand {report.hand} --hand-layer {layer}")
        page.code(f"vd-gap run NEW_RECORDING --hand-layer {report.closing.layer} --out DIR")


def _before_after(before: float | None, after: float | None) -> str:
    if after is None:
        return "–"  # noqa: RUF001
    if before is None or abs(before - after) <= 1e-3 * abs(after):
        return f"{after:.3g}"
    return f"{before:.3g} → {after:.3g}"


def _method(page: Page, report: Report) -> None:
    page.section("How this was computed")
    source, held = report.recording, report.held_out
    rows = [
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
    page.table(["", ""], rows, words=(1,))
    page.text("All numbers of this page are in report.json beside it. The same again:")
    page.code(report.command or f"vd-gap run {source.path} --out DIR --seed {report.seed}")


def _held_out_text(files: tuple[str, ...], total: int) -> str:
    if len(files) == total:
        return "every motion once: each was predicted by a model fitted without motions of its kind"
    return ", ".join(files) or "none"


def _glossary(page: Page, report: Report) -> None:
    page.section("What the names mean")
    named = [e.name for e in report.effects] + [name for group in report.ambiguous for name in group]
    order = list(dict.fromkeys([*named, *EFFECTS]))
    page.table(["effect", "what it is"], [(plain(name), EFFECTS[name].meaning) for name in order], words=(1,))
