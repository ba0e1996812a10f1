"""The live progress of a run: two lines and a bar on a terminal, lines now and then elsewhere."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.spinner import Spinner
from rich.text import Text

BUILDING = "building the environments (the first start compiles the kernels: a minute or two)"
FIRST = "first iteration ..."
PLAIN_INTERVAL_S = 10.0
"""Time between lines when the output is a file or a pipe."""
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


def format_duration(seconds: float) -> str:
    """``h:mm:ss``."""
    minutes, second = divmod(int(max(seconds, 0.0)), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}"


def format_steps(count: float) -> str:
    """A count with a thousands or millions suffix."""
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= size:
            return f"{count / size:.2f}{suffix}"
    return f"{count:.0f}"


def summary(row: Mapping[str, Any], total: int, left_s: float) -> str:
    """The main figures of an iteration in one line.

    Args:
        row: A row of ``progress.jsonl``.
        total: Iterations of the whole run.
        left_s: Estimated time left [s].
    """
    parts = [
        f"iteration {row['iteration']}/{total}",
        f"{format_steps(row['env_steps'])} steps, {format_steps(row['steps_per_s'])}/s",
        *(text.format(row[key]) for key, text in FIGURES.items() if row.get(key) is not None),
        f"left {format_duration(left_s)}",
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


@contextmanager
def waiting(message: str, enabled: bool = True) -> Iterator[None]:
    """Show ``message`` with the time passed while the block runs; without a terminal, the message once."""
    console = Console(quiet=not enabled)
    if not console.is_terminal:
        console.print(f"{message} ...", highlight=False)
        yield
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        progress.add_task(message, total=None)
        yield


class ProgressLine:
    """Shows the latest iteration; a context manager.

    Args:
        total: Iterations of the whole run.
        done: Iterations already done by earlier runs.
        enabled: Show anything (false on all ranks but the first).
    """

    def __init__(self, total: int, *, done: int = 0, enabled: bool = True) -> None:
        self._total, self._console = total, Console(quiet=not enabled)
        self._bar = Progress(TextColumn("{task.percentage:5.1f} %"), BarColumn(bar_width=None))
        self._task = self._bar.add_task("train", total=total, completed=done)
        self._live: Live | None = None
        self._printed = -PLAIN_INTERVAL_S
        self._unprinted: tuple[str, str] | None = None

    def __enter__(self) -> "ProgressLine":
        if self._console.is_terminal:
            self._live = Live(Spinner("dots", FIRST), console=self._console, refresh_per_second=4)
            self._live.start()
        else:
            self.note(FIRST)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()
        else:
            self._print()

    def update(self, row: dict[str, Any], left_s: float) -> None:
        """Show an iteration."""
        main, more = summary(row, self._total, left_s), details(row)
        if self._live is not None:
            self._bar.update(self._task, completed=row["iteration"])
            self._live.update(Group(Text(main), Text(more, "dim"), self._bar))
            return
        self._unprinted = main, more
        if time.monotonic() - self._printed >= PLAIN_INTERVAL_S:
            self._print()

    def note(self, message: str) -> None:
        """Print a message above the line."""
        self._console.print(message, highlight=False, soft_wrap=True)

    def _print(self) -> None:
        if self._unprinted is not None:
            self.note("\n  ".join(self._unprinted))
            self._printed, self._unprinted = time.monotonic(), None
