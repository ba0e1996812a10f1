"""A clock that goes on only when somebody waits: what happens when is exact, on any machine."""

from collections.abc import Callable
from typing import Any


class SimulatedClock:
    """A clock that goes on when somebody waits."""

    def __init__(self) -> None:
        self._now = 100.0
        self._beside: list[list[Any]] = []

    def now(self) -> float:
        """The time [s]."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Let time pass, and do what is due meanwhile."""
        end = self._now + max(0.0, seconds)
        while True:
            # One that waits itself is not begun again before it has ended.
            due = min(
                (one for one in self._beside if not one[3]), key=lambda one: one[0], default=None
            )
            if due is None or due[0] > end:
                break
            self._now = max(self._now, due[0])
            due[0] += due[1]
            due[3] = True
            try:
                due[2]()
            finally:
                due[3] = False
        self._now = max(self._now, end)

    def every(self, seconds: float, do: Callable[[], None]) -> Callable[[], None]:
        """Do something whenever so much time has passed."""
        entry = [self._now + seconds, seconds, do, False]
        self._beside.append(entry)
        return lambda: self._beside.remove(entry)

    def beside(self, do: Callable[[], object]) -> Callable[[], bool]:
        """Do it at once, but in a time of its own: it has ended once as much has passed here."""
        begun, others, self._beside = self._now, self._beside, []
        failed: list[Exception] = []
        try:
            do()
        except Exception as error:
            failed.append(error)
        ended, self._now, self._beside = self._now, begun, others

        def over() -> bool:
            if self._now >= ended and failed:
                raise failed[0]
            return self._now >= ended

        return over
