"""The demo's student: a scene learned by heart, then imitation of an installed teacher on many scenes."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd import interrupt
from vd.page import Page
from vd.train.demo_stages import TimeUp
from vd.train.metrics import PROGRESS_FILE, read_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ONE_SCENE, MANY_SCENES = "student-one-scene", "student-many-scenes"
PRESETS = {ONE_SCENE: "cpu-overfit", MANY_SCENES: "cpu-demo"}
"""Preset of ``vd-train student`` behind each run."""
STUDENT_MIN, LEAST_STUDENT_MIN = 2.3, 0.8
"""Time of both runs together [min], worlds and kernels included: at most, and for the least that shows."""
ONE_SCENE_SHARE = 0.35
"""Share of it for the scene to be learned by heart."""
BEGUN = 0.95
"""Share of doing nothing's error below which a student has begun to imitate."""


def student_commands(folder: Path, seed: int) -> list[list[str]]:
    """Arguments of ``vd-train`` for both runs."""
    return [
        [
            "student",
            "--preset",
            preset,
            "--seed",
            str(seed),
            "--run-dir",
            str(folder / name),
            "--resume",
            "auto",
        ]
        for name, preset in PRESETS.items()
    ]


def student_files(folder: Path) -> list[Path]:
    """What the runs leave."""
    return [folder / name / "student.pt" for name in PRESETS]


def train_students(folder: Path, seed: int, *, minutes: float) -> None:
    """Run both, for at most STUDENT_MIN.

    Args:
        folder: The demo's folder.
        seed: Of worlds and weights.
        minutes: Time there is.

    Raises:
        TimeUp: There is less than LEAST_STUDENT_MIN.
        RuntimeError: A run failed; it has said why.
        KeyboardInterrupt: It was interrupted, and has saved.
    """
    from vd.train import cli

    minutes = min(minutes, STUDENT_MIN)
    if minutes < LEAST_STUDENT_MIN:
        raise TimeUp
    shares = (ONE_SCENE_SHARE, 1.0 - ONE_SCENE_SHARE)
    for arguments, share in zip(student_commands(folder, seed), shares, strict=True):
        status = cli.main([*arguments, "--max-minutes", f"{share * minutes:.2f}", "--no-tensorboard"])
        if status in (interrupt.INTERRUPTED, interrupt.TERMINATED):
            raise KeyboardInterrupt
        if status != 0:
            raise RuntimeError(f"vd-train {' '.join(arguments)} failed; the reason is above")


def add_student(page: Page, folder: Path) -> None:
    """Add what the students learned to the demo's page."""
    one, many = (read_progress(folder / name / PROGRESS_FILE) for name in PRESETS)
    page.section("A student that sees clouds begins to imitate")
    page.text(
        "The teacher above sees the simulator's state. A student sees what a real hand has: point clouds of "
        "hand, object and goal, its own joints and its last action. Here it imitates the installed teacher "
        "dclaw4-cube, with a small network on coarse voxels. First a check that everything between clouds "
        f"and labels is joined up: {one[-1]['iteration']} times the same 20 states. Then a cube in many "
        "scenes; the error that counts is that in worlds from which nothing is learned."
    )
    page.figure(
        student_figure(one, many),
        "Root mean square of the student's action less the teacher's. Left, one scene. Right, many scenes: "
        "on the states that the student comes to (thin), and on episodes held out (thick). Dashed, the error "
        "of always doing nothing.",
    )
    page.text(summary(one, many))
    page.text(
        "Minutes on a processor are the very beginning: docs/student-training.md has longer runs, and those "
        "on a GPU.",
        small=True,
    )


def summary(one: list[dict[str, Any]], many: list[dict[str, Any]]) -> str:
    """What both runs came to, in a sentence or two."""
    first, last = one[0]["student/action_error"], one[-1]["student/action_error"]
    text = (
        f"By heart: the error fell from {first:.2f} to {last:.2f} in {one[-1]['elapsed_s']:.0f} s. "
        f"On many scenes, after {many[-1]['env_steps']:,} control steps and {many[-1]['elapsed_s']:.0f} s: "
    )
    held_out = [row for row in many if row.get("validation/action_error") is not None]
    if not held_out:
        return (
            f"{text}{many[-1]['student/action_error']:.2f} on its own states; no held-out episode had ended."
        )
    error, nothing = held_out[-1]["validation/action_error"], held_out[-1]["validation/zero_error"]
    verdict = "it has begun to imitate" if error < BEGUN * nothing else "that is not yet imitation"
    return f"{text}{error:.2f} on held-out episodes, where doing nothing has {nothing:.2f}; {verdict}."


def student_figure(one: list[dict[str, Any]], many: list[dict[str, Any]]) -> "Figure":
    """Imitation errors of both runs, from the rows of their ``progress.jsonl``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, rows, key, style in (
        (left, one, "student", {"linewidth": 2.2}),
        (right, many, "student", {"linewidth": 0.9, "alpha": 0.7}),
        (right, many, "validation", {"linewidth": 2.2, "marker": "."}),
    ):
        shown = [row for row in rows if row.get(f"{key}/action_error") is not None]
        steps = [row["iteration"] for row in shown]
        axes.plot(steps, [row[f"{key}/action_error"] for row in shown], color="#0072B2", **style)
        if shown and not (axes is right and key == "student"):
            axes.plot(
                steps, [row[f"{key}/zero_error"] for row in shown], "--", color="#8a8f98", linewidth=1.2
            )
    left.set(title="one scene, again and again", xlabel="iteration", ylabel="action error", ylim=(0.0, None))
    right.set(title="many scenes", xlabel="iteration")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    return figure
