"""A scored run as one HTML page: the errors at the stops, and the run over time."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vd.deploy.loop.score import Score, step_errors
from vd.evaluate.plots import BLUE, GREEN, GREY, ORANGE, ecdf
from vd.evaluate.statistics import chance_cdf
from vd.page import write_html


def write_page(path: Path, result: Score, symmetry: np.ndarray) -> None:
    """Write the page of a scored run.

    Args:
        path: File to write.
        result: The run.
        symmetry: Rotations of the object onto itself, xyzw [S, 4].
    """
    write_html(
        path,
        "score.html",
        run=result.log.run,
        headline=_headline(result),
        errors=_errors(result, symmetry) if len(result.errors) else None,
        over_time=_over_time(result, symmetry),
        rows=[
            (
                str(trial.goal + 1),
                f"{trial.time_s:.1f}",
                trial.outcome + (", discarded" if trial.discarded else ""),
                "" if trial.error_rad is None else f"{trial.error_rad:.3f}",
                "" if trial.predicted_rad is None else f"{trial.predicted_rad:.3f}",
            )
            for trial in result.trials
        ],
        offset_s=f"{result.offset_s:.3f}",
    )


def _headline(result: Score) -> list[tuple[str, str, str]]:
    tiles = []
    if result.median is not None:
        m = result.median
        interval = f"95 %: {np.degrees(m.low):.0f} to {np.degrees(m.high):.0f} degrees"
        tiles.append((f"{np.degrees(m.value):.0f}°", f"median error at {len(result.errors)} stops", interval))
    tiles += [
        (
            f"{100 * share.value:.0f} %",
            f"stopped within {tolerance:.1f} rad",
            f"95 %: {100 * share.low:.0f} to {100 * share.high:.0f} %",
        )
        for tolerance, share in result.within
    ]
    discarded = len(result.trials) - result.scored
    return [*tiles, (f"{discarded}", "trials discarded", "markers lost at the stop")]


def _errors(result: Score, symmetry: np.ndarray) -> Figure:
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.subplots()
    ecdf(axes, result.errors, color=BLUE, label="stops")
    angle = np.linspace(0.0, np.pi, 200)
    axes.plot(angle, chance_cdf(angle, symmetry), color=GREY, linestyle=":", label="at random")
    axes.set(xlim=(0.0, np.pi), ylim=(0.0, 1.0), xlabel="error at the stop [rad]", ylabel="share of stops")
    axes.legend(frameon=False, loc="lower right")
    return figure


def _over_time(result: Score, symmetry: np.ndarray) -> Figure:
    log = result.log
    t = log.columns["t"]
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(t, step_errors(log, result.mocap, t, symmetry), color=BLUE, label="measured")
    axes.plot(t, log.columns["distance"], color=ORANGE, linewidth=0.9, label="predicted")
    for trial in result.trials:
        good = trial.outcome == "stopped" and not trial.discarded
        axes.axvline(trial.time_s, color=GREEN if good else GREY, linestyle="-" if good else ":", linewidth=1)
    axes.set(xlabel="time [s]", ylabel="angle to the goal [rad]", xlim=(0.0, t[-1]), ylim=(0.0, np.pi))
    axes.legend(frameon=False, loc="upper right")
    return figure
