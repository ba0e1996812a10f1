"""Signals while a hand has torque: heard at once, and never thrown into what stops it.

Python tells the main thread of a signal when that comes back from a library; a policy that hangs
there does not. The interpreter writes each one's number to a pipe before, which any thread reads.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

REASONS = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGTERM: "asked to end",
    signal.SIGHUP: "the terminal is gone",
    signal.SIGQUIT: "Ctrl-\\",
    signal.SIGTSTP: "Ctrl-Z; a hand is not suspended with its torque on",
}
"""Signals that stop the hand, and what is said of them."""
BACKGROUND = (signal.SIGTTIN, signal.SIGTTOU)
"""Signals that suspend a program that uses the terminal from the background."""
MOST = 512
"""Signals that are taken at once."""


class Signals:
    """The signals of a block of code, none of which interrupts it; outside the main thread none."""

    def __init__(self) -> None:
        self._came: list[int] = []
        self._pipe: tuple[int, int] | None = None
        self._wakeup = -1
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            self._pipe = os.pipe()
            for end in self._pipe:
                os.set_blocking(end, False)
            self._wakeup = signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
            for number in REASONS:
                self._handlers[number] = signal.signal(number, lambda *_: None)
            for number in BACKGROUND:
                self._handlers[number] = signal.signal(number, signal.SIG_IGN)
        return self

    def __exit__(self, *_: object) -> None:
        if self._pipe is None:
            return
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup)
        self.came()
        pipe = self._pipe
        self._pipe = None
        for end in pipe:
            os.close(end)

    def came(self) -> list[int]:
        """Their numbers so far, in order."""
        if self._pipe is not None:
            with contextlib.suppress(BlockingIOError):
                heard = os.read(self._pipe[0], MOST)
                self._came.extend(number for number in heard if number in REASONS)
        return self._came


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Have signals wait for the end of the block, and come then."""
    with Signals() as signals:
        yield
    for number in signals.came()[:1]:
        os.kill(os.getpid(), number)
