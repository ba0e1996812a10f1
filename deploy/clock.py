"""Time, as everything near the motors knows it.

One clock, passed on, so that a test can bring its own.

A simulated clock makes a run exact and repeatable: it goes on only when somebody waits.
"""

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

AHEAD_S = 0.02
"""What came cannot be newer than the moment it came [s]; clocks that stamp it are off by some
ms.
"""


def from_future(time_s: float, now_s: float) -> str:
    """By how much a time [s] lies ahead of the present, with the remedy.

    Empty where it does not.
    """
    ahead_s = time_s - now_s
    if ahead_s <= AHEAD_S:
        return ""
    return f"{ahead_s:.2f} s from the future: wait until the computers' clocks are set (NTP)"


def of_unix(stamp_s: float) -> float:
    """A time since 1970 [s] on the clock of :func:`time.monotonic` [s]."""
    return stamp_s - time.time() + time.monotonic()


class Clock(Protocol):
    """Tells the time, waits, and has something done beside the program."""

    def now(self) -> float:
        """Seconds, from any beginning; never goes back."""

    def sleep(self, seconds: float) -> None:
        """Wait; not at all for less than nothing."""

    def every(self, seconds: float, do: Callable[[], None]) -> Callable[[], None]:
        """Do something again and again, whatever else goes on, until what is returned is called."""

    def beside(self, do: Callable[[], object]) -> Callable[[], bool]:
        """Begin what takes long.

        What is returned tells whether it has ended, and raises what that raised.
        """


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

        thread = threading.Thread(
            target=work, name=getattr(do, "__qualname__", "beside"), daemon=True
        )

        def stop() -> None:
            end.set()
            thread.join()

        thread.start()
        return stop

    def beside(self, do: Callable[[], object]) -> Callable[[], bool]:
        """Do something in a thread, which does not keep the program from its end."""
        future: Future[object] = Future()

        def work() -> None:
            try:
                future.set_result(do())
            except BaseException as error:
                future.set_exception(error)

        threading.Thread(target=work, name="beside", daemon=True).start()

        def ended() -> bool:
            if not future.done():
                return False
            future.result()
            return True

        return ended


MONOTONIC = MonotonicClock()


class Pacer:
    """The grid of control steps, or of samples.

    A step is due at a point of the grid and has to end by the next. One that ends later misses each
    point passed; the step after it begins at once, and the grid stays where it was.

    Args:
        hz: Steps a second.
        clock: Time.
        latest: Share of a period by which a step may begin late; one that would begin later is left
            out, or it would be late too, and the next.
    """

    def __init__(self, hz: float, clock: Clock = MONOTONIC, *, latest: float = 1.0):
        self.period_s = 1.0 / hz
        self.clock = clock
        self._latest = latest
        self.due_s = -math.inf
        """When the present step was due [s]; before the first one long ago."""
        self.missed = 0
        """Deadlines missed so far."""

    def wait(self) -> float:
        """Wait for the next step; how late it begins [s]."""
        now = self.clock.now()
        if self.due_s == -math.inf:
            self.due_s = now
            return 0.0
        self.due_s += self.period_s
        behind = int((now - self.due_s) // self.period_s)
        if behind > 0:
            self.due_s += behind * self.period_s
        if now - self.due_s > self._latest * self.period_s:
            self.due_s += self.period_s
        while (left := self.due_s - self.clock.now()) > 0.0:
            self.clock.sleep(left)
        return self.clock.now() - self.due_s

    def end(self) -> bool:
        """The step's work is done; whether after its deadline."""
        passed = int((self.clock.now() - self.due_s) // self.period_s)
        self.missed += max(passed, 0)
        return passed > 0
