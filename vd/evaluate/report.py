"""The evaluation as one HTML page and as lines for a terminal."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vd.evaluate import plots
from vd.evaluate.result import TOLERANCES_RAD, EvalResult, Protocol, Summary
from vd.evaluate.statistics import CHANCE_MEAN_RAD, Interval
from vd.page import Page

_UNIT_NOTE = {
    "object": "Intervals over all objects are 95 % t intervals on the log odds, with the jackknife's "
    "standard error over whole objects: they speak about objects of this kind, not only about these.",
    "episode": "Intervals over all objects are 95 % t intervals on the log odds, with the jackknife's "
    "standard error over the episodes of each object: they speak about these very objects under new starts "
    "and goals. With so few objects nothing can be said about others.",
}


def shown_name(text: str) -> str:
    """Names, separated by commas, as a page prints them: of an absolute path its last two parts."""
    parts = (Path(name) for name in text.split(", "))
    return ", ".join("/".join(p.parts[-2:]) if p.is_absolute() else str(p) for p in parts)


def percent(interval: Interval) -> str:
    """``12.3 % (10.1 to 14.9)``."""
    return f"{100 * interval.value:.1f} % ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def number(interval: Interval | None, unit: str = "") -> str:
    """``0.41 (0.38 to 0.45)``, or a dash for None."""
    if interval is None:
        return "–"  # noqa: RUF001
    return f"{interval.value:.2f}{unit} ({interval.low:.2f} to {interval.high:.2f})"


def write_report(result: EvalResult, path: Path, *, pictures: bytes | None = None) -> None:
    """Write the page of an evaluation.

    Args:
        result: What was found.
        path: Of the page.
        pictures: PNG with the objects.
    """
    page = Page(f"Evaluation of {shown_name(result.protocol.policy)}", _lead(result))
    add_summary(page, result)
    if pictures is not None:
        page.section("Objects")
        page.figure(pictures, "The objects as they are simulated, each at its own scale.")
    add_figures(page, result)
    add_warnings(page, result.warnings)
    page.section("Every object")
    page.table(_HEADER, [_row(summary) for summary in (result.overall, *result.per_object)])
    page.section("Protocol")
    page.table(["setting", "value"], protocol_rows(result))
    page.text(method_note(result), small=True)
    page.write(path)


def warning_lines(warnings: Mapping[str, str]) -> list[str]:
    """A line for each object with warnings."""
    return [f"warning {name}: {words}" for name, words in warnings.items()]


def add_warnings(page: Page, warnings: Mapping[str, str]) -> None:
    """Add the objects with warnings, if there are any."""
    if warnings:
        page.section("Objects with warnings")
        page.text("What their import says of them; results on these objects may be those of something else.")
        page.table(["object", "warning"], list(warnings.items()), words=(1,))


def add_summary(page: Page, result: EvalResult) -> None:
    """Add the headline numbers with their intervals."""
    overall = result.overall
    tiles = [
        (
            f"{100 * rate.value:.1f} %",
            f"success within {name} rad of the very goal",
            f"95 %: {100 * rate.low:.1f} to {100 * rate.high:.1f}; chance {100 * overall.chance[name]:.2f}; "
            f"up to symmetry {100 * overall.symmetric[name].value:.1f} %",
        )
        for name, rate in overall.success.items()
    ]
    error, drop, time = overall.median_error_rad, overall.drop_rate, overall.time_to_success_s
    tiles += [
        (
            f"{error.value:.2f} rad",
            "median error",
            f"95 %: {error.low:.2f} to {error.high:.2f}; drops count as pi",
        ),
        (
            f"{100 * drop.value:.1f} %",
            "dropped",
            f"95 %: {100 * drop.low:.1f} to {100 * drop.high:.1f}",
        ),
        (
            f"{100 * overall.stop_rate.value:.1f} %",
            "stopped by itself: oriented and still",
            f"95 %: {100 * overall.stop_rate.low:.1f} to {100 * overall.stop_rate.high:.1f}",
        ),
        (
            "none" if time is None else f"{time.value:.1f} s",
            "median time to that stop",
            "no episode stopped" if time is None else f"95 %: {time.low:.1f} to {time.high:.1f}",
        ),
    ]
    page.tiles(tiles)


def add_figures(page: Page, result: EvalResult) -> None:
    """Add the error distributions and the success of each object."""
    note = plots.drawn_note(result)
    page.section("Errors")
    page.figure(
        plots.ecdf_figure(result),
        "Empirical distribution of the orientation error at the end or stop of every episode. A dropped "
        "object never counts, so the curve ends at one minus the drop rate.",
    )
    page.figure(plots.violin_figure(result), f"The same errors by object, best median first.{note}")
    page.figure(plots.success_figure(result), f"Success by object with 95 % intervals.{note}")


def protocol_rows(result: EvalResult) -> list[tuple[str, str]]:
    """Setting and value pairs that say how the numbers were made."""
    protocol = result.protocol
    rows = [
        ("policy", shown_name(protocol.policy)),
        ("objects", f"{shown_name(protocol.objects)} ({len(result.object_names)})"),
        ("hand", shown_name(protocol.hand_name)),
        ("starts and goals", f"{protocol.episodes} each for every object, seed {protocol.seed}"),
        ("starts", starts_text(protocol)),
        ("goals", goals_text(protocol)),
        ("stop", f"error at most {protocol.stop_tolerance_rad:g} rad, fingers and object still"),
        ("time limit", f"{protocol.episode_s:g} s at {protocol.control_hz:g} Hz"),
        ("randomisation, noise, disturbances", protocol.randomisation_text),
    ]
    return rows + [(name, version) for name, version in result.software.items()]


def task_line(result: EvalResult) -> str:
    """One line that says what was asked: starts, goals, stop and randomisation."""
    protocol = result.protocol
    randomisation = protocol.randomisation_text
    return (
        f"starts {starts_text(protocol)}; goals {goals_text(protocol)}; stop within "
        f"{protocol.stop_tolerance_rad:g} rad and still; randomisation {randomisation}"
        + ("; stuck hands are nudged" if protocol.nudge else "")
        + ("; actions have noise far from the goal" if protocol.explore else "")
        + ("; aimed past goals that are near" if protocol.aim else "")
        + ("; goals not reached are looked at in other views" if protocol.second_view else "")
    )


def starts_text(protocol: Protocol) -> str:
    """How episodes start, in words."""
    if protocol.at_rest:
        return "at rest on the table, as the environment draws them"
    return "dropped into the hand, uniform on SO(3)"


def goals_text(protocol: Protocol) -> str:
    """Where goals lie, in words."""
    angle = protocol.max_goal_angle_rad
    if protocol.goals_about_vertical:
        return f"turned about the vertical by at most {angle:g} rad"
    return "uniform on SO(3)" if angle >= np.pi - 1e-6 else f"uniform within {angle:g} rad of the start"


def method_note(result: EvalResult) -> str:
    """How errors and intervals are to be read."""
    return (
        "Actions are the policy's means. Errors are measured at the end of an episode or at the first step "
        "at which all success criteria hold, never as the least error on the way. They are those to the very "
        "goal; up to symmetry the least over the object's symmetry rotations counts, but the stop itself "
        "knows none: an object that only looks like the goal is not stopped there, and where it ends counts. "
        "A dropped object fails at every tolerance. Chance is an "
        f"orientation drawn uniformly from SO(3): mean error {CHANCE_MEAN_RAD:.2f} rad for an asymmetric "
        f"object; the mean measured here, drops included, is {result.overall.mean_error_rad:.2f} rad. "
        f"{_UNIT_NOTE[result.overall.unit]} Those of a single object are over its episodes. Where all "
        "outcomes agree the interval is Clopper and Pearson's exact one, which takes episodes as "
        "independent. Times have distribution-free intervals between order statistics."
    )


def terminal_table(result: EvalResult) -> str:
    """A table for the terminal, worst objects last."""
    rows = [_row(summary) for summary in (result.overall, *result.per_object)]
    widths = [max(len(str(row[i])) for row in [_HEADER, *rows]) for i in range(len(_HEADER))]
    lines = [
        "  ".join(str(cell).ljust(w) if i == 0 else str(cell).rjust(w) for i, (cell, w) in enumerate(cells))
        for cells in (list(zip(row, widths, strict=True)) for row in [_HEADER, *rows])
    ]
    return "\n".join(lines)


_HEADER = (
    "object",
    "episodes",
    *(f"<= {tolerance:g} rad" for tolerance in TOLERANCES_RAD),
    f"<= {plots.HEADLINE_TOLERANCE_RAD:g} up to symmetry",
    "median error [rad]",
    "stopped",
    "time to stop [s]",
    "dropped",
)


def _row(summary: Summary) -> list[str]:
    return [
        summary.name,
        str(summary.episodes),
        *(percent(rate) for rate in summary.success.values()),
        percent(summary.symmetric[str(plots.HEADLINE_TOLERANCE_RAD)]),
        number(summary.median_error_rad),
        percent(summary.stop_rate),
        number(summary.time_to_success_s),
        percent(summary.drop_rate),
    ]


def _lead(result: EvalResult) -> str:
    protocol = result.protocol
    return (
        f"{len(result.episodes)} episodes; objects: {len(result.object_names)} of "
        f"{shown_name(protocol.objects)}, {protocol.episodes} starts and goals each, "
        f"{shown_name(protocol.hand_name)}; {task_line(result)}"
    )
