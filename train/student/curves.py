"""Curves of the student's runs from ``progress.jsonl``."""

import math
from collections.abc import Sequence
from pathlib import Path

from vd.files import atomic_path
from vd.train.curves import draw_line, read_runs

PANELS = (
    (
        "student/action_error",
        "error of the student's mean action,\nroot mean square, in rollouts",
        1.0,
    ),
    ("student/unexplained", "share of the labels' variance\nthat is left, in rollouts", 1.0),
    ("validation/unexplained", "share of the labels' variance\nthat is left, on the fixed set", 1.0),
    (
        "validation/rotation_error",
        "mean error of the predicted rotation\nfrom the goal, on the fixed set [rad]",
        1.0,
    ),
    ("student/distance_error", "mean error of the predicted distance [rad]", 1.0),
    ("success_per_goal", "goals reached while it explores [%]", 100.0),
    ("student/category", "objects told right [%]", 100.0),
    ("student/rotation_error", "mean error of the predicted rotation\nfrom the goal, stage 0 [rad]", 1.0),
    ("student/joint_error", "error of joint positions,\nroot mean square [rad]", 1.0),
    ("loss/imitation", "imitation loss", 1.0),
    ("steps_per_s", "control steps (stage 0: clouds) per second", 1.0),
)
"""Quantity, title and factor of each panel; those that no run has are left out."""
COLUMNS = 4
"""Panels in a row."""


def plot_student_curves(progress: Sequence[Path], output: Path) -> None:
    """Draw errors, success, losses and speed of runs against control steps.

    Args:
        progress: ``progress.jsonl`` files.
        output: PNG to write.

    Raises:
        FileNotFoundError: No such file.
        ValueError: A file has no iteration.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    runs = read_runs(progress)
    most = max(rows[-1]["env_steps"] for rows in runs.values())
    scale, unit = (1e6, "million") if most >= 1e6 else (1e3, "thousand")
    panels = [p for p in PANELS if any(row.get(p[0]) is not None for rows in runs.values() for row in rows)]
    lines = math.ceil(len(panels) / COLUMNS)
    figure, axes = plt.subplots(
        lines, COLUMNS, figsize=(4.75 * COLUMNS, 4.0 * lines), squeeze=False, constrained_layout=True
    )
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (key, title, factor) in zip(axes.flat, panels, strict=False):
        for index, (name, rows) in enumerate(runs.items()):
            draw_line(axis, rows, key, scale, factor=factor, color=f"C{index}", label=name)
        axis.set_title(title)
        axis.set_xlabel(f"control steps [{unit}]")
        axis.grid(alpha=0.3)
        if not key.startswith("loss/"):
            axis.set_ylim(bottom=0.0)
        if len(runs) > 1:
            axis.legend(fontsize="small", framealpha=0.5)
    with atomic_path(Path(output)) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)
