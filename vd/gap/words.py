"""What ``vd-gap`` found in plain sentences, for the terminal and the page."""

from collections.abc import Iterable, Sequence

from vd.gap.result import LAYER, Estimate, Interval, NamedEffect, Report

LISTED = 4
"""More joints than this are counted rather than listed, and no more curves are drawn than this. Not
tuned.
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
    value, low, high = (f"{factor * x:.4g}" for x in (one.value, *one.ci95))
    return f"{value} {shown}".strip() + f" (95 %: {low} to {high})"


def effects_sentence(effects: Iterable[NamedEffect]) -> str:
    """``backlash on f0_j1 (40 mrad), f0_j2 (12 mrad) and dead zone on f0_j3 (8 mrad)``.

    Each name once.
    """
    places: dict[str, list[str]] = {}
    for effect in effects:
        sizes = ", ".join(amount(p.value, p.unit) for p in effect.parameters.values())
        places.setdefault(effect.name, []).append(f"{joints_text(effect.joints)} ({sizes})")
    return listing(f"{plain(name)} on {', '.join(where)}" for name, where in places.items())


def verdict_sentence(report: Report) -> str:
    """The verdict in one or two sentences that need no context."""
    before, after = (
        mrad(report.held_out.baseline_rmse_rad),
        mrad(report.held_out.identified_rmse_rad),
    )
    sizes = f"{before} on motions that the fit has not seen, against a noise floor of "
    sizes += mrad(report.noise_floor_rad)
    if report.verdict == "effects":
        lacks = f"The simulation lacks {effects_sentence(report.effects)}. "
        return lacks + _shrinks(report) + _besides(report)
    if report.verdict == "ambiguous":
        text = f"There is a gap: {sizes}. {_leaves(report)}"
        if report.provisional:
            text += f" With {effects_sentence(report.provisional)} it falls to {after}."
        return text
    if report.verdict == "no_gap":
        model = (
            "plain servo model" if report.hand_layer is None else f"model in {report.hand_layer}"
        )
        return (
            f"No gap: the {model} explains this recording. It leaves {sizes}: no more than noise, "
            "or what no candidate explains."
        )
    if report.verdict == "under_excited":
        return (
            "No verdict on effects: the motions in this recording do not determine the model. "
            "Different parameters fit equally well."
        )
    return f"There is a gap: {sizes}. No effect that was tried explains it."


def _shrinks(report: Report) -> str:
    held, names = report.held_out, {one.name for one in report.effects}
    return (
        f"With {'it' if len(names) == 1 else 'them'} the error on motions that the fit has not "
        f"seen falls from {mrad(held.baseline_rmse_rad)} to {mrad(held.identified_rmse_rad)} "
        f"({percent(held.reduction)} less, 95 %: {percent_range(held.ci95)}); the noise floor is "
        f"{mrad(report.noise_floor_rad)}."
    )


def _besides(report: Report) -> str:
    """What else the names may stand for, and what else is missing."""
    text = ""
    if any(effect.name == "encoder_bias" for effect in report.effects):
        text += (
            " An encoder bias is first of all a difference of zeros between command and reading: "
            "compare them before you use the model."
        )
    for name, *others in report.ambiguous:
        if not any({name, *others} >= {*group} for group in report.open_sets):
            text += (
                f" {plain(name).capitalize()} stands for {causes(others, 'and')} too: commands and "
                "positions are the same, whichever it is."
            )
    return f"{text} More is missing. {_leaves(report)}" if report.open_sets else text


def _leaves(report: Report) -> str:
    """Which causes are still possible."""
    if len(report.open_sets) == 1:
        (group,) = report.open_sets
        where = f" on {_undecided(report, group)}" if len(report.joints) > 1 else ""
        return f"It is {causes(group)}{where}; this recording cannot say which."
    return f"This recording leaves {len(report.open_sets)} sets of causes, listed under what to do next."


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
    """What is left open, joints with the same set together: ``f0_j1: backlash or dead zone``."""
    return [f"{_undecided(report, group)}: {causes(group)}" for group in report.open_sets]


def _undecided(report: Report, group: tuple[str, ...]) -> str:
    """The joints that leave a set open."""
    return joints_text([one.joint for one in report.joints if {*group} in map(set, one.open_sets)])


def _size(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which a number is printed."""
    small = {"s": "ms", "rad": "mrad", "N m": "mN m"}.get(unit)
    return (1e3, small) if small and 0.0 < abs(value) < 1.0 else (1.0, unit_text(unit))


def _digits(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"
