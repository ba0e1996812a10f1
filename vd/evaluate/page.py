"""An evaluation, or a suite of them, as one HTML page, and as lines for a terminal."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vd.evaluate.plots import ecdf_figure
from vd.evaluate.result import OUTCOMES, SUCCESS, Protocol, Result, Row, Summary
from vd.evaluate.statistics import Interval
from vd.evaluate.trace import HOLD_S
from vd.page import write_html
from vd.paper import PAPER

NOTHING = "–"  # noqa: RUF001
WORDS = 3
"""Columns of the tables of rows that hold text."""
_RUN_FILES = ("policy.pt",)
"""Files that are called the same in every run, so that their folder tells more."""
_NAMES = ("policy", "objects", "stopped by")
_HEADER = (*_NAMES, "success", f"and held {HOLD_S:g} s", "within 0.1 rad", "lost")
_BESIDE_HEADER = (*_NAMES, "up to symmetry", "median error [rad]", "time [s]")
_OBJECT_HEADER = ("object", *OUTCOMES, "up to symmetry", "median error [rad]")
_BOUND_HEADER = ("policy", "objects", "bound [rad]", "near and seen so", "said and right", "mean error [rad]")


def shown_name(text: str) -> str:
    """Names, separated by commas, as a page prints them: of an absolute path its last two parts."""
    parts = (Path(name) for name in text.split(", "))
    return ", ".join("/".join(p.parts[-2:]) if p.is_absolute() else str(p) for p in parts)


def percent(interval: Interval) -> str:
    """``12.3 % (10.1 to 14.9)``."""
    return f"{100 * interval.value:.1f} % ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def number(interval: Interval | None) -> str:
    """``0.41 (0.38 to 0.45)``, or a dash for None."""
    if interval is None:
        return NOTHING
    return f"{interval.value:.2f} ({interval.low:.2f} to {interval.high:.2f})"


def labels(names: Sequence[str]) -> dict[str, str]:
    """Short names of policies: the ends of their paths that tell them apart."""

    def telling(name: str) -> tuple[str, ...]:
        parts = Path(name).parts
        return parts[:-1] if len(parts) > 1 and parts[-1] in _RUN_FILES else parts

    short = {}
    for name in names:
        parts = telling(name)
        others = [telling(other) for other in names if other != name]
        lengths = range(1, len(parts))
        enough = (n for n in lengths if all(parts[-n:] != other[-n:] for other in others))
        short[name] = "/".join(parts[-next(enough, len(parts)) :])
    return short


def write_page(
    result: Result,
    path: Path,
    *,
    title: str = "",
    lead: str = "",
    figures: tuple[Sequence[str], Sequence[Sequence[str]]] | None = None,
    notes: Sequence[str] = (),
    conditions: Sequence[Sequence[str]] = (),
    of_paper: bool = False,
) -> None:
    """Write the page.

    Args:
        result: What was found.
        path: Of the page.
        title: By default the policies.
        lead: By default what was asked.
        figures: Of a suite: its table, header and rows.
        notes: Of a suite: what has to be said of its objects.
        conditions: Of a suite: name, place in the paper or what is changed, and flags of each.
        of_paper: Whether the figures are the paper's beside ours.
    """
    short = labels(result.policies)
    shown = [shown_name(short[name]) for name in result.policies]
    write_html(
        path,
        "evaluation.html",
        title=title or f"Evaluation of {', '.join(shown)}",
        lead=lead or (asked([row.protocol for row in result.rows]) if result.rows else ""),
        notes=notes,
        header=_HEADER,
        rows=[_cells(row, short) for row in result.rows],
        beside_header=_BESIDE_HEADER,
        beside=[_beside_cells(row, short) for row in result.rows],
        hold_s=f"{HOLD_S:g}",
        differences=_difference_cells(result, short),
        figures=figures,
        missing=[(condition, shown_name(policy), why) for condition, policy, why in result.missing],
        errors=ecdf_figure(result, short) if result.rows else None,
        bound_header=_BOUND_HEADER,
        bounds=_bound_cells(result, short),
        warnings=result.warnings,
        object_header=_OBJECT_HEADER,
        objects=[]
        if conditions
        else [(_heading(r, short), _object_cells(r)) for r in result.rows if r.headline],
        conditions=conditions,
        of_paper=of_paper,
        protocol=[] if conditions else _protocol(result, short),
        software=result.software,
        units={row.overall.unit for row in result.rows},
    )


def terminal_text(result: Result) -> str:
    """Tables, warnings and what was asked, for a terminal; of one policy without a suite by object too."""
    if not result.rows:
        return ""
    short, suite = labels(result.policies), any(row.condition for row in result.rows)
    parts = []
    for header, cells in ((_HEADER, _cells), (_BESIDE_HEADER, _beside_cells)):
        # Only the first figure has its interval here: a line has to fit.
        rows = [
            [
                cell if column <= WORDS else cell.split(" (")[0]
                for column, cell in enumerate(cells(row, short))
            ]
            for row in result.rows
        ]
        parts.append(aligned([header, *rows], words=WORDS))
    if len(result.policies) == 1 and not suite:
        parts += [
            f"{_heading(row, short)}\n{aligned([_OBJECT_HEADER, *_object_cells(row)], words=1)}"
            for row in result.rows
            if row.headline
        ]
    parts += ["\n".join("  ".join(cells) for cells in _difference_cells(result, short))]
    parts += [f"warning {name}: {words}" for name, words in result.warnings.items()]
    parts += [] if suite else [asked([row.protocol for row in result.rows])]
    return "\n\n".join(part for part in parts if part)


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


def _named(row: Row, short: dict[str, str]) -> str:
    """A policy with its kind; zero and random are their own."""
    return row.kind if row.kind == row.policy else f"{short[row.policy]} ({row.kind})"


def _stopped_by(row: Row) -> str:
    """What stops a row's episodes, marked where that is ours."""
    return f"{row.stopped_by}; ours: {row.ours}" if row.ours else row.stopped_by


def _heading(row: Row, short: dict[str, str]) -> str:
    return f"{short[row.policy]}, {row.group}, stopped by {_stopped_by(row)}"


def _where(row: Row) -> str:
    """The objects of a row, and its condition where a suite names one."""
    return f"{row.group}, {row.condition}" if row.condition not in ("", row.group) else row.group


def _names(row: Row, short: dict[str, str]) -> tuple[str, ...]:
    return _named(row, short), _where(row), _stopped_by(row)


def _cells(row: Row, short: dict[str, str]) -> tuple[str, ...]:
    return (
        *_names(row, short),
        percent(row.overall.outcomes["success"]),
        "not tried" if row.held is None else percent(row.held),
        percent(row.precise),
        percent(row.overall.outcomes["object falls"]),
    )


def _beside_cells(row: Row, short: dict[str, str]) -> tuple[str, ...]:
    return (
        *_names(row, short),
        percent(row.symmetric),
        number(row.overall.median_error_rad),
        number(row.overall.time_s),
    )


def _object_cells(row: Row) -> list[tuple[str, ...]]:
    def cells(summary: Summary) -> tuple[str, ...]:
        return (
            summary.name,
            *(percent(rate) for rate in summary.outcomes.values()),
            percent(summary.symmetric[str(PAPER.success.rotation_rad)]),
            number(summary.median_error_rad),
        )

    return [cells(summary) for summary in (row.overall, *row.per_object)]


def _difference_cells(result: Result, short: dict[str, str]) -> list[tuple[str, ...]]:
    return [
        (
            f"{short[other.policy]} over {short[first.policy]}",
            _where(first),
            f"{100 * d.value:+.1f} points ({100 * d.low:+.1f} to {100 * d.high:+.1f})",
        )
        for first, other, d in result.differences()
    ]


def _bound_cells(result: Result, short: dict[str, str]) -> list[tuple[str, ...]]:
    def share(value: float | None) -> str:
        return "none" if value is None else f"{100 * value:.1f} %"

    return [
        (
            short[row.policy],
            _where(row),
            bound,
            share(row.prediction.seen[bound]),
            share(row.prediction.right[bound]),
            f"{row.prediction.mean_error_rad:.2f}",
        )
        for row in result.rows
        if row.prediction is not None and row.headline
        for bound in row.prediction.seen
    ]


def asked(protocols: Sequence[Protocol]) -> str:
    """What was asked: hands, place, episodes, starts, goals, stop and randomisation; hands alone differ."""
    protocol = protocols[0]
    layers = {shown_name(p.hand): "" if p.hand_layer is None else f" with {p.hand_layer}" for p in protocols}
    hands = ", ".join(f"{hand}{layer}" for hand, layer in layers.items())
    angle = protocol.max_goal_angle_rad
    if protocol.goals_about_vertical:
        goals = f"turned about the vertical by at most {angle:g} rad"
    elif angle >= np.pi - 1e-6:
        goals = "uniform on SO(3)"
    else:
        goals = f"uniform within {angle:g} rad of the start"
    rest = "at rest on the table, as the environment draws them"
    table = "" if protocol.table_friction is None else f" of friction {protocol.table_friction:g}"
    parts = (
        f"{hands} {'in the air' if protocol.in_air else 'on the table'}{table}",
        f"{protocol.episodes} episodes of {protocol.episode_s:g} s for each object, seed {protocol.seed}",
        f"starts {rest if protocol.at_rest else 'dropped into the hand, uniform on SO(3)'}",
        f"goals {goals}",
        f"stop within {protocol.stop_tolerance_rad:g} rad",
        f"randomisation {protocol.randomisation}",
        *([] if protocol.engine == "newton" else ["physics by MuJoCo's own engine"]),
    )
    return "; ".join(parts)


def _protocol(result: Result, short: dict[str, str]) -> list[tuple[str, str]]:
    """What each policy sees and stops by, and the objects of each group."""
    known = {"mesh": "the exact mesh", "points": "500 exact points", "scan": "500 points of a scan"}
    groups = {row.group: row.protocol.objects for row in result.rows}
    rows = [(f"objects: {name}", shown_name(sets)) for name, sets in groups.items()]
    for row in result.rows:
        told = f"sees {row.sees}"
        if row.sees.endswith("clouds"):
            errs = ", which err as a real camera does" if row.protocol.sensor_errors else ""
            told += f"{errs}; knows shapes and goals by {known[row.protocol.goals]}"
        if row.stopped_by != SUCCESS:
            told += f"; stops below {row.rule.distance_rad:.3g} rad, action norm {row.rule.action_norm:.3g}"
            rows.append((f"{short[row.policy]}, {row.group}, by {_stopped_by(row)}", told))
    return rows
