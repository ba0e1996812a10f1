"""The evaluation as one HTML page and as lines for a terminal."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from vd.evaluate import plots
from vd.evaluate.result import TOLERANCES_RAD, EvalResult, Protocol, Summary
from vd.evaluate.statistics import CHANCE_MEAN_RAD, Interval
from vd.page import write_html


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
    write_html(
        path,
        "evaluation.html",
        policy=shown_name(result.protocol.policy),
        lead=_lead(result),
        result=result,
        headline=_headline(result),
        pictures=pictures,
        ecdf=plots.ecdf_figure(result),
        violins=plots.violin_figure(result),
        by_object=plots.success_figure(result),
        drawn_note=plots.drawn_note(result),
        header=_HEADER,
        rows=[_row(summary) for summary in (result.overall, *result.per_object)],
        protocol=_protocol_rows(result),
        chance_mean=f"{CHANCE_MEAN_RAD:.2f}",
        mean=f"{result.overall.mean_error_rad:.2f}",
    )


def warning_lines(warnings: Mapping[str, str]) -> list[str]:
    """A line for each object with warnings."""
    return [f"warning {name}: {words}" for name, words in warnings.items()]


def _headline(result: EvalResult) -> list[tuple[str, str, str]]:
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
    return [
        *tiles,
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


def _protocol_rows(result: EvalResult) -> list[tuple[str, str]]:
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


def terminal_table(result: EvalResult) -> str:
    """A table for the terminal, worst objects last."""
    return aligned([_HEADER, *(_row(summary) for summary in (result.overall, *result.per_object))], words=1)


def aligned(rows: Sequence[Sequence[str]], *, words: int) -> str:
    """Rows of cells as lines of text: the first ``words`` columns flush left, the others right."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column < words else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


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
