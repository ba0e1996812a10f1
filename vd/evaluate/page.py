"""An evaluation, or a suite of them, as one HTML page, and as lines for a terminal."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vd.command.page import write_html
from vd.evaluate.goals import AIR_GOALS, CONSECUTIVE, HOLD_S
from vd.evaluate.result import OUTCOMES, SUCCESS, Protocol, Result, Row
from vd.evaluate.statistics import Interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Header and rows."""

NOTHING = "–"  # noqa: RUF001
WORDS = 3
"""Columns of the tables of rows that hold text."""
_RUN_FILES = ("policy.safetensors",)
"""Files that are called the same in every run, so that their folder tells more."""
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
GREY = "#8a8f98"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of policies in their order: those of Okabe and Ito, which colour-blind readers can tell apart."""
PANELS, PANEL_INCH = 3, (4.2, 3.6)
"""Panels of the figure side by side, and the size of one."""


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


def points(difference: Interval, unit: str = "") -> str:
    """``+1.2 (-0.4 to +2.8)``, of shares in per cent, with ``unit`` behind the first number."""
    value, low, high = (
        100 * share for share in (difference.value, difference.low, difference.high)
    )
    return f"{value:+.1f}{unit} ({low:+.1f} to {high:+.1f})"


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
    figures: Table | None = None,
    notes: Sequence[str] = (),
    conditions: Sequence[Sequence[str]] = (),
    of_paper: bool = False,
) -> None:
    """Write the page; all that follows ``path`` is of a suite.

    Its own table is ``figures``, the paper's beside ours or not; ``notes`` are of its objects.
    ``conditions`` have a name, the place in the paper or what is changed, and flags.
    """
    short = labels(result.policies)
    success, beside = _tables(result, short)
    headlines = [row for row in result.rows if row.headline]
    write_html(
        path,
        "evaluation.html",
        title=title or f"Evaluation of {', '.join(shown_name(name) for name in short.values())}",
        lead=lead or (asked([row.protocol for row in result.rows]) if result.rows else ""),
        notes=notes,
        success=success,
        beside=beside,
        hold_s=f"{HOLD_S:g}",
        air=_air_table(headlines, short),
        air_hold_s=f"{AIR_GOALS.hold_s:g}",
        consecutive=_consecutive_table(result.rows, short),
        differences=_differences(result, short),
        figures=figures,
        missing=[(condition, shown_name(policy), why) for condition, policy, why in result.missing],
        errors=ecdf_figure(result, short) if result.rows else None,
        bounds=_bound_table(headlines, short),
        warnings=result.warnings,
        objects=[]
        if conditions
        else [(_heading(row, short), *_object_table(row)) for row in headlines],
        conditions=conditions,
        of_paper=of_paper,
        protocol=[] if conditions else _protocol(result, short),
        software=result.software,
        units={row.overall.unit for row in result.rows},
    )


def terminal_text(result: Result) -> str:
    """Tables, warnings and what was asked, for a terminal.

    Of one policy without a suite by object too.
    """
    if not result.rows:
        return ""
    short, suite = labels(result.policies), any(row.condition for row in result.rows)
    parts = []
    for header, rows in _tables(result, short):
        # Only the first figure has its interval here: a line has to fit.
        cut = [
            [*row[: WORDS + 1], *(cell.split(" (")[0] for cell in row[WORDS + 1 :])] for row in rows
        ]
        parts.append(aligned([header, *cut], words=WORDS))
    header, rows = _air_table(result.rows, short)
    parts += [aligned([header, *rows], words=2)] if rows else []
    header, rows = _consecutive_table(result.rows, short)
    parts += [aligned([header, *rows], words=2)] if rows else []
    if len(result.policies) == 1 and not suite:
        for row in result.rows:
            if row.headline:
                header, rows = _object_table(row)
                parts.append(f"{_heading(row, short)}\n{aligned([header, *rows], words=1)}")
    parts += ["\n".join("  ".join(cells) for cells in _differences(result, short))]
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


def ecdf_figure(result: Result, short: dict[str, str]) -> "Figure":
    """Distributions of the errors at the stop or end, by each policy's own rule.

    A panel for each condition and group; ``short`` are names of the policies.
    """
    from matplotlib.figure import Figure

    headlines = result.headlines()
    columns = min(PANELS, len(headlines))
    rows = -(-len(headlines) // columns)
    figure = Figure(figsize=(columns * PANEL_INCH[0], rows * PANEL_INCH[1]), layout="constrained")
    angle = np.linspace(0.0, np.pi, 200)
    colour = dict(zip(result.policies, COLOURS * len(result.policies), strict=False))
    for panel, ((condition, group), found) in enumerate(headlines.items()):
        axes = figure.add_subplot(rows, columns, panel + 1)
        axes.spines[["top", "right"]].set_visible(False)
        for policy, row in found.items():
            # Lost objects count, but have no error: the curve ends below one.
            errors = np.sort([e.exact_error_rad for e in row.episodes if not e.fell])
            share = np.arange(len(errors) + 1) / len(row.episodes)
            steps = np.concatenate([[0.0], errors, [np.pi]]), np.append(share, share[-1])
            axes.step(*steps, where="post", color=colour[policy], label=short[policy])
        by_chance = (angle - np.sin(angle)) / np.pi  # of orientations uniform on SO(3)
        axes.plot(angle, by_chance, color=GREY, linestyle=":", label="at random")
        axes.axvline(row.protocol.stop_tolerance_rad, color=GREY, linewidth=0.6)
        axes.set(xlim=(0.0, np.pi), ylim=(0.0, 1.0), title=condition or group)
        axes.set(xlabel="error at the stop or end [rad]", ylabel="share of episodes")
        axes.legend(frameon=False, loc="lower right", fontsize=7)
    return figure


def _tables(result: Result, short: dict[str, str]) -> tuple[Table, Table]:
    """Of all rows: the figures by which policies are judged, and those beside them."""
    success, beside = [], []
    for row in result.rows:
        name = row.kind if row.kind == row.policy else f"{short[row.policy]} ({row.kind})"
        names, outcomes = (name, _where(row), _stopped_by(row)), row.overall.outcomes
        held = "not tried" if row.held is None else percent(row.held)
        success.append(
            (
                *names,
                percent(outcomes["success"]),
                held,
                "not tried" if row.precise is None else percent(row.precise),
                percent(outcomes["object falls"]),
            )
        )
        median, time_s = number(row.overall.median_error_rad), number(row.overall.time_s)
        beside.append((*names, percent(row.overall.symmetric), median, time_s))
    return (_HEADER, success), (_BESIDE_HEADER, beside)


def _object_table(row: Row) -> Table:
    """All objects of a row, and each."""
    return _OBJECT_HEADER, [
        (
            one.name,
            *map(percent, one.outcomes.values()),
            percent(one.symmetric),
            number(one.median_error_rad),
        )
        for one in (row.overall, *row.per_object)
    ]


def share(value: float | None) -> str:
    """``12.3 %``, or that there is none."""
    return "none" if value is None else f"{100 * value:.1f} %"


def _air_table(rows: Sequence[Row], short: dict[str, str]) -> Table:
    """What became of goals in a row in the air."""
    return _AIR_HEADER, [
        (
            short[row.policy],
            _where(row),
            percent(air.held),
            share(air.first),
            percent(air.in_a_row),
            share(air.lost),
            share(air.let_go),
        )
        for row in rows
        if (air := row.in_air) is not None
    ]


def _consecutive_table(rows: Sequence[Row], short: dict[str, str]) -> Table:
    """Successes in a row: of all objects, and of each where there are more."""
    return _CONSECUTIVE_HEADER, [
        (
            short[row.policy],
            _where(row) if one.name == "all" else one.name,
            f"{one.mean:.1f}",
            f"{one.median:g}",
            *map(share, (one.goals, one.lost, one.full)),
        )
        for row in rows
        for one in row.consecutive[: None if len(row.object_names) > 1 else 1]
    ]


def _bound_table(rows: Sequence[Row], short: dict[str, str]) -> Table:
    """What predictions are worth at each bound."""
    return _BOUND_HEADER, [
        (
            short[row.policy],
            _where(row),
            bound,
            share(seen),
            share(row.prediction.right[bound]),
            f"{row.prediction.mean_error_rad:.2f}",
        )
        for row in rows
        if row.prediction is not None
        for bound, seen in row.prediction.seen.items()
    ]


def _stopped_by(row: Row) -> str:
    """What stops a row's episodes, marked where that is ours."""
    return f"{row.stopped_by}; ours: {row.ours}" if row.ours else row.stopped_by


def _heading(row: Row, short: dict[str, str]) -> str:
    return f"{short[row.policy]}, {_where(row)}, stopped by {_stopped_by(row)}"


def _where(row: Row) -> str:
    """The objects of a row, and its condition where a suite names one."""
    return f"{row.group}, {row.condition}" if row.condition not in ("", row.group) else row.group


def _differences(result: Result, short: dict[str, str]) -> list[tuple[str, ...]]:
    return [
        (f"{short[other.policy]} over {short[first.policy]}", _where(first), points(d, " points"))
        for first, other, d in result.differences()
    ]


def asked(protocols: Sequence[Protocol]) -> str:
    """What was asked: hands, place, episodes, starts, goals, stop and randomisation.

    Hands alone differ.
    """
    protocol = protocols[0]
    layers = {
        shown_name(p.hand): "" if p.hand_layer is None else f" with {p.hand_layer}"
        for p in protocols
    }
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
    times = f"{protocol.episodes} episode{'s' * (protocol.episodes > 1)}"
    limit = f"{protocol.episode_s:g} s" + (" a goal" if protocol.consecutive else "")
    place = "palm up" if protocol.palm_up else "on the table"
    parts = (
        f"{hands} {'in the air' if protocol.in_air or protocol.air_goals else place}{table}",
        *(["goal after goal"] if protocol.air_goals or protocol.consecutive else []),
        f"{times} of {limit} for each object, seed {protocol.seed}",
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
