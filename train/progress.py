"""The live progress of a run: one line in place on a terminal, a line now and then elsewhere."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.spinner import Spinner
from rich.text import Text

FIRST = "first iteration ..."
PLAIN_INTERVAL_S = 10.0
"""Time between lines when the output is a file or a pipe."""


def format_duration(seconds: float | None) -> str:
    """``h:mm:ss``, or ``?`` if unknown."""
    if seconds is None:
        return "?"
    minutes, second = divmod(int(max(seconds, 0.0)), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}"


def format_steps(count: float) -> str:
    """A count with a thousands or millions suffix."""
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= size:
            return f"{count / size:.2f}{suffix}"
    return f"{count:.0f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} %"


def summary(row: Mapping[str, Any], total: int, left_s: float | None) -> str:
    """The main figures of an iteration in one line.

    Args:
        row: A row of ``progress.jsonl``.
        total: Iterations of the whole run.
        left_s: Estimated time left [s].
    """
    return (
        f"iteration {row['iteration']}/{total} | {format_steps(row['env_steps'])} steps, "
        f"{format_steps(row['steps_per_s'])}/s | success {_percent(row['success_per_goal'])} of goals | "
        f"stage {row['task/difficulty']:.2f} {row['task/tightness']:.2f} | "
        f"reward {row['mean_reward']:.3f} | error {row['task/rotation_error']:.2f} rad | "
        f"std {row['action_std']:.3f} | left {format_duration(left_s)}"
    )


def reward_line(row: Mapping[str, Any]) -> str:
    """The reward terms of an iteration: mean per control step."""
    terms = {key.removeprefix("reward/"): value for key, value in row.items() if key.startswith("reward/")}
    terms.pop("total", None)
    return "rewards per step: " + "  ".join(f"{name} {value:+.3f}" for name, value in terms.items())


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


Summary = Callable[[Mapping[str, Any], int, float | None], str]
"""Main figures in a line: of a row of ``progress.jsonl``, all iterations and the time left [s]."""
Details = Callable[[Mapping[str, Any]], str]
"""More figures in a second line."""


class ProgressLine:
    """Shows the latest iteration; a context manager.

    Args:
        total: Iterations of the whole run.
        done: Iterations already done by earlier runs.
        enabled: Show anything (false on all ranks but the first).
        summary: Writes the first line.
        details: Writes the second line.
    """

    def __init__(
        self,
        total: int,
        *,
        done: int = 0,
        enabled: bool = True,
        summary: Summary = summary,
        details: Details = reward_line,
    ) -> None:
        self._total, self._enabled = total, enabled
        self._summary, self._details = summary, details
        self._console = Console()
        self._bar = Progress(
            TextColumn("{task.percentage:5.1f} %"), BarColumn(bar_width=None), console=self._console
        )
        self._task = self._bar.add_task("train", total=total, completed=done)
        self._live: Live | None = None
        self._printed = -PLAIN_INTERVAL_S
        self._last: tuple[dict[str, Any], float | None] | None = None
        self._last_printed = False

    def __enter__(self) -> "ProgressLine":
        if self._enabled and self._console.is_terminal:
            self._live = Live(Spinner("dots", FIRST), console=self._console, refresh_per_second=4)
            self._live.start()
        elif self._enabled:
            self._console.print(FIRST)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()
        elif self._enabled and self._last is not None and not self._last_printed:
            self._print()

    def update(self, row: dict[str, Any], left_s: float | None) -> None:
        """Show an iteration."""
        if not self._enabled:
            return
        self._last, self._last_printed = (row, left_s), False
        if self._live is not None:
            self._bar.update(self._task, completed=row["iteration"])
            self._live.update(
                Group(
                    Text(self._summary(row, self._total, left_s)), Text(self._details(row), "dim"), self._bar
                )
            )
        elif time.monotonic() - self._printed >= PLAIN_INTERVAL_S:
            self._print()

    def note(self, message: str) -> None:
        """Print a message above the line."""
        if self._enabled:
            self._console.print(message, highlight=False, soft_wrap=True)

    def _print(self) -> None:
        assert self._last is not None
        row, left_s = self._last
        self._console.print(self._summary(row, self._total, left_s), highlight=False, soft_wrap=True)
        self._console.print("  " + self._details(row), highlight=False, soft_wrap=True)
        self._printed, self._last_printed = time.monotonic(), True
