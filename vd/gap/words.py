"""What ``vd-gap`` found in plain sentences, for the terminal and the page."""

from collections.abc import Iterable, Sequence
from typing import get_args

from vd.gap.result import LAYER, Certainty, Estimate, Interval, NamedEffect, Report, WholeModel
from vd.gap.statistics import REPEATABLE

LISTED = 5
"""More joints than this are counted rather than listed, and no more curves are drawn and good models
of a joint listed than this: the contract's.
"""


def plain(name: str) -> str:
    """``command_delay`` as people say it: ``command delay``."""
    return name.replace("_", " ")


def listing(names: Iterable[str], last: str = "and") -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    *others, end = names
    return f"{', '.join(others)} {last} {end}" if others else end


def causes(names: Iterable[str], last: str = "or") -> str:
    """Effects of which one is meant: ``dead zone or backlash``."""
    return listing(map(plain, names), last)


def joints_text(joints: Sequence[str]) -> str:
    """Joints by name, or their number where they are many."""
    if len(joints) > LISTED:
        return f"{len(joints)} joints ({joints[0]} to {joints[-1]})"
    return listing(joints)


def mrad(value: float) -> str:
    """``12.3 mrad``, with as many digits as matter."""
    return f"{_digits(1e3 * value)} mrad"


def mrad_range(interval: Interval) -> str:
    """``11 to 13.1 mrad``."""
    return f"{_digits(1e3 * interval[0])} to {mrad(interval[1])}"


def percent(value: float) -> str:
    """``43 %``."""
    return f"{100.0 * value:.0f} %"


def percent_range(interval: Interval) -> str:
    """``40 to 47 %``."""
    return f"{100.0 * interval[0]:.0f} to {percent(interval[1])}"


def unit_text(unit: str) -> str:
    """A unit as it is printed: ``kg m²``; empty for a pure number."""
    return "" if unit == "1" else unit.replace("^2", "²")


def amount(value: float, unit: str) -> str:
    """A number with its unit, in the size in which people speak of it.

    ``40.2 ms``, ``12.1 mrad``.
    """
    factor, shown = _size(value, unit)
    return f"{_digits(factor * value)} {shown}".strip()


def estimate(one: Estimate) -> str:
    """``40.2 ms (95 %: 39.1 to 41.3)``."""
    factor, shown = _size(one.value, one.unit)
    low, high = one.ci95
    value = f"{factor * one.value:.4g} {shown}".strip()
    return f"{value} (95 %: {factor * low:.4g} to {factor * high:.4g})"


def effects_sentence(effects: Iterable[NamedEffect]) -> str:
    """``backlash on f0_j1 (40 mrad), f0_j2 (12 mrad) and dead zone on f0_j3 (8 mrad)``.

    Each name once.
    """
    parts: dict[str, str] = {}
    for effect in effects:
        sizes = [amount(number.value, number.unit) for number in effect.parameters.values()]
        begin = f"{parts[effect.name]}," if effect.name in parts else f"{plain(effect.name)} on"
        parts[effect.name] = f"{begin} {joints_text(effect.joints)} ({', '.join(sizes)})"
    return listing(parts.values())


def verdict_sentence(report: Report) -> str:
    """The verdict in a few sentences that need no context, each from the report's own figures."""
    if report.verdict == "effects":
        text = f"The simulation lacks {effects_sentence(report.effects)}. "
        return text + change(report) + _credit(report) + _besides(report) + _leftover(report)
    if report.verdict == "ambiguous":
        text = f"There is a gap: {gap(report)}. {_leaves(report)} "
        return text + change(report) + _leftover(report)
    if report.verdict == "no_gap":
        model = "plain servo model"
        if report.hand_layer is not None:
            model = f"model in {report.hand_layer}"
        return (
            f"No gap: the {model} explains this recording. It leaves {gap(report)}: no more than "
            "noise, or what no candidate explains."
        )
    if report.verdict == "under_excited":
        return (
            "No verdict on effects: the motions in this recording do not determine the model. "
            "Different parameters fit equally well."
        )
    return f"There is a gap: {gap(report)}. No model that was tried explains half of it."


def gap(report: Report) -> str:
    """What the plain model leaves, on motions that it was fitted to and on others."""
    held_out = mrad(report.held_out.baseline_rmse_rad)
    fitted = mrad(report.baseline.rmse_rad)
    floor = mrad(report.noise_floor_rad)
    return f"{fitted} where it was fitted, {held_out} on motions held out, with a noise floor of {floor}"


def change(report: Report) -> str:
    """How errors change with the whole identified model, on motions held out and where it was fitted."""
    held = report.held_out
    model = {effect.name for effect in (*report.effects, *report.provisional)}
    if not model:
        return ""
    names = causes(sorted(model), "and")
    before = held.baseline_rmse_rad
    after = held.identified_rmse_rad
    text = (
        f"With {names} the error on motions held out {_goes(before, after)} "
        f"({percent(held.reduction)} closed, 95 %: {percent_range(held.ci95)}); where it was fitted "
        f"it {_goes(report.baseline.rmse_rad, report.identified.rmse_rad)}."
    )
    return text + _judged(report)


def _goes(before: float, after: float) -> str:
    """``falls from 12 mrad to 3 mrad``."""
    verb = "falls" if after < before else "rises"
    return f"{verb} from {mrad(before)} to {mrad(after)}"


def _judged(report: Report) -> str:
    """What the layer as it was written leaves of motions that no fit saw."""
    delivered = report.delivered
    if delivered is None:
        return ""
    before = delivered.baseline_rmse_rad
    after = delivered.rmse_rad
    text = (
        f" On {delivered.trajectory}, which no fit saw, the layer as written leaves {mrad(after)}, "
        f"the plain model {mrad(before)}."
    )
    if after >= before:
        text += " It is no better there: do not rely on it for such motions."
    return text


def _credit(report: Report) -> str:
    """What the model leaves without each of several effects, so that none has credit for all."""
    parts: dict[str, list[str]] = {}
    for joint, effect, model in without_one(report):
        text = f"{mrad(model.held_out_rmse_rad)} without {plain(effect)}"
        parts.setdefault(joint, []).append(text)
    sentences = []
    for joint, each in parts.items():
        if len(each) > 1:
            where = f" on {joint}" if len(report.joints) > 1 else ""
            sentences.append(f" Each has its part{where}: held out it is {listing(each)}.")
    return "".join(sentences) if len(sentences) <= LISTED else ""


def without_one(report: Report) -> list[tuple[str, str, WholeModel]]:
    """Joint and effect of the identified model, and the model without it, where that was fitted."""
    held: dict[str, set[str]] = {}
    for effect in (*report.effects, *report.provisional):
        for joint in effect.joints:
            held.setdefault(joint, set()).add(effect.name)
    rows = []
    for model in report.compared:
        left_out = held.get(model.joint, set()).difference(model.effects)
        if len(left_out) == 1 and len(model.effects) == len(held[model.joint]) - 1:
            rows.append((model.joint, left_out.pop(), model))
    return rows


def _leftover(report: Report) -> str:
    """Whether more is missing than the identified model has."""
    left = report.identified.rmse_rad
    nothing = not report.provisional and not report.effects
    if nothing or left <= REPEATABLE * report.noise_floor_rad:
        return ""
    times = left / report.noise_floor_rad
    return (
        f" That is still {times:.0f} times the noise floor: more is missing that has no name here."
    )


def _besides(report: Report) -> str:
    """What else the names may stand for, and what else is missing."""
    text = ""
    if any(effect.name == "encoder_bias" for effect in report.effects):
        text = (
            " An encoder bias is first of all a difference of zeros between command and reading: "
            "compare them before you use the model."
        )
    for name, *others in report.ambiguous:
        if not any({name, *others}.issuperset(group) for group in report.open_sets):
            text += (
                f" {plain(name).capitalize()} stands for {causes(others, 'and')} too: commands and "
                "positions are the same, whichever it is."
            )
    return f"{text} More may be missing. {_leaves(report)}" if report.open_sets else text


def _leaves(report: Report) -> str:
    """Which models are still possible."""
    joints = [row.joint for row in report.joints if row.open_sets]
    if len(joints) > 1:
        return f"On {joints_text(joints)} several models are as good."
    models = [model_text(row.effects) for row in report.models if row.joint == joints[0]]
    return f"{len(models)} models are as good: {listing(models, 'or')}."


def model_text(effects: Iterable[str]) -> str:
    """``backlash with command delay``."""
    return " with ".join(map(plain, effects)) or "the plain servo"


def families_sentences(report: Report) -> list[str]:
    """What is known of the families of causes, a sentence a joint."""
    joints: dict[str, dict[str, list[str]]] = {}
    for verdict in get_args(Certainty):
        for row in report.families:
            if row.verdict == verdict:
                joints.setdefault(row.joint, {}).setdefault(verdict, []).append(row.name)
    sentences = []
    for joint, verdicts in joints.items():
        parts = []
        for verdict, names in verdicts.items():
            parts.append(f"{verdict}: {listing(names)}")
        sentences.append(f"{joint}: {'; '.join(parts)}")
    return sentences


def next_step(report: Report) -> str:
    """What to do with the outcome, in a sentence or two."""
    if report.next_experiment:
        return report.next_experiment
    if report.verdict == "no_gap":
        return "Nothing to do. Use the identified baseline; record other motions only if the task needs them."
    if report.verdict != "effects":
        return "The curves show when the model fails. Other motions may show why: vd-gap plan proposes which."
    layer = training_layer(report)
    use = "identified.usda has the servo's model, with every effect by name."
    if report.hand is not None:
        use = f"vd-train adapt POLICY --hand-layer {layer} goes on in it; vd-eval and vd-play take it too."
    return (
        f"Nothing is open. {use} To confirm that the gap is closed, run vd-gap on a new recording "
        f"with --hand-layer {LAYER}."
    )


def training_layer(report: Report) -> str:
    """The layer to train and evaluate with: every finger's."""
    closing = report.closing
    return LAYER if closing is None else closing.whole_hand_layer or closing.layer


def open_questions(report: Report) -> list[str]:
    """The whole models of each joint that are left open, with their errors."""
    joints = [row.joint for row in report.models]
    rows = []
    for row in report.models:
        if joints.count(row.joint) > 1:
            errors = f"{mrad(row.rmse_rad)} fitted, {mrad(row.held_out_rmse_rad)} held out"
            rows.append(f"{row.joint}: {model_text(row.effects)} ({errors})")
    return rows


def _size(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which a number is printed."""
    small = {"s": "ms", "rad": "mrad", "N m": "mN m"}.get(unit)
    return (1e3, small) if small and 0.0 < abs(value) < 1.0 else (1.0, unit_text(unit))


def _digits(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"
