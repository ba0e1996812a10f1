"""An evaluation, or a suite of them, as one HTML page, and as lines for a terminal."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from vd.command.page import write_html
from vd.evaluate.goals import AIR_GOALS, CONSECUTIVE, HOLD_S
from vd.evaluate.result import OUTCOMES, SUCCESS, Protocol, Result, Row
from vd.evaluate.statistics import Interval

Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Header and rows."""
NOTHING = "–"  # noqa: RUF001
WORDS = 3
"""Columns of the tables of rows that hold text."""
POLICY_FILE = "policy.safetensors"
"""File that is called the same in every run, so that its folder tells more."""
_NAMES = ("policy", "objects", "stopped by")
_HEADER = (*_NAMES, "success", f"and held {HOLD_S:g} s", "within 0.1 rad", "lost")
_BESIDE_HEADER = (*_NAMES, "up to symmetry", "median error [rad]", "time [s]")
_AIR_HEADER = ("policy", "objects", "held", "first goal", "three in a row", "lost", "let go")
_CONSECUTIVE_HEADER = (
    "policy",
    "objects",
    "in a row, mean",
    "median",
    "of all goals",
    "lost",
    f"{CONSECUTIVE.most} in a row",
)
_OBJECT_HEADER = ("object", *OUTCOMES, "up to symmetry", "median error [rad]")
_BOUND_HEADER = (
    "policy",
    "objects",
    "bound [rad]",
    "near and seen so",
    "said and right",
    "mean error [rad]",
)


def shown_name(text: str) -> str:
    """Names, separated by commas, as a page prints them: of an absolute path its last two parts."""
    names = []
    for name in text.split(", "):
        path = Path(name)
        names.append("/".join(path.parts[-2:]) if path.is_absolute() else str(path))
    return ", ".join(names)


def labels(names: Sequence[str]) -> dict[str, str]:
    """Short names of policies: the last part of each path where no other has the same."""
    paths = {}
    for name in names:
        path = Path(name)
        paths[name] = path.parent if path.name == POLICY_FILE else path
    last_parts = [path.name for path in paths.values()]
    short = {}
    for name, path in paths.items():
        short[name] = path.name if last_parts.count(path.name) == 1 else str(path)
    return short


def shortened(result: Result) -> Result:
    """A result with the short names of its policies."""
    short = labels(result.policies)
    rows = tuple(replace(row, policy=short[row.policy]) for row in result.rows)
    return replace(result, rows=rows)


def percent(rate: Interval | float | None) -> str:
    """``12.3 % (10.1 to 14.9)``, without its interval ``12.3 %``, or a dash for None."""
    if rate is None:
        return NOTHING
    if isinstance(rate, Interval):
        return f"{100 * rate.value:.1f} % ({100 * rate.low:.1f} to {100 * rate.high:.1f})"
    return f"{100 * rate:.1f} %"


def number(interval: Interval | None) -> str:
    """``0.41 (0.38 to 0.45)``, or a dash for None."""
    if interval is None:
        return NOTHING
    return f"{interval.value:.2f} ({interval.low:.2f} to {interval.high:.2f})"


def points(difference: Interval) -> str:
    """A difference of shares in per cent: ``+1.2 points (-0.4 to +2.8)``."""
    low = 100 * difference.low
    high = 100 * difference.high
    return f"{100 * difference.value:+.1f} points ({low:+.1f} to {high:+.1f})"


def write_page(
    result: Result,
    path: Path,
    *,
    title: str = "",
    lead: str = "",
    figures: Table | None = None,
    notes: Sequence[str] = (),
    conditions: Sequence[Sequence[str]] = (),
    of_paper: bool = False,
) -> None:
    """Write the page; all that follows ``path`` is of a suite.

    Its own table is ``figures``, the paper's beside ours or not; ``notes`` are of its objects.
    ``conditions`` have a name, the place in the paper or what is changed, and flags.
    """
    result = shortened(result)
    headlines = [row for row in result.rows if row.headline]
    missing = []
    for condition, policy, why in result.missing:
        missing.append((condition, shown_name(policy), why))
    objects = []
    for row in headlines:
        heading = f"{row.policy}, {_where(row)}, stopped by {row.stopped_by}"
        objects.append((heading, *_object_table(row)))
    write_html(
        path,
        "evaluation.html",
        title=title or f"Evaluation of {', '.join(map(shown_name, result.policies))}",
        lead=lead or settings_text([row.protocol for row in result.rows]),
        notes=notes,
        success=_success_table(result.rows),
        beside=_beside_table(result.rows),
        hold_s=f"{HOLD_S:g}",
        air=_air_table(headlines),
        air_hold_s=f"{AIR_GOALS.hold_s:g}",
        consecutive=_consecutive_table(result.rows),
        differences=_differences(result),
        figures=figures,
        missing=missing,
        bounds=_bound_table(headlines),
        warnings=result.warnings,
        objects=[] if conditions else objects,
        conditions=conditions,
        of_paper=of_paper,
        protocol=[] if conditions else _protocol(result),
        software=result.software,
        units={row.overall.unit for row in result.rows},
    )


def terminal_text(result: Result) -> str:
    """The main tables, warnings and settings, for a terminal; the page has all others."""
    if not result.rows:
        return ""
    result = shortened(result)
    header, rows = _success_table(result.rows)
    lines = [header]
    for row in rows:
        # Only the first figure has its interval here: a line has to fit.
        figures = [cell.split(" (")[0] for cell in row[WORDS + 1 :]]
        lines.append([*row[: WORDS + 1], *figures])
    parts = [aligned(lines, words=WORDS)]
    for header, rows in (_air_table(result.rows), _consecutive_table(result.rows)):
        if rows:
            parts.append(aligned([header, *rows], words=2))
    parts += map("  ".join, _differences(result))
    parts += [f"warning {name}: {warning}" for name, warning in result.warnings.items()]
    if not any(row.condition for row in result.rows):
        parts.append(settings_text([row.protocol for row in result.rows]))
    return "\n\n".join(parts)


def aligned(rows: Sequence[Sequence[str]], *, words: int) -> str:
    """Rows of cells as lines of text: the first ``words`` columns flush left, the others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = []
        for column, (cell, width) in enumerate(zip(row, widths, strict=True)):
            cells.append(cell.ljust(width) if column < words else cell.rjust(width))
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _success_table(rows: Sequence[Row]) -> Table:
    """The figures by which policies are judged."""
    lines = []
    for row in rows:
        outcomes = row.overall.outcomes
        lines.append(
            (
                *_names(row),
                percent(outcomes["success"]),
                percent(row.held),
                percent(row.precise),
                percent(outcomes["object falls"]),
            )
        )
    return _HEADER, lines


def _beside_table(rows: Sequence[Row]) -> Table:
    """The figures beside those."""
    lines = []
    for row in rows:
        overall = row.overall
        lines.append(
            (
                *_names(row),
                percent(overall.symmetric),
                number(overall.median_error_rad),
                number(overall.time_s),
            )
        )
    return _BESIDE_HEADER, lines


def _names(row: Row) -> tuple[str, str, str]:
    """What a row is of: policy, objects, stop."""
    policy = row.policy
    if row.kind != row.policy:
        policy = f"{policy} ({row.kind})"
    return policy, _where(row), row.stopped_by


def _object_table(row: Row) -> Table:
    """All objects of a row, and each."""
    lines = [
        (
            summary.name,
            *map(percent, summary.outcomes.values()),
            percent(summary.symmetric),
            number(summary.median_error_rad),
        )
        for summary in (row.overall, *row.per_object)
    ]
    return _OBJECT_HEADER, lines


def _air_table(rows: Sequence[Row]) -> Table:
    """What became of goals in a row in the air."""
    lines = []
    for row in rows:
        air = row.in_air
        if air is not None:
            lines.append(
                (
                    row.policy,
                    _where(row),
                    percent(air.held),
                    percent(air.first),
                    percent(air.in_a_row),
                    percent(air.lost),
                    percent(air.let_go),
                )
            )
    return _AIR_HEADER, lines


def _consecutive_table(rows: Sequence[Row]) -> Table:
    """Successes in a row: of all objects, and of each where there are more."""
    lines = []
    for row in rows:
        for count in row.consecutive:
            if count.name != "all" and len(row.object_names) == 1:
                continue
            lines.append(
                (
                    row.policy,
                    _where(row) if count.name == "all" else count.name,
                    f"{count.mean:.1f}",
                    f"{count.median:g}",
                    percent(count.goals),
                    percent(count.lost),
                    percent(count.full),
                )
            )
    return _CONSECUTIVE_HEADER, lines


def _bound_table(rows: Sequence[Row]) -> Table:
    """What predictions are worth at each bound."""
    lines = []
    for row in rows:
        prediction = row.prediction
        if prediction is None:
            continue
        for bound, seen in prediction.seen.items():
            lines.append(
                (
                    row.policy,
                    _where(row),
                    bound,
                    percent(seen),
                    percent(prediction.right[bound]),
                    f"{prediction.mean_error_rad:.2f}",
                )
            )
    return _BOUND_HEADER, lines


def _where(row: Row) -> str:
    """The objects of a row, and its condition where a suite names one."""
    return f"{row.group}, {row.condition}" if row.condition not in ("", row.group) else row.group


def _differences(result: Result) -> list[tuple[str, str, str]]:
    lines = []
    for first, other, difference in result.differences():
        pair = f"{other.policy} over {first.policy}"
        lines.append((pair, _where(first), points(difference)))
    return lines


def settings_text(protocols: Sequence[Protocol]) -> str:
    """The settings of evaluations that are not the usual ones; empty: there is no evaluation.

    Policies differ in few of them, such as the hand: then all values are told.
    """
    parts = []
    for setting in fields(Protocol):
        values: list[Any] = []
        for protocol in protocols:
            value = getattr(protocol, setting.name)
            if isinstance(value, float):
                value = f"{value:.4g}"
            if value not in (*values, setting.default, None):
                values.append(value)
        name = setting.name.replace("_", " ")
        if values == [True]:
            parts.append(name)
        elif values and setting.name != "objects":
            parts.append(f"{name} {shown_name(', '.join(map(str, values)))}")
    return "; ".join(parts)


def _protocol(result: Result) -> list[tuple[str, str]]:
    """The objects of each group, and what each policy sees and stops by."""
    lines = []
    for group in dict.fromkeys(row.group for row in result.rows):
        sets = next(row.protocol.objects for row in result.rows if row.group == group)
        lines.append((f"objects: {group}", shown_name(sets)))
    for row in result.rows:
        rule = f"sees {row.sees}"
        if row.stopped_by != SUCCESS:
            bounds = f"{row.rule.distance_rad:.3g} rad, action norm {row.rule.action_norm:.3g}"
            rule = f"{rule}; stops below {bounds}"
        lines.append((f"{row.policy}, {row.group}, by {row.stopped_by}", rule))
    return lines
