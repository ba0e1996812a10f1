"""Figures of a gap report.

Curves before and after, and what remains of them.

Angles are shown in mrad where they are errors and in rad where they are positions.
"""

import numpy as np
from matplotlib.figure import Figure

from vd.gap.result import Predictions, Report
from vd.gap.words import LISTED

# Colours of Okabe and Ito, which colour-blind readers can tell apart.
INK = "#1c2330"
BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
GREY = "#8a8f98"
WINDOW_S = 6.0
"""Longest piece of a trajectory that is drawn: what the eye follows at a page's width. Not
tuned.
"""
STYLE = {"axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False}


def overlay_figure(report: Report, curves: Predictions, joint: str, index: int) -> Figure:
    """Command, measurement and both models where they differ most in a trajectory, and the errors below.

    Args:
        report: The report.
        curves: Its curves.
        joint: Joint to draw.
        index: Index of the trajectory.
    """
    column = curves.joints.index(joint)
    rows = curves.trajectory == index
    time = curves.time[rows]
    command = curves.command[rows, column]
    measured = curves.measured[rows, column]
    models = _models(curves, column, rows)
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1.0))
    above.step(time, command, where="post", color=GREY, linewidth=1.0, label="command")
    above.plot(time, measured, color=INK, linewidth=3.2, alpha=0.85, label="measured")
    start, end = _worst_window(time, models[0][2] - measured)
    shown = (time >= start) & (time <= end)
    for label, color, position in models:
        style = "--" if color == ORANGE else "-"
        above.plot(time, position, style, color=color, linewidth=1.4, label=f"simulation {label}")
        below.plot(time[shown], 1e3 * (position - measured)[shown], color=color, linewidth=1.1)
    _floor(below, report)
    above.set_xlim(start, end)
    above.set_ylabel("position [rad]")
    below.set(xlabel="time [s]", ylabel="simulation\n- measured [mrad]")
    figure.legend(loc="outside upper center", ncols=4)
    return figure


def residual_figure(report: Report, curves: Predictions, joint: str) -> Figure:
    """Error of one joint over all its trajectories, against time, speed and distance still to go.

    A cause leaves its mark here: a delay grows with speed, friction changes sign with it, a dead
    zone shows at rest, warming grows with time.
    """
    column = curves.joints.index(joint)
    measured = curves.measured[:, column]
    speed = np.empty(len(measured))
    for index in range(len(curves.files)):
        rows = curves.trajectory == index
        speed[rows] = np.gradient(measured[rows], curves.time[rows])
    quantities = {
        "time in the motion [s]": curves.time,
        "measured speed [rad/s]": speed,
        "command - measured [rad]": curves.command[:, column] - measured,
    }
    seen = np.flatnonzero(np.isfinite(curves.baseline[:, column]))
    seen = seen[:: len(seen) // 4000 + 1]
    figure = Figure(figsize=(9.0, 2.9), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for axes, (label, quantity) in zip(panels, quantities.items(), strict=True):
        _floor(axes, report)
        for name, color, position in _models(curves, column, seen):
            errors = 1e3 * (position - measured[seen])
            axes.plot(
                quantity[seen], errors, ".", color=color, markersize=1.5, alpha=0.5, label=name
            )
        axes.set_xlabel(label)
        axes.set_xlim(*np.quantile(quantity[seen], [0.001, 0.999]))
    errors = 1e3 * np.abs(curves.baseline[seen, column] - measured[seen])
    panels[0].set_ylim(np.array([-1.15, 1.15]) * np.quantile(errors, 0.995))
    panels[0].set_ylabel(f"{joint}: simulation\n- measured [mrad]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, markerscale=6, loc="outside upper center", ncols=2)
    return figure


def chosen_overlays(report: Report, curves: Predictions) -> list[tuple[str, int]]:
    """Joint and trajectory index of the overlays: each joint's worst, then other kinds of motion."""
    rows = sorted(report.trajectories, key=lambda row: -row.baseline_rmse_rad)
    worst: dict[str, tuple[str, int]] = {}
    kinds: dict[tuple[str, str], tuple[str, int]] = {}
    for row in rows:
        place = (row.joint, curves.files.index(row.file))
        worst.setdefault(row.joint, place)
        kinds.setdefault((row.joint, row.excitation), place)
    return list(dict.fromkeys([*worst.values(), *kinds.values()]))[:LISTED]


def _models(
    curves: Predictions, column: int, rows: np.ndarray
) -> list[tuple[str, str, np.ndarray]]:
    """Name, colour and positions of the baseline, and of the identified model where it is another."""
    before = curves.baseline[rows, column]
    after = curves.identified[rows, column]
    same = np.allclose(before, after, equal_nan=True)
    return [("before", ORANGE, before), *([] if same else [("after", GREEN, after)])]


def _worst_window(time: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """The window of ``WINDOW_S`` with the largest squared error."""
    total = np.concatenate([[0.0], np.cumsum(error**2 * np.gradient(time))])
    starts = np.flatnonzero(time <= max(time[-1] - WINDOW_S, time[0]))
    ends = np.searchsorted(time, time[starts] + WINDOW_S)
    start = time[starts[np.argmax(total[ends] - total[starts])]]
    return float(start), float(min(start + WINDOW_S, time[-1]))


def _floor(axes, report: Report) -> None:
    floor = 1e3 * report.noise_floor_rad
    axes.axhspan(-floor, floor, color=BLUE, alpha=0.15, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
