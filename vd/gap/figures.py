"""Figures of a gap report: curves before and after, what remains, gaps by joint, the candidates.

Angles are shown in mrad where they are errors and in rad where they are positions.
"""

import math
import textwrap

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vd.gap.result import Candidate, Predictions, Report
from vd.gap.words import MILLI, listing, plain

# Colours of Okabe and Ito, which colour-blind readers can tell apart.
INK, BLUE, ORANGE, GREEN, GREY = "#1c2330", "#0072B2", "#D55E00", "#009E73", "#8a8f98"
WIDTH = 9.0
OVERLAYS = 3
"""Joint and trajectory pairs that are drawn in full."""
WINDOW_S = 8.0
"""Longest piece of a trajectory that an overlay shows; the eye cannot follow more at page width."""
ZOOM_S = 1.2
"""Length of the detail beside it."""
MAX_POINTS = 4000
"""Samples drawn of one curve."""
MAX_BARS = 16
"""Candidates drawn of one round."""
BAR = 0.36
PANELS = 2
"""Rounds of the search beside each other: their labels leave no room for a third."""
BAR_IN, TITLE_IN, TITLE_LETTERS = 0.24, 0.65, 44
"""Height of a candidate's row and of a round's title with its axis [in]; letters of a line of the title."""
FAR_WORSE = 1000.0
"""Loss [%] beyond which its size says nothing more."""
DECISIONS = {"named": GREEN, "tied": BLUE, "rejected": GREY}


def overlay_figure(report: Report, curves: Predictions, joint: str, index: int) -> Figure:
    """Command, measurement, baseline and identified model in one trajectory, with a detail and the errors.

    Args:
        report: The report.
        curves: Its curves.
        joint: Joint to draw.
        index: Index of the trajectory.
    """
    column = curves.joints.index(joint)
    rows = np.flatnonzero(curves.trajectory == index)
    time = curves.time[rows]
    measured = curves.measured[rows, column]
    before, after = curves.baseline[rows, column], curves.identified[rows, column]
    changed = _changed(before, after)
    wide = _worst_window(time, before - measured, WINDOW_S)
    zoom = _worst_window(time, before - measured, ZOOM_S, within=wide)
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.1, 1.0), height_ratios=(1.7, 1.0))
    for place, (start, end) in enumerate((wide, zoom)):
        axes = _clean(figure.add_subplot(grid[0, place]))
        shown = _thin(np.flatnonzero((time >= start) & (time <= end)))
        t = time[shown]
        axes.step(
            t,
            curves.command[rows, column][shown],
            where="post",
            color=GREY,
            linewidth=1.0,
            label="command",
        )
        axes.plot(t, measured[shown], color=INK, linewidth=3.2, alpha=0.85, label="measured")
        axes.plot(t, before[shown], color=ORANGE, linewidth=1.4, linestyle="--", label="simulation before")
        if changed:
            axes.plot(t, after[shown], color=GREEN, linewidth=1.4, label="simulation after")
        axes.set_xlim(start, end)
        axes.set_title("where it differs most" if place else f"{joint}, {curves.files[index]}", fontsize=9)
        below = _clean(figure.add_subplot(grid[1, place], sharex=axes))
        _floor(below, report.noise_floor_rad)
        below.plot(t, MILLI * (before - measured)[shown], color=ORANGE, linewidth=1.1, label="before")
        if changed:
            below.plot(t, MILLI * (after - measured)[shown], color=GREEN, linewidth=1.1, label="after")
        below.set_xlabel("time [s]", fontsize=9)
        if place == 0:
            axes.set_ylabel("position [rad]", fontsize=9)
            below.set_ylabel("simulation - measured\n[mrad]", fontsize=9)
            figure.legend(
                *axes.get_legend_handles_labels(),
                loc="outside upper center",
                ncols=4,
                frameon=False,
                fontsize=9,
            )
            axes.axvspan(*zoom, color=BLUE, alpha=0.08, linewidth=0)
            below.axvspan(*zoom, color=BLUE, alpha=0.08, linewidth=0)
        axes.tick_params(labelbottom=False, labelsize=8)
        below.tick_params(labelsize=8)
    return figure


def residual_figure(report: Report, curves: Predictions, joint: str) -> Figure:
    """Error of one joint over all its trajectories, against time, speed and distance still to go.

    A cause leaves its mark here: a delay grows with speed, friction changes sign with it, a dead zone shows
    at rest, warming grows with time.
    """
    column = curves.joints.index(joint)
    seen = np.isfinite(curves.baseline[:, column]) & np.isfinite(curves.measured[:, column])
    measured, command = curves.measured[:, column], curves.command[:, column]
    speed = np.zeros_like(measured)
    for index in range(len(curves.files)):
        rows = np.flatnonzero(curves.trajectory == index)
        if len(rows) > 2:
            speed[rows] = np.gradient(measured[rows], curves.time[rows])
    quantities = (
        ("time in the trajectory [s]", curves.time),
        ("measured speed [rad/s]", speed),
        ("command - measured [rad]", command - measured),
    )
    changed = _changed(curves.baseline[seen, column], curves.identified[seen, column])
    figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    rows = _thin(np.flatnonzero(seen))
    errors = MILLI * (curves.baseline[:, column] - measured)
    limit = 1.15 * np.nanquantile(np.abs(errors[seen]), 0.995) if seen.any() else 1.0
    for axes, (label, quantity) in zip(panels, quantities, strict=True):
        _clean(axes)
        _floor(axes, report.noise_floor_rad)
        axes.plot(
            quantity[rows],
            errors[rows],
            ".",
            color=ORANGE,
            markersize=1.5,
            alpha=0.5,
            label="before",
            zorder=1,
        )
        if changed:
            axes.plot(
                quantity[rows],
                MILLI * (curves.identified[rows, column] - measured[rows]),
                ".",
                color=GREEN,
                markersize=1.5,
                alpha=0.5,
                label="after",
                zorder=2,
            )
        axes.set_xlabel(label, fontsize=9)
        axes.set_xlim(*np.quantile(quantity[seen], [0.001, 0.999]) if seen.any() else (0.0, 1.0))
        axes.set_ylim(-limit, limit)
        axes.tick_params(labelsize=8)
    panels[0].set_ylabel(f"{joint}: simulation\n- measured [mrad]", fontsize=9)
    panels[-1].legend(frameon=False, fontsize=8, markerscale=6, loc="upper right")
    return figure


def gap_figure(report: Report) -> Figure:
    """Held-out gap of every joint before and after, with intervals, and the noise floor."""
    joints = report.joints
    figure = Figure(figsize=(WIDTH, 1.2 + 0.5 * max(len(joints), 2)), layout="constrained")
    axes = _clean(figure.add_subplot())
    places = np.arange(len(joints))[::-1]
    for place, one in zip(places, joints, strict=True):
        before = (ORANGE, "before: the plain servo model", one.baseline_rmse_rad, one.baseline_ci95)
        after = (GREEN, "after: the identified model", one.identified_rmse_rad, one.identified_ci95)
        for side, (color, label, value, interval) in ((0.5, before), (-0.5, after)):
            height = place + side * BAR
            first = label if place == places[0] else None
            axes.barh(height, MILLI * value, BAR, color=color, alpha=0.75, label=first)
            axes.plot([MILLI * x for x in interval], [height, height], color=INK, linewidth=1.4)
            largest = np.nanmax([value, interval[1]])
            axes.text(MILLI * largest, height, f"  {MILLI * value:.3g}", va="center", fontsize=8, color=INK)
        first = "noise floor" if place == places[0] else None
        floor = MILLI * one.noise_floor_rad
        axes.plot(
            [floor, floor], [place - 1.1 * BAR, place + 1.1 * BAR], color=BLUE, linewidth=2.0, label=first
        )
    axes.set_yticks(places, [one.joint for one in joints], fontsize=9)
    axes.set_xlim(left=0.0)
    axes.margins(x=0.08)
    axes.set_xlabel("root-mean-square error on held-out motions [mrad], with 95 % intervals", fontsize=9)
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure


def evidence_figure(report: Report, joints: tuple[str, ...]) -> Figure:
    """Gain of every candidate on some joints, round by round, with intervals."""
    rows = [row for row in report.evidence if row.joints == joints]
    rounds = sorted({row.round for row in rows})
    shown = [_best([row for row in rows if row.round == number]) for number in rounds]
    pairs = [shown[i : i + PANELS] for i in range(0, len(shown), PANELS)]
    heights = [BAR_IN * max(map(len, pair)) + TITLE_IN for pair in pairs]
    figure = Figure(figsize=(WIDTH, 0.8 + sum(heights)), layout="constrained")
    grid = figure.add_gridspec(len(pairs), len(pairs[0]), height_ratios=heights)
    for line, pair in enumerate(pairs):
        for place, group in enumerate(pair):
            _gains(_clean(figure.add_subplot(grid[line, place])), group)
    figure.supxlabel(
        "share of the error on held-out motions that it removes, given the effects before [%]", fontsize=9
    )
    marks = [Line2D([], [], marker="o", linestyle="", color=color) for color in DECISIONS.values()]
    labels = ["accepted", "cannot be told apart", "rejected"]
    figure.legend(marks, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure


def _gains(axes, group: list[Candidate]) -> None:
    """One round: a row for each candidate, with an arrow at the edge for one that is beyond it."""
    left = _lower_limit(group)
    for place, row in enumerate(reversed(group)):
        color, gain = DECISIONS[row.decision], 100.0 * row.gain
        if gain >= left:
            axes.plot(
                [100.0 * x for x in row.gain_ci95], [place, place], color=color, linewidth=2.0, alpha=0.6
            )
            axes.plot([gain], [place], "x" if row.placebo else "o", color=color, markersize=5)
        elif math.isfinite(gain):
            axes.plot([left], [place], "<", color=color, markersize=5)
            note = f"{-gain:.0f} % worse" if gain > -FAR_WORSE else "far worse"
            axes.text(left, place, f"   {note}", color=color, fontsize=7, va="center")
        else:
            axes.text(left, place, "  not fitted", color=color, fontsize=7, va="center")
    given = _given(group)
    names = []
    for row in reversed(group):
        along = [plain(name) for name in row.given if name not in given]
        note = " (placebo)" if row.placebo else f"\nwith {listing(along)}" if along else ""
        names.append(plain(row.name) + note)
    axes.set_yticks(range(len(group)), names, fontsize=8)
    axes.axvline(0.0, color=INK, linewidth=0.8)
    axes.set_xlim(left=left, right=104.0)
    axes.set_ylim(-0.6, len(group) - 0.4)
    axes.set_title(_round_title(group), fontsize=9)
    axes.tick_params(axis="x", labelsize=8)


def _given(group: list[Candidate]) -> tuple[str, ...]:
    """What was in the model before a round; two that were taken together are given each other besides."""
    return min((row.given for row in group), key=len)


def _round_title(group: list[Candidate]) -> str:
    """Which round it is, and what was in the model before it."""
    given = [plain(name) for name in _given(group)]
    beside = f"added to {listing(given)}" if given else "each alone"
    return textwrap.fill(f"round {group[0].round}: {beside}", TITLE_LETTERS)


def chosen_overlays(report: Report, curves: Predictions) -> list[tuple[str, int]]:
    """Joint and trajectory index of the overlays, worst first, held-out motions before others.

    Joints with a gap get one each; what is left goes to further kinds of motion of the same joints. Where
    there is no gap, the joint with the largest error stands for all.
    """
    indices = {name: index for index, name in enumerate(curves.files)}
    rows = [
        row
        for row in report.trajectories
        if row.file in indices and row.joint in curves.joints and math.isfinite(row.baseline_rmse_rad)
    ]
    rows.sort(key=lambda row: (not row.held_out, -row.baseline_rmse_rad))
    named = {joint for effect in report.effects for joint in effect.joints}
    open_joints = {one.joint for one in report.joints if one.verdict != "no_gap"} | named
    candidates = [row for row in rows if row.joint in open_joints] or rows[:1]
    candidates.sort(key=lambda row: row.joint not in named)  # stable: the order above within each
    first = list({row.joint: row for row in reversed(candidates)}.values())[::-1]
    kinds = {(row.joint, row.excitation) for row in first}
    more = [row for row in candidates if (row.joint, row.excitation) not in kinds]
    more = list({(row.joint, row.excitation): row for row in reversed(more)}.values())[::-1]
    return [(row.joint, indices[row.file]) for row in [*first, *more][:OVERLAYS]]


def _best(rows: list[Candidate]) -> list[Candidate]:
    fitted = [row for row in rows if math.isfinite(row.gain)] or rows
    return sorted(fitted, key=lambda row: -row.gain if math.isfinite(row.gain) else math.inf)[:MAX_BARS]


def _lower_limit(group: list[Candidate]) -> float:
    """Left end of the axis: far losses are cut off, since only their sign matters."""
    lows = [100.0 * row.gain_ci95[0] for row in group if math.isfinite(row.gain_ci95[0])]
    return max(min([*lows, -5.0]) - 3.0, -60.0)


def _changed(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether there is an identified model to draw besides the baseline."""
    return bool(np.isfinite(after).any()) and not np.allclose(before, after, equal_nan=True)


def _worst_window(
    time: np.ndarray, error: np.ndarray, length: float, within: tuple[float, float] | None = None
) -> tuple[float, float]:
    """The window of this length with the largest squared error."""
    start, end = within or (float(time[0]), float(time[-1]))
    if end - start <= length:
        return start, end
    square = np.nan_to_num(error) ** 2
    steps = np.diff(time, prepend=time[0])
    total = np.concatenate([[0.0], np.cumsum(square * steps)])
    starts = time[(time >= start) & (time <= end - length)]
    first = np.searchsorted(time, starts)
    last = np.searchsorted(time, starts + length)
    worst = float(starts[np.argmax(total[last] - total[first])]) if len(starts) else start
    return worst, worst + length


def _thin(rows: np.ndarray) -> np.ndarray:
    return rows[:: max(1, math.ceil(len(rows) / MAX_POINTS))]


def _floor(axes, noise_floor_rad: float) -> None:
    axes.axhspan(-MILLI * noise_floor_rad, MILLI * noise_floor_rad, color=BLUE, alpha=0.15, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.6)


def _clean(axes):
    axes.spines[["top", "right"]].set_visible(False)
    return axes
