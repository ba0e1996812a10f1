"""Stages of the demo: numbered, timed, remembered, and ended by the clock where they can be left out."""

import json
import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from vd.files import write_json


class TimeUp(BaseException):
    """The time of a stage is used up; like KeyboardInterrupt no error, and nothing may take it for one."""


@dataclass(frozen=True)
class Budget:
    """Time for the whole demo.

    Attributes:
        minutes: For everything [min].
        clock: Seconds that only rise.
        started: What the clock said at the start [s].
    """

    minutes: float
    clock: Callable[[], float] = time.monotonic
    started: float = field(default_factory=time.monotonic)

    def left_s(self, *, keep_min: float = 0.0) -> float:
        """Time that is left [s], at least 0.

        Args:
            keep_min: Part of it that later stages need [min].
        """
        return max(60.0 * (self.minutes - keep_min) - (self.clock() - self.started), 0.0)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise :class:`TimeUp` in the block when it has run for so long.

    An alarm of the operating system, so that what runs needs no code for it; main thread only. It acts
    between two steps of Python, thus after the call into a library that is under way.

    Args:
        seconds: Time of the block; the block does not begin if there is none.

    Raises:
        TimeUp: The time is used up.
    """

    def stop(_number: int, _frame: FrameType | None) -> None:
        raise TimeUp

    if seconds <= 0.0:
        raise TimeUp
    previous = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)


@dataclass
class Stages:
    """Numbered stages with their durations, remembered in a file so that a later call skips them.

    Attributes:
        path: The file.
        total: Number of stages.
        budget: Time of the demo.
        seconds: Duration of each finished stage.
        left_out: Stages that did not fit: what, and the command that does it by hand.
    """

    path: Path
    total: int
    budget: Budget
    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[tuple[str, str]] = field(default_factory=list)
    _number: int = 0

    def load(self) -> None:
        """Read what earlier calls finished."""
        if self.path.is_file():
            try:
                self.seconds = json.loads(self.path.read_text())
            except json.JSONDecodeError as error:
                raise ValueError(f"{self.path} is damaged ({error}); delete it") from error

    @contextmanager
    def run(self, name: str, title: str, *, products: Sequence[Path] = ()) -> Iterator[bool]:
        """Announce a stage; yields whether it has to run, and records its duration if it does not raise.

        Without ``products``, files that show that it was finished, it always has to.
        """
        self._number += 1
        done = name in self.seconds and bool(products) and all(path.exists() for path in products)
        note = f"   (done before, {self.seconds[name]:.0f} s)" if done else ""
        minutes = math.ceil(self.budget.left_s() / 60.0)
        print(f"\n[{self._number}/{self.total}, {minutes} min left] {title}{note}", flush=True)
        started = time.monotonic()
        yield not done
        if not done:
            self.seconds[name] = time.monotonic() - started
            write_json(self.path, self.seconds)

    def run_if_time(
        self,
        name: str,
        title: str,
        work: Callable[[], None],
        *,
        products: Sequence[Path],
        keep_min: float,
        command: str,
    ) -> bool:
        """Run a stage that can be left out, for as long as the budget allows.

        Args:
            name: Name in the file.
            title: What to announce.
            work: Makes the products.
            products: Files.
            keep_min: Time that later stages need [min].
            command: The same by hand, named if it is left out.

        Returns:
            Whether the products are there.
        """
        try:
            with self.run(name, title, products=products) as needed:
                if needed:
                    with time_limit(self.budget.left_s(keep_min=keep_min)):
                        work()
        except TimeUp:
            self.leave_out(title, command)
            return False
        return True

    def leave_out(self, what: str, command: str) -> None:
        """Say and remember that there was no time for something, and the command that does it."""
        print(f"  no time left to {what}\n  by hand: {command}", flush=True)
        self.left_out.append((what, command))
