"""What ``vd-gap`` found in plain sentences, for the terminal and the page."""

import math
import re
from collections.abc import Sequence

from vd.gap.result import LAYER, Candidate, Estimate, Finding, Interval, NamedEffect, Report

MAX_NAMED_JOINTS = 4
"""More joints than this are counted rather than listed."""
MAX_SETS = 2
"""More sets than this are counted in a sentence and listed after it."""
MAX_PLACES = 6
"""Decimals of an estimate at most."""
CALLED = {"encoder_bias": "a common zero of command and reading (encoder bias)"}
"""Effects that are first of all something else: an offset in all motions looks the same as a wrong zero."""
ZEROS = (
    " An offset that is the same in all motions is first of all a difference of zeros between command and "
    "reading (homing, calibration): compare the zeros before you use the model."
)
"""What is said where an encoder bias is named."""
MILLI = 1e3
"""Errors are shown in mrad."""


def plain(name: str) -> str:
    """``command_delay`` as people say it: ``command delay``."""
    return name.replace("_", " ")


def listing(names: Sequence[str], last: str = "and") -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def joints_text(joints: Sequence[str]) -> str:
    """Joints by name, or their number where they are many."""
    if len(joints) > MAX_NAMED_JOINTS:
        return f"{len(joints)} joints ({joints[0]} to {joints[-1]})"
    return listing(joints)


def mrad(value: float) -> str:
    """``12.3 mrad``, with as many digits as matter."""
    return f"{_digits(MILLI * value)} mrad" if math.isfinite(value) else "not known"


def mrad_range(interval: Interval) -> str:
    """``11.0 to 13.1 mrad``."""
    if not all(map(math.isfinite, interval)):
        return "not known"
    return f"{_digits(MILLI * interval[0])} to {_digits(MILLI * interval[1])} mrad"


def percent(value: float) -> str:
    """``43 %``."""
    return f"{100.0 * value:.0f} %" if math.isfinite(value) else "not known"


def percent_range(interval: Interval) -> str:
    """``40 to 47 %``."""
    if not all(map(math.isfinite, interval)):
        return "not known"
    return f"{100.0 * interval[0]:.0f} to {100.0 * interval[1]:.0f} %"


def unit_text(unit: str) -> str:
    """A unit as it is printed: ``kg m²``; empty for a pure number."""
    return "" if unit == "1" else unit.replace("^2", "²")


def amount(value: float, unit: str) -> str:
    """A number with its unit, in the size in which people speak of it: ``40.2 ms``, ``12.1 mrad``."""
    if not math.isfinite(value):
        return "not known"
    factor, shown = _size(value, unit)
    return f"{_digits(factor * value)} {shown}".strip()


def estimate(one: Estimate) -> str:
    """``40.2 ms (95 %: 39.1 to 41.3)``, with two digits of the interval's half width."""
    factor, shown = _size(one.value, one.unit)
    low, high = (factor * x for x in one.ci95)
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{amount(one.value, one.unit)} (interval not known)"
    half = max(0.5 * (high - low), 1e-6 * abs(factor * one.value), 1e-9)
    places = min(max(1 - math.floor(math.log10(half)), 0), MAX_PLACES)
    text = f"{factor * one.value:.{places}f} {shown}".strip()
    return f"{text} (95 %: {low:.{places}f} to {high:.{places}f})"


def finding_text(finding: Finding) -> str:
    """Joint, and where it fails."""
    return f"{finding.joint}: {where_text(finding)}"


def where_text(finding: Finding) -> str:
    """Where a joint fails, without its name."""
    return finding.where.removeprefix(f"{finding.joint}: ")


def effect_sentence(effect: NamedEffect) -> str:
    """``command delay on f0_j1 (40.2 ms)``."""
    sizes = ", ".join(amount(p.value, p.unit) for p in effect.parameters.values())
    return f"{CALLED.get(effect.name, plain(effect.name))} on {joints_text(effect.joints)}" + (
        f" ({sizes})" if sizes else ""
    )


def verdict_sentence(report: Report) -> str:
    """The verdict in one or two sentences that need no context."""
    floor, before = mrad(report.noise_floor_rad), mrad(report.held_out.baseline_rmse_rad)
    sets = [f"{{{', '.join(plain(name) for name in group)}}}" for group in report.open_sets]
    many = f"{len(sets)} sets of causes" if len(sets) > MAX_SETS else ""
    if report.verdict == "effects":
        missing = listing([effect_sentence(effect) for effect in report.effects])
        text = f"The simulation lacks {missing}. {_shrinks(report)}"
        text += ZEROS if any(effect.name == "encoder_bias" for effect in report.effects) else ""
        text += _equivalents(report)
        if many:
            text += f" More is missing, for which this recording leaves {many}, listed under what to do next."
        elif sets:
            text += f" Something else remains that this recording cannot tell apart: {listing(sets)}."
        return text
    if report.verdict == "no_gap":
        model = "plain servo model" if report.hand_layer is None else f"model in {report.hand_layer}"
        return (
            f"No gap: the {model} explains this recording. What remains, {before} on held-out "
            f"motions, is no more than noise ({floor}), than a small error of the links' masses, or than any "
            "candidate explains."
        )
    if report.verdict == "ambiguous" and many:
        return (
            f"There is a gap ({before} on held-out motions against a noise floor of {floor}), and this "
            f"recording leaves {many} for it, listed under what to do next. With one of each in the model "
            f"the error falls to {mrad(report.held_out.identified_rmse_rad)}."
        )
    if report.verdict == "ambiguous":
        return (
            f"There is a gap ({before} on held-out motions against a noise floor of {floor}), and one of "
            f"{listing(sets, 'or of')} explains it, but this recording cannot say which. {_stands_in(report)}"
        ).strip()
    if report.verdict == "under_excited":
        return (
            "No verdict on effects: the motions in this recording do not determine the model. Different "
            "parameters fit equally well."
        )
    return (
        f"There is a gap ({before} on held-out motions against a noise floor of {floor}), but no effect that "
        "is known here explains it. The cause lies outside the table of effects."
    )


def _equivalents(report: Report) -> str:
    """What else the names stand for."""
    groups = [group for group in report.ambiguous if group not in report.open_sets]
    return "".join(
        f" {plain(group[0]).capitalize()} stands for {listing([plain(name) for name in group[1:]])} too: "
        "commands and positions are the same, whichever it is."
        for group in groups
    )


def _shrinks(report: Report) -> str:
    held = report.held_out
    text = (
        f"With it the error on motions that the fit has not seen falls from {mrad(held.baseline_rmse_rad)} "
        f"to {mrad(held.identified_rmse_rad)} ({percent(held.reduction)} less"
    )
    known = all(map(math.isfinite, held.ci95))
    text += f", 95 %: {percent_range(held.ci95)}" if known else ""
    return f"{text}); the noise floor is {mrad(report.noise_floor_rad)}."


def _stands_in(report: Report) -> str:
    if not report.provisional:
        return ""
    held, names = report.held_out, listing([effect_sentence(effect) for effect in report.provisional])
    return f"With {names} in its place the error falls to {mrad(held.identified_rmse_rad)}."


def next_step(report: Report) -> str:
    """What to do with the outcome, in a sentence or two."""
    if report.next_experiment:
        return report.next_experiment
    if report.verdict == "effects" and report.hand is None:
        return (
            "Nothing is open. identified.usda has the servo's model, with every effect by name. Run vd-gap "
            "with --hand-layer identified.usda on a new recording to confirm that the gap is closed."
        )
    if report.verdict == "effects":
        layer = training_layer(report)
        other = "" if layer == LAYER else f" ({LAYER} is the same for the recorded finger alone)"
        return (
            f"Nothing is open. Use the identified model: pass {layer} with --hand-layer to vd-train, vd-eval "
            f"and vd-play{other}, and run vd-gap with it on a new recording to confirm that the gap is "
            "closed."
        )
    if report.verdict == "no_gap":
        return "Nothing to do. Use the identified baseline; record other motions only if the task needs them."
    return "Record the same joints with other motions; vd-gap plan proposes which."


def training_layer(report: Report) -> str:
    """The layer to train and evaluate with: every finger's."""
    closing = report.closing
    return LAYER if closing is None else closing.whole_hand_layer or closing.layer


def open_questions(report: Report) -> list[str]:
    """What is left open, joints with the same set together: ``f0_j1: backlash or dead zone``."""
    joints: dict[frozenset[str], list[str]] = {}
    names: dict[frozenset[str], tuple[str, ...]] = {}
    for joint in report.joints:
        for group in joint.open_sets:
            joints.setdefault(frozenset(group), []).append(joint.joint)
            names.setdefault(frozenset(group), group)
    return [
        f"{joints_text(held)}: {listing([plain(name) for name in names[group]], 'or')}"
        for group, held in joints.items()
    ]


def sentences(text: str) -> list[str]:
    """A text by its sentences."""
    return re.split(r"(?<=\.)\s+(?=[A-Z])", text)


def decision_text(row: Candidate) -> str:
    """What became of a candidate, with the reason."""
    word = {"named": "accepted", "tied": "cannot be told apart", "rejected": "rejected"}[row.decision]
    return f"{word}: {row.reason}" if row.reason else word


def _size(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which a number is printed."""
    small = {"s": "ms", "rad": "mrad", "N m": "mN m"}.get(unit)
    return (MILLI, small) if small and 0.0 < abs(value) < 1.0 else (1.0, unit_text(unit))


def _digits(value: float) -> str:
    """Three digits, but nothing beyond the third decimal."""
    rounded = round(value, 3) if abs(value) < 1.0 else value
    return f"{rounded + 0.0:.3g}" if abs(value) < 1e3 else f"{value:.0f}"
