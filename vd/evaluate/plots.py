"""Figures of an evaluation: error distributions, together and by object."""

import numpy as np
from matplotlib.figure import Figure

from vd.evaluate.result import EvalResult

# Violins and bars get unreadable beyond this many objects; the worst and best halves are drawn then.
MAX_OBJECTS_DRAWN = 30
# Orders of the colours of Okabe and Ito, which colour-blind readers can tell apart.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8a8f98"
# A violin of fewer points than this shows the kernel, not the data.
MIN_VIOLIN_POINTS = 8
HEADLINE_TOLERANCE_RAD = 0.4


def violin_figure(result: EvalResult) -> Figure:
    """Distribution of the final error of each object, sorted by its median; dropped episodes are counted."""
    errors = result.errors()
    chosen = _chosen(np.median(errors, axis=1))
    figure, axes = _axes(8.0, 1.1 + 0.3 * len(chosen))
    positions = np.arange(len(chosen))[::-1]
    for position, index in zip(positions, chosen, strict=True):
        kept = errors[index][errors[index] < np.pi]
        if len(kept) >= MIN_VIOLIN_POINTS and np.ptp(kept) > 0.0:
            parts = axes.violinplot(
                kept, [position], orientation="horizontal", widths=0.85, showextrema=False, points=200
            )
            for body in parts["bodies"]:
                body.set(facecolor=BLUE, alpha=0.3, edgecolor="none")
        jitter = 0.16 * np.sin(np.arange(len(kept)) * 2.4)  # spread, and the same in every run
        axes.plot(kept, position + jitter, ".", color=BLUE, markersize=2.5, alpha=0.5)
        axes.plot(
            [np.median(errors[index])], [position], "|", color=ORANGE, markersize=13, markeredgewidth=2.2
        )
        dropped = len(errors[index]) - len(kept)
        if dropped:
            axes.text(np.pi * 1.02, position, f"{dropped} dropped", fontsize=7, va="center", color=GREY)
    axes.axvline(HEADLINE_TOLERANCE_RAD, color=GREY, linewidth=0.8)
    axes.set_yticks(positions, [result.object_names[index] for index in chosen], fontsize=8)
    axes.set(xlim=(0.0, np.pi), ylim=(-0.7, len(chosen) - 0.3))
    axes.set_xlabel("orientation error at the end or stop [rad]; the mark is the median, drops as pi")
    return figure


def drawn_note(result: EvalResult) -> str:
    """What the figures by object leave out, or an empty string."""
    count = len(result.object_names)
    if count <= MAX_OBJECTS_DRAWN:
        return ""
    return (
        f" The {MAX_OBJECTS_DRAWN // 2} best and {MAX_OBJECTS_DRAWN // 2} worst of {count} objects are drawn."
    )


def _chosen(score: np.ndarray) -> np.ndarray:
    """Indices from the lowest score to the highest, without the middle where there are too many."""
    order = np.argsort(score, kind="stable")
    if len(order) <= MAX_OBJECTS_DRAWN:
        return order
    half = MAX_OBJECTS_DRAWN // 2
    return np.concatenate([order[:half], order[-half:]])


def _axes(width: float, height: float) -> tuple:
    figure = Figure(figsize=(width, height), layout="constrained")  # no pyplot: no display, no global state
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def ecdf(axes, values: np.ndarray, **style) -> None:
    """Draw the empirical distribution of errors [rad], pi for lost objects."""
    # Errors of pi are drops: the curve must not rise at the right edge as if it had reached them.
    ordered = np.sort(values)
    height = np.arange(1, len(ordered) + 1) / len(ordered)
    shown = ordered < np.pi
    x = np.concatenate([[0.0], ordered[shown], [np.pi]])
    y = np.concatenate([[0.0], height[shown], [height[shown][-1] if shown.any() else 0.0]])
    axes.step(x, y, where="post", **style)
