"""An evaluation as one HTML page, its figures, and lines for a terminal."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vd.evaluate.comparison import OUTCOMES, SUCCESS, Comparison, Row
from vd.evaluate.plots import (
    BLUE,
    GREEN,
    GREY,
    HEADLINE_TOLERANCE_RAD,
    ORANGE,
    drawn_note,
    ecdf,
    violin_figure,
)
from vd.evaluate.result import TOLERANCES_RAD, Protocol
from vd.evaluate.statistics import CHANCE_MEAN_RAD, Interval, chance_cdf
from vd.evaluate.trace import HOLD_S
from vd.page import write_html
from vd.paper import PAPER

COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of policies, in their order (Okabe and Ito)."""
OUTCOME_COLOURS = dict(zip(OUTCOMES, (GREEN, "#E69F00", GREY, ORANGE), strict=True))
PANEL_WIDTH, PANEL_HEIGHT = 4.2, 3.9
"""Of one panel of a figure [inch]."""
_RUN_FILES = ("policy.pt", "student.pt")
"""Files that are called the same in every run, so that their folder tells more."""
NEAR_RAD = 0.4
"""Range of the second panel of the scatter, where predictions decide."""
_HEADER = (
    "policy",
    "objects",
    "stopped by",
    "success",
    f"and held {HOLD_S:g} s",
    "success up to symmetry",
    "median error [rad]",
)
"""Of the headline, which is against the very goal but for one column."""
_REST_HEADER = ("policy", "objects", "stopped by", *OUTCOMES[1:], "time to stop [s]")
_BOUND_HEADER = (
    "policy",
    "objects",
    "bound [rad]",
    "near and seen so",
    "said and right",
    "stops within, by prediction",
    "stops within, by true distance",
    "mean error [rad]",
)
_OBJECT_HEADER = (
    "object",
    "episodes",
    *(f"<= {tolerance:g} rad" for tolerance in TOLERANCES_RAD),
    f"<= {HEADLINE_TOLERANCE_RAD:g} up to symmetry",
    "median error [rad]",
    "stopped",
    "time to stop [s]",
    "fell",
)


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
        return "–"  # noqa: RUF001
    return f"{interval.value:.2f} ({interval.low:.2f} to {interval.high:.2f})"


def labels(names: tuple[str, ...]) -> dict[str, str]:
    """Short names of policies for legends: the ends of their paths that tell them apart."""

    def telling(name: str) -> tuple[str, ...]:
        parts = Path(name).parts
        return parts[:-1] if len(parts) > 1 and parts[-1] in _RUN_FILES else parts

    short = {}
    for name in names:
        parts = telling(name)
        others = [telling(other) for other in names if other != name]
        length = next(
            (n for n in range(1, len(parts)) if all(parts[-n:] != other[-n:] for other in others)), len(parts)
        )
        short[name] = "/".join(parts[-length:])
    return short


def write_comparison(comparison: Comparison, path: Path, *, pictures: bytes | None = None) -> None:
    """Write the page.

    Args:
        comparison: What was found.
        path: Of the page.
        pictures: PNG with the objects.
    """
    short = labels(comparison.policies)
    rows = in_order(comparison.rows)
    write_html(
        path,
        "comparison.html",
        title=_title(comparison),
        lead=_lead(comparison),
        success_header=_HEADER,
        success=[_cells(row, short) for row in rows],
        hold_s=f"{HOLD_S:g}",
        rest_header=_REST_HEADER,
        rest=[_rest_cells(row, short) for row in rows],
        outcomes=outcome_figure(comparison),
        pictures=pictures,
        ecdf=ecdf_figure(comparison),
        scatter=scatter_figure(comparison) if comparison.predictions else None,
        bound_header=_BOUND_HEADER,
        bounds=_bound_cells(comparison, short),
        warnings=comparison.warnings,
        violins=[
            (violin_figure(row.result), _heading(row, short), drawn_note(row.result))
            for row in _headlines(comparison)
        ],
        objects=[(_heading(row, short), _object_cells(row)) for row in rows],
        object_header=_OBJECT_HEADER,
        protocol=_protocol(comparison),
        chance={f"{float(name):g}": 100.0 * share for name, share in rows[0].result.overall.chance.items()},
        chance_mean=f"{CHANCE_MEAN_RAD:.2f}",
        units={row.result.overall.unit for row in rows},
    )


def _headlines(comparison: Comparison) -> list[Row]:
    """The first row of each policy on each group."""
    return list({(row.policy, row.group): row for row in reversed(comparison.rows)}.values())[::-1]


def _heading(row: Row, short: dict[str, str]) -> str:
    return f"{short[row.policy]}, {row.group}, stopped by {_stopped_by(row)}"


def _object_cells(row: Row) -> list[tuple[str, ...]]:
    return [
        (
            summary.name,
            str(summary.episodes),
            *(percent(rate) for rate in summary.success.values()),
            percent(summary.symmetric[str(HEADLINE_TOLERANCE_RAD)]),
            number(summary.median_error_rad),
            percent(summary.stop_rate),
            number(summary.time_to_success_s),
            percent(summary.drop_rate),
        )
        for summary in (row.result.overall, *row.result.per_object)
    ]


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


def terminal_text(comparison: Comparison) -> str:
    """Tables, those by object too if there is one policy, warnings and what was asked, for a terminal."""
    short = labels(comparison.policies)
    parts = [terminal_table(comparison)]
    if len(comparison.policies) == 1:
        parts += [
            f"{_heading(row, short)}\n{aligned([_OBJECT_HEADER, *_object_cells(row)], words=1)}"
            for row in _headlines(comparison)
        ]
    parts += [f"warning {name}: {words}" for name, words in comparison.warnings.items()]
    return "\n\n".join([*parts, _lead(comparison)])


def terminal_table(comparison: Comparison) -> str:
    """The tables of the headline and of the other episodes as one, for a terminal."""
    short = labels(comparison.policies)
    rows: list[Sequence[str]] = [(*_HEADER, *_REST_HEADER[3:])]
    for row in in_order(comparison.rows):
        cells = (*_cells(row, short), *_rest_cells(row, short)[3:])
        # Of the shares only the first has its interval here: a line has to fit.
        rows.append(tuple(c if i <= 3 else c.split(" (")[0] for i, c in enumerate(cells)))
    return aligned(rows, words=3)


def in_order(rows: Sequence[Row]) -> list[Row]:
    """Rows under the paper's conditions, then those with what is ours."""
    return sorted(rows, key=lambda row: bool(ours(row)))


def ours(row: Row) -> str:
    """What of a row's conditions is ours, not the paper's; empty: nothing."""
    return ", ".join(text for text in (row.ours, _marks(row.result.protocol)) if text)


def _marks(protocol: Protocol) -> str:
    return "symmetry-view selection" if protocol.second_view else ""


def ecdf_figure(comparison: Comparison) -> Figure:
    """Error distributions of all policies, a panel for each group."""
    figure, panels = _panels(len(comparison.groups), PANEL_HEIGHT)
    short, angle = labels(comparison.policies), np.linspace(0.0, np.pi, 200)
    colour = dict(zip(comparison.policies, COLOURS * len(comparison.policies), strict=False))
    for axes, group in zip(panels, comparison.groups, strict=True):
        rows = [row for row in comparison.rows if row.group == group]
        own = {row.policy: row for row in reversed(rows)}
        for row in (row for row in rows if not row.ours):
            other = row is not own[row.policy]
            style = {"linestyle": "--", "linewidth": 1.2} if other else {"linewidth": 2.0}
            label = None if other else _named(row, short)
            ecdf(axes, row.result.errors().ravel(), color=colour[row.policy], label=label, **style)
        starts = rows[0].result.start_errors().ravel()
        ecdf(axes, starts, color=GREY, linewidth=1.0, linestyle="-.", label="object left at its start")
        axes.plot(angle, chance_cdf(angle), color=GREY, linestyle=":", label="uniform, no symmetry")
        axes.axvline(rows[0].result.protocol.stop_tolerance_rad, color=GREY, linewidth=0.6)
        axes.set(xlim=(0.0, np.pi), ylim=(0.0, 1.0), xlabel="error at the stop or end [rad]")
        count = len(rows[0].result.object_names)
        axes.set_title(f"{group} ({count} object{'s' if count > 1 else ''})", fontsize=10)
        axes.legend(frameon=False, loc="lower right", fontsize=7)
    panels[0].set_ylabel("share of episodes")
    return figure


def outcome_figure(comparison: Comparison) -> Figure:
    """Shares of the outcome classes as stacked bars."""
    short, rows = labels(comparison.policies), in_order(comparison.rows)
    figure = Figure(figsize=(9.0, 1.2 + 0.34 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    places = np.arange(len(rows))[::-1]
    left = np.zeros(len(rows))
    for name in OUTCOMES:
        shares = np.array([row.outcomes[name].value for row in rows])
        axes.barh(places, shares, left=left, color=OUTCOME_COLOURS[name], label=name, height=0.7)
        left += shares
    names = [f"{short[row.policy]}, {row.group}, by {_stopped_by(row)}" for row in rows]
    axes.set_yticks(places, names, fontsize=8)
    axes.set(xlim=(0.0, 1.0), xlabel="share of episodes")
    axes.legend(frameon=False, fontsize=8, ncols=len(OUTCOMES), loc="lower center", bbox_to_anchor=(0.4, 1.0))
    return figure


def scatter_figure(comparison: Comparison) -> Figure:
    """Predicted beside true distances, two panels for each student: all, and the near ones."""
    short = labels(comparison.policies)
    students = tuple(dict.fromkeys(entry.policy for entry in comparison.predictions))
    figure = Figure(figsize=(2 * PANEL_WIDTH, PANEL_HEIGHT * len(students)), layout="constrained")
    for line, policy in enumerate(students):
        for column, limit in enumerate((np.pi, NEAR_RAD)):
            axes = figure.add_subplot(len(students), 2, 2 * line + column + 1)
            axes.spines[["top", "right"]].set_visible(False)
            for index, entry in enumerate(e for e in comparison.predictions if e.policy == policy):
                axes.plot(
                    entry.true_rad,
                    entry.predicted_rad,
                    ".",
                    markersize=2.0 if column == 0 else 4.0,
                    alpha=0.35,
                    color=COLOURS[index % len(COLOURS)],
                    label=entry.group,
                )
            for offset in (-0.1, 0.1):
                axes.plot([0.0, limit], [offset, limit + offset], color=GREY, linewidth=0.8)
            axes.set(xlim=(0.0, limit), ylim=(0.0, limit), aspect="equal")
            axes.set_xlabel("true distance [rad]")
            axes.set_ylabel("predicted [rad]")
            axes.set_title(short[policy], fontsize=9)
            if column == 0:
                axes.legend(frameon=False, fontsize=7, markerscale=4)
    return figure


def _panels(count: int, height: float) -> tuple[Figure, list]:
    figure = Figure(figsize=(max(PANEL_WIDTH * count, 6.0), height), layout="constrained")
    panels = [figure.add_subplot(1, count, index + 1) for index in range(count)]
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _named(row: Row, short: dict[str, str]) -> str:
    """A policy with its kind; zero and random are their own."""
    return row.kind if row.kind == row.policy else f"{short[row.policy]} ({row.kind})"


def _stopped_by(row: Row) -> str:
    """What stops a row's episodes, marked where its conditions are ours."""
    return f"{row.stopped_by}; ours: {ours(row)}" if ours(row) else row.stopped_by


def _cells(row: Row, short: dict[str, str]) -> tuple[str, ...]:
    return (
        _named(row, short),
        row.group,
        _stopped_by(row),
        percent(row.outcomes[OUTCOMES[0]]),
        "not tried" if row.held is None else percent(row.held),
        percent(row.symmetric),
        number(row.result.overall.median_error_rad),
    )


def _rest_cells(row: Row, short: dict[str, str]) -> tuple[str, ...]:
    shares = (percent(row.outcomes[name]) for name in OUTCOMES[1:])
    overall = row.result.overall
    return (
        _named(row, short),
        row.group,
        _stopped_by(row),
        *shares,
        number(overall.time_to_success_s),
    )


def _bound_cells(comparison: Comparison, short: dict[str, str]) -> list[tuple[str, ...]]:
    def share(value: float | None) -> str:
        return "none" if value is None else f"{100 * value:.1f} %"

    rows = {(row.policy, row.group, row.stopped_by): row for row in comparison.rows if not row.ours}
    return [
        (
            short[entry.policy],
            entry.group,
            f"{bound.bound_rad:g}",
            share(bound.seen),
            share(bound.right),
            percent(rows[entry.policy, entry.group, "prediction"].stops_within[str(bound.bound_rad)]),
            percent(rows[entry.policy, entry.group, "true distance"].stops_within[str(bound.bound_rad)]),
            f"{entry.mean_error_rad:.2f}",
        )
        for entry in comparison.predictions
        for bound in entry.bounds
    ]


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


def _lead(comparison: Comparison) -> str:
    """What was asked: place, episodes, starts, goals, stop and randomisation."""
    protocol = comparison.rows[0].result.protocol
    asked = [
        f"{shown_name(protocol.hand_name)} {'in the air' if protocol.in_air else 'on the table'}",
        f"{protocol.episodes} episodes of each object",
        f"starts {starts_text(protocol)}",
        f"goals {goals_text(protocol)}",
        f"stop within {protocol.stop_tolerance_rad:g} rad",
        f"randomisation {protocol.randomisation_text}",
    ]
    return "; ".join(asked + ([f"ours: {marks}"] if (marks := _marks(protocol)) else []))


def _title(comparison: Comparison) -> str:
    if len(comparison.policies) > 1:
        return f"Comparison of {len(comparison.policies)} policies"
    return f"Evaluation of {shown_name(comparison.policies[0])}"


def _protocol(comparison: Comparison) -> list[tuple[str, str]]:
    protocol = comparison.rows[0].result.protocol
    hands = dict.fromkeys(shown_name(row.result.protocol.hand_name) for row in comparison.rows)
    rows = [
        ("hand", ", ".join(hands)),
        ("starts and goals", f"{protocol.episodes} each for every object, seed {protocol.seed}"),
        ("starts", starts_text(protocol)),
        ("goals", goals_text(protocol)),
        ("time limit", f"{protocol.episode_s:g} s at {protocol.control_hz:g} Hz"),
        ("table", f"taken away after {PAPER.scene.air_table_s:g} s" if protocol.in_air else "there"),
        ("randomisation, noise, disturbances", protocol.randomisation_text),
    ]
    if protocol.table_friction is not None:
        rows.append(("friction of the table", f"{protocol.table_friction:g}"))
    known = {"mesh": "the exact mesh", "points": "500 exact points", "scan": "500 points of a scan"}
    if comparison.predictions:
        rows.append(("camera policies know shapes and goals by", known[protocol.goals]))
    norm = f"{PAPER.success.action_norm:g}, as in the released code"
    rows.append(("stops", f"bound of the action's norm {norm}"))
    by_group = {row.group: row.result.protocol.objects for row in comparison.rows}
    rows += [(f"objects: {name}", shown_name(sets)) for name, sets in by_group.items()]
    short = labels(comparison.policies)
    if any(row.stopped_by == SUCCESS for row in comparison.rows):
        rows.append((SUCCESS, f"error at most {protocol.stop_tolerance_rad:g} rad, fingers and object still"))
    for row in in_order(comparison.rows):
        if row.stopped_by == "prediction" or (row.kind == "teacher" and row.stopped_by != SUCCESS):
            rule = f"distance {row.rule.distance_rad:.3g} rad, action norm {row.rule.action_norm:.3g}"
            errs = ", which err as a real camera does" if row.result.protocol.sensor_errors else ""
            mark = f"; ours: {ours(row)}" if ours(row) else ""
            told = f"sees {row.sees}{errs}, stops below {rule}{mark}"
            rows.append((f"{short[row.policy]}, {row.group}", told))
    return rows + list(comparison.software.items())
