"""The progress of a run: two lines now and then."""

import time
from collections.abc import Mapping
from datetime import timedelta
from typing import Any

BUILDING = "building the environments (the first start compiles the kernels: a minute or two) ..."
FIRST = "first iteration ..."
INTERVAL_S = 10.0
"""Between two prints."""
FIGURES = {
    "success_per_goal": "success {:.1%} of goals",
    "task/difficulty": "difficulty {:.2f}",
    "task/tightness": "tightness {:.2f}",
    "mean_reward": "reward {:.3f}",
    "task/rotation_error": "error {:.2f} rad",
    "action_std": "std {:.3f}",
    "student/action_error": "action error {:.3f}",
    "student/category": "category right {:.1%}",
    "student/distance_error": "distance error {:.2f} rad",
    "student/joint_error": "joint error {:.2f} rad",
}
"""What the first line says of an iteration, as far as its row has it."""


def summary(row: Mapping[str, Any], total: int, left_s: float) -> str:
    """The main figures of an iteration in one line.

    Args:
        row: A row of ``progress.jsonl``.
        total: Iterations of the whole run.
        left_s: Estimated time left [s].
    """
    parts = [
        f"iteration {row['iteration']}/{total}",
        f"{row['env_steps']:,} steps, {row['steps_per_s']:,.0f}/s",
        *(text.format(row[key]) for key, text in FIGURES.items() if row.get(key) is not None),
        f"left {timedelta(seconds=max(0, round(left_s)))}",
    ]
    return " | ".join(parts)


def details(row: Mapping[str, Any]) -> str:
    """The terms of the reward of an iteration, mean per control step, or else its losses."""
    for group in ("reward/", "loss/"):
        terms = {k.removeprefix(group): v for k, v in row.items() if k.startswith(group) and v is not None}
        terms.pop("total", None)
        if terms:
            return f"{group[:-1]}: " + "  ".join(f"{name} {value:+.3f}" for name, value in terms.items())
    return ""


class ProgressLines:
    """Prints the latest iteration now and then; a context manager.

    Args:
        total: Iterations of the whole run.
        enabled: Print anything (false on all ranks but the first).
    """

    def __init__(self, total: int, *, enabled: bool = True) -> None:
        self._total, self._enabled = total, enabled
        self._printed, self._waiting = -INTERVAL_S, FIRST

    def __enter__(self) -> "ProgressLines":
        self._print()
        self._printed = -INTERVAL_S
        return self

    def __exit__(self, *_: object) -> None:
        self._print()

    def update(self, row: dict[str, Any], left_s: float) -> None:
        """Take an iteration."""
        self._waiting = f"{summary(row, self._total, left_s)}\n  {details(row)}"
        if time.monotonic() - self._printed >= INTERVAL_S:
            self._print()

    def note(self, message: str) -> None:
        """Print a message."""
        if self._enabled:
            print(message, flush=True)

    def _print(self) -> None:
        if self._waiting:
            self.note(self._waiting)
        self._printed, self._waiting = time.monotonic(), ""
