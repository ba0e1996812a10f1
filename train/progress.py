"""The progress of a run: two lines now and then."""

import time
from collections.abc import Mapping
from datetime import timedelta
from typing import Any

INTERVAL_S = 10.0
"""Between two prints."""
FIGURES = {
    "success_per_goal": "success {:.1%} of goals",
    "level/goals": "goals {:.2f}",
    "level/stillness": "stillness {:.2f}",
    "level/physics": "physics {:.2f}",
    "level/air": "air {:.2f}",
    "mean_reward": "reward {:.3f}",
    "task/rotation_error": "error {:.2f} rad",
    "action_std": "std {:.3f}",
    "alignment/rotation_error": "rotation {:.2f} rad",
    "learn/rotation_error": "rotation {:.2f} rad",
    "looks/success_per_goal": "success {:.1%} of goals",
}
"""What the first line says of an iteration, as far as its row has it."""


class ProgressLines:
    """Prints the first, the latest and the last iteration of ``total``; a context manager.

    All ranks but the first are not ``enabled``, and print nothing.
    """

    def __init__(self, total: int, *, enabled: bool = True) -> None:
        self._total = total
        self._enabled = enabled
        self._printed_s = -INTERVAL_S
        self._waiting = ""

    def __enter__(self) -> "ProgressLines":
        self.note("first iteration ...")
        return self

    def __exit__(self, *_: object) -> None:
        if self._waiting:
            self.note(self._waiting)

    def update(self, row: Mapping[str, Any], left_s: float) -> None:
        """Take an iteration, a row of ``progress.jsonl``, and the estimated time left [s]."""
        parts = [
            f"iteration {row['iteration']}/{self._total}",
            f"{row['env_steps']:,} steps, {row['steps_per_s']:,.0f}/s",
            *(text.format(row[key]) for key, text in FIGURES.items() if row.get(key) is not None),
            f"left {timedelta(seconds=max(0, round(left_s)))}",
        ]
        self._waiting = f"{' | '.join(parts)}\n  {_terms(row)}"
        if time.monotonic() - self._printed_s >= INTERVAL_S:
            self.note(self._waiting)
            self._printed_s = time.monotonic()
            self._waiting = ""

    def note(self, message: str) -> None:
        """Print a message."""
        if self._enabled:
            print(message, flush=True)


def _terms(row: Mapping[str, Any]) -> str:
    """The terms of the reward of an iteration, mean per control step, or else its losses."""
    for group in ("reward/", "loss/"):
        terms = {
            k.removeprefix(group): v
            for k, v in row.items()
            if k.startswith(group) and v is not None
        }
        terms.pop("total", None)
        if terms:
            return f"{group[:-1]}: " + "  ".join(
                f"{name} {value:+.3f}" for name, value in terms.items()
            )
    return ""
