"""Curves of training runs from ``progress.jsonl``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vd.files import atomic_path
from vd.paper import PAPER
from vd.train.metrics import read_progress

CHANCE_ERROR_RAD = np.pi / 2.0 + 2.0 / np.pi
"""Mean angle between two uniformly random orientations (2.207 rad)."""
SMOOTHING = 1 / 40
"""Share of a run over which the smooth line averages; the raw values stay visible behind it."""


def plot_curves(progress: Path | Sequence[Path], output: Path) -> None:
    """Draw success, reward, terms, difficulty, error, std, falls and speed against control steps.

    Args:
        progress: One or several ``progress.jsonl`` files; with several, reward terms are the first's.
        output: PNG to write.

    Raises:
        FileNotFoundError: No such file.
        ValueError: A file has no iteration.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    files = [Path(progress)] if isinstance(progress, (str, Path)) else [Path(p) for p in progress]
    runs = read_runs(files)
    steps_max = max(rows[-1]["env_steps"] for rows in runs.values())
    scale, unit = (1e6, "million") if steps_max >= 1e6 else (1e3, "thousand")

    figure, axes = plt.subplots(2, 4, figsize=(19, 8), constrained_layout=True)
    panels: list[tuple[Any, str, str, float]] = [
        (axes[0, 0], "success_per_goal", "goals reached [%]", 100.0),
        (axes[0, 1], "mean_reward", "mean reward per control step", 1.0),
        (axes[1, 0], "task/rotation_error", "mean rotation error [rad]", 1.0),
        (axes[1, 1], "action_std", "mean std of the actions", 1.0),
        (axes[0, 3], "task/difficulty", "difficulty; dashed: tightness (1: as configured)", 1.0),
        (axes[1, 2], "drop_rate", "episodes that end in a fall [%]", 100.0),
        (axes[1, 3], "steps_per_s", "control steps per second, learning included", 1.0),
    ]
    for axis, key, title, factor in panels:
        for index, (name, rows) in enumerate(runs.items()):
            draw_line(axis, rows, key, scale, factor=factor, color=f"C{index}", label=name)
        axis.set_title(title)
    for index, rows in enumerate(runs.values()):
        if rows[0].get("task/tightness", 1.0) < 1.0:  # runs that tighten begin below
            draw_line(axes[0, 3], rows, "task/tightness", scale, color=f"C{index}", label=None, style="--")
    first = next(iter(runs.values()))
    terms = [key for key in first[-1] if key.startswith("reward/") and key != "reward/total"]
    for index, key in enumerate(terms):
        draw_line(axes[0, 2], first, key, scale, color=f"C{index}", label=key.removeprefix("reward/"))
    axes[0, 2].set_title("reward terms per control step, before scaling")
    # Terms span orders of magnitude around zero.
    axes[0, 2].set_yscale("symlog", linthresh=1e-2)
    axes[1, 0].axhline(CHANCE_ERROR_RAD, color="0.6", linestyle=":", label="two random orientations")
    axes[1, 0].axhline(PAPER.success.rotation_rad, color="0.6", linestyle="--", label="success tolerance")
    for axis in axes.flat:
        axis.set_xlabel(f"control steps [{unit}]")
        axis.grid(alpha=0.3)
        if len(axis.get_legend_handles_labels()[0]) > (0 if axis in (axes[0, 2], axes[1, 0]) else 1):
            axis.legend(fontsize="small", framealpha=0.5)
    for axis in (axes[0, 0], axes[0, 3], axes[1, 1], axes[1, 2], axes[1, 3]):
        axis.set_ylim(bottom=0.0)
    with atomic_path(Path(output)) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def read_runs(progress: Sequence[Path]) -> dict[str, list[dict[str, Any]]]:
    """Rows of runs by the name of their folder.

    Args:
        progress: ``progress.jsonl`` files.

    Raises:
        FileNotFoundError: No such file.
        ValueError: A file has no iteration.
    """
    runs = {}
    for path in progress:
        if not path.is_file():
            raise FileNotFoundError(f"no {path}; give the folder of a run of vd-train")
        rows = read_progress(path)
        if not rows:
            raise ValueError(f"{path} has no iteration yet; wait for the first one")
        runs[path.parent.name or path.stem] = rows
    return runs


def draw_line(
    axis: Any,
    rows: list[dict[str, Any]],
    key: str,
    scale: float,
    *,
    factor: float = 1.0,
    color: str,
    label: str | None,
    style: str = "-",
) -> None:
    """One quantity: raw values pale, a running mean on top. Iterations without a value leave a gap."""
    points = [(row["env_steps"] / scale, row[key] * factor) for row in rows if row.get(key) is not None]
    if not points:
        return
    x, y = np.array(points).T
    width = max(1, round(len(y) * SMOOTHING))
    axis.plot(
        x,
        y,
        style,
        color=color,
        alpha=0.25 if width > 1 else 1.0,
        linewidth=1.0,
        label=None if width > 1 else label,
    )
    if width > 1:
        # Divide by the number of samples at hand, so that the ends are not pulled to zero.
        weights = np.ones(width)
        smooth = np.convolve(y, weights, "same") / np.convolve(np.ones_like(y), weights, "same")
        axis.plot(x, smooth, style, color=color, linewidth=1.8, label=label)
