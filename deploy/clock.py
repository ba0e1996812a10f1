"""Time, as everything near the motors knows it: one clock, passed on, so that a test can bring its own.

A simulated clock makes a run exact and repeatable: it goes on only when somebody waits.
"""

import threading
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Tells the time, waits, and has something done beside the program."""

    def now(self) -> float:
        """Seconds, from any beginning; never goes back."""

    def sleep(self, seconds: float) -> None:
        """Wait; not at all for less than nothing."""

    def every(self, seconds: float, do: Callable[[], None]) -> Callable[[], None]:
        """Do something again and again, whatever the program does, until what is returned was called."""


class MonotonicClock:
    """The computer's monotonic clock; what is done beside the program is done by a thread."""

    def now(self) -> float:
        """Seconds of :func:`time.monotonic`."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(max(0.0, seconds))

    def every(self, seconds: float, do: Callable[[], None]) -> Callable[[], None]:
        """Do something in a thread; what is returned ends it, and waits for its end."""
        end = threading.Event()

        def work() -> None:
            while not end.wait(seconds):
                do()

        thread = threading.Thread(target=work, name=getattr(do, "__qualname__", "beside"), daemon=True)

        def stop() -> None:
            end.set()
            thread.join()

        thread.start()
        return stop


MONOTONIC = MonotonicClock()
