"""Curves of training runs from ``progress.jsonl``, of teachers and students."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from vd.files import atomic_path, check_file

SMOOTHING = 1 / 40
"""Share of a run over which the smooth line averages; the raw values stay visible behind it."""
COLUMNS = 4
"""Panels in a row."""
PANELS = (
    ("goals reached [%]", "success_per_goal", 100.0),
    ("mean reward per control step", "mean_reward", 1.0),
    ("reward terms per control step, before scaling", "reward/", 1.0),
    ("difficulty (1: as configured)", "task/difficulty", 1.0),
    ("tightness (1: as configured)", "task/tightness", 1.0),
    ("mean rotation error [rad]", "task/rotation_error", 1.0),
    ("mean std of the actions", "action_std", 1.0),
    ("episodes that end in a fall [%]", "drop_rate", 100.0),
    ("error of the predicted rotation [rad]", "student/rotation_error", 1.0),
    ("its median on held-out objects [rad]", "validation/rotation_error", 1.0),
    ("goals reached by looks [%]", "looks/success_per_goal", 100.0),
    ("imitation loss", "loss/imitation", 1.0),
    ("control steps (of a student: clouds) per second", "steps_per_s", 1.0),
)
"""Title, quantity and factor of each panel, as far as a run has them; of a group (``/``) the first run's."""


@dataclass
class CurvesCfg:
    """Draw success, reward, terms, difficulty, error, std, falls and speed of runs against control steps."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or progress.jsonl files."""
    out: Path | None = None
    """PNG to write; curves.png beside the first run's progress by default."""


def curves_command(arguments: list[str], _started: float) -> int:
    """``vd-train curves``; the exit status."""
    cfg = tyro.cli(CurvesCfg, args=arguments, prog="vd-train curves")
    from vd.train.metrics import PROGRESS_FILE  # loads torch

    files = [run / PROGRESS_FILE if run.is_dir() else run for run in cfg.runs]
    output = cfg.out or files[0].with_name("curves.png")
    check_file(output)
    plot_curves(files, output)
    print(output)
    return 0


def plot_curves(progress: Sequence[Path], output: Path) -> None:
    """Draw success, reward, errors, curriculum and speed of runs against control steps.

    Args:
        progress: ``progress.jsonl`` files; with several, reward terms are the first's.
        output: PNG to write.

    Raises:
        FileNotFoundError: No such file.
        ValueError: A file has no iteration.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    runs = _read_runs(progress)
    first = next(iter(runs.values()))
    panels = [panel for panel in PANELS if any(_quantities(rows, panel[1]) for rows in runs.values())]
    most = max(rows[-1]["env_steps"] for rows in runs.values())
    scale, unit = (1e6, "million") if most >= 1e6 else (1e3, "thousand")
    height = math.ceil(len(panels) / COLUMNS)
    figure, axes = plt.subplots(
        height, COLUMNS, figsize=(19, 4 * height), squeeze=False, constrained_layout=True
    )
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (title, key, factor) in zip(axes.flat, panels, strict=False):
        lines = [(name, rows, key) for name, rows in runs.items()]
        if key.endswith("/"):  # terms span orders of magnitude around zero
            lines = [(term.removeprefix(key), first, term) for term in _quantities(first, key)]
            axis.set_yscale("symlog", linthresh=1e-2)
        for label, rows, quantity in lines:
            _draw_line(axis, label, rows, quantity, scale, factor)
        axis.set(title=title, xlabel=f"control steps [{unit}]")
        axis.grid(alpha=0.3)
        if len(lines) > 1:
            axis.legend(fontsize="small", framealpha=0.5)
    with atomic_path(Path(output)) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def _quantities(rows: list[dict[str, Any]], key: str) -> list[str]:
    """Quantities of a run that a panel's key means: itself, or those of a group but their total."""
    known = {name for row in rows for name, value in row.items() if value is not None}
    if not key.endswith("/"):
        return [key] if key in known else []
    return sorted(name for name in known if name.startswith(key) and name != f"{key}total")


def _read_runs(progress: Sequence[Path]) -> dict[str, list[dict[str, Any]]]:
    """Rows of runs by the name of their folder."""
    from vd.train.metrics import read_progress

    runs = {}
    for path in progress:
        if not path.is_file():
            raise FileNotFoundError(f"no {path}; give the folder of a run of vd-train")
        rows = read_progress(path)
        if not rows:
            raise ValueError(f"{path} has no iteration yet; wait for the first one")
        runs[path.parent.name or path.stem] = rows
    return runs


def _draw_line(
    axis: Any, label: str, rows: list[dict[str, Any]], key: str, scale: float, factor: float
) -> None:
    """One quantity: raw values pale, a running mean on top. Iterations without a value leave a gap."""
    points = [(row["env_steps"] / scale, row[key] * factor) for row in rows if row.get(key) is not None]
    if not points:
        return
    x, y = np.array(points).T
    weights = np.ones(max(1, round(len(y) * SMOOTHING)))
    # Divided by the number of samples at hand, so that the ends are not pulled to zero.
    smooth = np.convolve(y, weights, "same") / np.convolve(np.ones_like(y), weights, "same")
    (line,) = axis.plot(x, smooth, linewidth=1.8, label=label)
    axis.plot(x, y, color=line.get_color(), alpha=0.25, linewidth=1.0)
