"""A twin as a process of its own, which ends with the one that started it."""

import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

START_S = 300.0
"""Longest start: on a machine that has not compiled the simulator's kernels, that takes minutes."""
END_S = 5.0
"""Time that a twin has to end."""


class TwinError(RuntimeError):
    """The twin did not start, or is gone."""


class TwinChild:
    """A running twin.

    Args:
        arguments: Of ``python -m vd.deploy.twin``.

    Attributes:
        path: Device of its bus.

    Raises:
        TwinError: It did not start; says why.
    """

    def __init__(self, arguments: Sequence[str]):
        """Start it and wait until it serves."""
        command = [sys.executable, "-m", "vd.deploy.twin", "--attached", *arguments]
        self._words = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed with the twin)
        # A session of its own: Ctrl-C in the terminal is for the one who drives the hand.
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._words,
            text=True,
            start_new_session=True,
        )
        self.path = self._first_line()

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._words.close()

    def _first_line(self) -> str:
        """The device that it prints when it serves; libraries may have said something before."""
        assert self._process.stdout is not None
        end = time.monotonic() + START_S
        while select.select([self._process.stdout], [], [], max(0.0, end - time.monotonic()))[0]:
            line = self._process.stdout.readline()
            if line.startswith("/"):
                return line.strip()
            if not line:
                break
        self._words.seek(0)
        words = self._words.read().strip().splitlines()
        TwinChild.close(self)
        raise TwinError(f"the twin did not start: {words[-1] if words else 'no answer'}")
