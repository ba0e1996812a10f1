"""Simulated motors behind a pseudo-terminal.

Programs talk to it as to a serial port with motors on it.

The motors of :mod:`motor_line` answer byte by byte; behind them stands any
:class:`motor_plant.Plant`. Motors hear what arrives when it arrives, however long the plant takes:
they have processors of their own.
"""

import contextlib
import os
import pty
import select
import termios
import threading
import tty
from collections.abc import Sequence
from queue import Empty, SimpleQueue

from motor_line import Faults, MotorLine
from motor_model import Motor
from motor_plant import Plant

IDLE_S = 0.005
"""Longest wait for bytes: the plant goes on in steps of this size at most."""
LONGEST = 4096
"""Bytes that are taken at once."""


class MotorTerminal(MotorLine):
    """Motors on a line, stepped in real time, behind a pseudo-terminal.

    Arguments are those of :class:`MotorLine`.
    """

    def __init__(
        self, motors: Sequence[Motor], plant: Plant | None = None, faults: Faults | None = None
    ):
        """Open the pseudo-terminal; serves once entered."""
        super().__init__(motors, plant, faults, put=self._write)
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._heard: SimpleQueue[tuple[float, bytes]] = SimpleQueue()
        self._near, self._far = pty.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.path = os.ttyname(self._far)
        """Device for a program to open."""

    def __enter__(self) -> "MotorTerminal":
        self._thread = threading.Thread(target=self.serve, name="twin", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving and close the pseudo-terminal."""
        self.end()
        if self._thread is not None:
            self._thread.join()
        for end in (self._near, self._far):
            os.close(end)

    def end(self) -> None:
        """Have :meth:`serve` return."""
        self._end.set()

    def serve(self) -> None:
        """Answer until it has to end."""
        listener = threading.Thread(target=self._listen, name="listener", daemon=True)
        listener.start()
        try:
            while not self._end.is_set():
                self._serve_once()
        finally:
            self.end()
            listener.join()

    def _serve_once(self) -> None:
        wait_s = max(0.0, min(IDLE_S, self.due_s - self.clock.now()))
        try:
            at, heard = self._heard.get(timeout=wait_s)
        except Empty:
            self.go_on()
            return
        self.go_on(heard, at=at)

    def _listen(self) -> None:
        """Pass on what arrives, with the time at which it did.

        Meanwhile the plant may be in a step.
        """
        while not self._end.is_set():
            if not select.select([self._near], [], [], IDLE_S)[0]:
                continue
            at = self.clock.now()
            with contextlib.suppress(OSError):
                self._heard.put((at, os.read(self._near, LONGEST)))

    def _write(self, data: bytes) -> None:
        try:
            os.write(self._near, data)
        except BlockingIOError:  # nobody reads: as on a wire, what is not read is lost
            termios.tcflush(self._far, termios.TCIFLUSH)
