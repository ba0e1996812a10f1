"""Figures of the suite that a comparison has not: materials, outcomes by object, error by distance to go."""

from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from vd.evaluate.comparison import OUTCOMES, Row
from vd.evaluate.comparison_page import COLOURS, OUTCOME_COLOURS
from vd.evaluate.plots import BLUE, GREY, HEADLINE_TOLERANCE_RAD, MAX_OBJECTS_DRAWN, ORANGE
from vd.evaluate.statistics import Interval


def friction_figure(rates: dict[str, list[tuple[float, Interval]]]) -> Figure:
    """Success by the table's friction.

    Args:
        rates: For each policy, frictions with their success.
    """
    figure, axes = _axes(7.0, 3.6)
    for index, (name, points) in enumerate(rates.items()):
        points = sorted(points, key=lambda point: point[0])
        x = np.array([friction for friction, _ in points]) + 0.006 * (index - 0.5 * (len(rates) - 1))
        y = np.array([rate.value for _, rate in points])
        spread = [y - [rate.low for _, rate in points], [rate.high for _, rate in points] - y]
        colour = COLOURS[index % len(COLOURS)]
        axes.errorbar(x, y, yerr=np.maximum(spread, 0.0), color=colour, marker="o", capsize=3, label=name)
    axes.set(xlabel="friction coefficient of the table", ylim=(0.0, None))
    axes.set_ylabel(f"error at most {HEADLINE_TOLERANCE_RAD} rad")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def object_outcomes_figure(row: Row) -> Figure:
    """Outcome classes of each object as stacked bars, the most successful first."""
    episodes = row.result.episodes
    tolerance = row.result.protocol.stop_tolerance_rad
    counts = np.zeros((len(row.result.object_names), len(OUTCOMES)))
    for e in episodes:
        kind = (0 if e.error_rad <= tolerance else 1) if e.stopped else (3 if e.fell else 2)
        counts[e.object_index, kind] += 1
    shares = counts / counts.sum(axis=1, keepdims=True)
    order = np.argsort(-shares[:, 0], kind="stable")
    if len(order) > MAX_OBJECTS_DRAWN:
        order = np.concatenate([order[: MAX_OBJECTS_DRAWN // 2], order[-MAX_OBJECTS_DRAWN // 2 :]])
    figure, axes = _axes(8.0, 1.3 + 0.27 * len(order))
    places, left = np.arange(len(order))[::-1], np.zeros(len(order))
    for index, name in enumerate(OUTCOMES):
        width = shares[order, index]
        axes.barh(places, width, left=left, color=OUTCOME_COLOURS[name], label=name, height=0.75)
        left += width
    axes.set_yticks(places, [row.result.object_names[index] for index in order], fontsize=8)
    axes.set(xlim=(0.0, 1.0), xlabel="share of episodes")
    axes.legend(frameon=False, fontsize=8, ncols=len(OUTCOMES), loc="lower center", bbox_to_anchor=(0.4, 1.0))
    return figure


def distance_figure(row: Row) -> Figure:
    """Error at the stop or end beside the distance that was to go, without lost objects."""
    kept = [e for e in row.result.episodes if not e.fell]
    start, error = (np.array([getattr(e, name) for e in kept]) for name in ("start_error_rad", "error_rad"))
    figure, axes = _axes(6.0, 3.8)
    axes.plot(start, error, ".", color=BLUE, markersize=3, alpha=0.35)
    edges = np.linspace(0.0, np.pi, 9)
    centre, median = [], []
    for low, high in pairwise(edges):
        inside = (start >= low) & (start < high)
        if inside.any():
            centre.append(0.5 * (low + high))
            median.append(np.median(error[inside]))
    axes.plot(centre, median, "o-", color=ORANGE, label="median")
    axes.axhline(row.result.protocol.stop_tolerance_rad, color=GREY, linewidth=0.8)
    axes.set(xlim=(0.0, np.pi), ylim=(0.0, np.pi))
    axes.set(xlabel="distance to go at the start [rad]", ylabel="error at the stop or end [rad]")
    axes.legend(frameon=False, fontsize=8)
    return figure


def _axes(width: float, height: float) -> tuple:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes
