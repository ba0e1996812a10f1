"""The figure of an evaluation: distributions of errors."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from vd.evaluate.statistics import chance_cdf

if TYPE_CHECKING:
    from vd.evaluate.result import Result

# Orders of the colours of Okabe and Ito, which colour-blind readers can tell apart.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8a8f98"
COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of policies, in their order."""
COLUMNS, PANEL_INCH = 3, (4.2, 3.6)
"""Panels side by side, and the size of one."""


def ecdf_figure(result: "Result", labels: dict[str, str]) -> Figure:
    """Distributions of the errors at the stop or end, by each policy's own rule.

    A panel for each condition and group.

    Args:
        result: What was found.
        labels: Short names of the policies.
    """
    headlines = result.headlines()
    columns = min(COLUMNS, len(headlines))
    rows = -(-len(headlines) // columns)
    figure = Figure(figsize=(columns * PANEL_INCH[0], rows * PANEL_INCH[1]), layout="constrained")
    angle = np.linspace(0.0, np.pi, 200)
    colour = dict(zip(result.policies, COLOURS * len(result.policies), strict=False))
    for number, ((condition, group), found) in enumerate(headlines.items()):
        axes = figure.add_subplot(rows, columns, number + 1)
        axes.spines[["top", "right"]].set_visible(False)
        for policy, row in found.items():
            errors = np.array([np.pi if e.fell else e.exact_error_rad for e in row.episodes])
            ecdf(axes, errors, color=colour[policy], label=labels[policy])
        axes.plot(angle, chance_cdf(angle), color=GREY, linestyle=":", label="at random")
        axes.axvline(row.protocol.stop_tolerance_rad, color=GREY, linewidth=0.6)
        axes.set(xlim=(0.0, np.pi), ylim=(0.0, 1.0), title=condition or group)
        axes.set(xlabel="error at the stop or end [rad]", ylabel="share of episodes")
        axes.legend(frameon=False, loc="lower right", fontsize=7)
    return figure


def ecdf(axes: Any, values: np.ndarray, **style: Any) -> None:
    """Draw the empirical distribution of errors [rad], pi for lost objects."""
    # Errors of pi are drops: the curve must not rise at the right edge as if it had reached them.
    ordered = np.sort(values)
    height = np.arange(1, len(ordered) + 1) / len(ordered)
    shown = ordered < np.pi
    x = np.concatenate([[0.0], ordered[shown], [np.pi]])
    y = np.concatenate([[0.0], height[shown], [height[shown][-1] if shown.any() else 0.0]])
    axes.step(x, y, where="post", **style)
