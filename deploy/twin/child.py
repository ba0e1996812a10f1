"""A twin as a process of its own, which ends with the one that started it."""

import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

START_S = 1200.0
"""Longest start: on a machine that has not compiled the simulator's kernels, and has other work."""
USUAL_S = 30.0
"""Longest start on one that has; then it is said what takes so long."""
SLOW = "... it compiles the simulator's kernels, once for this machine: that takes minutes"
END_S = 5.0
"""Time that a twin has to end."""


class TwinError(RuntimeError):
    """The twin did not start, or is gone."""


class TwinChild:
    """A running twin.

    Args:
        arguments: Of ``python -m vd.deploy.twin.twin``.

    Attributes:
        path: Device of its bus.

    Raises:
        TwinError: It did not start; says why.
    """

    def __init__(self, arguments: Sequence[str]):
        """Start it and wait until it serves."""
        command = [sys.executable, "-m", "vd.deploy.twin.twin", "--attached", *arguments]
        self._words = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed with the twin)
        # A session of its own: Ctrl-C in the terminal is for the one who drives the hand.
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._words,
            bufsize=0,
            start_new_session=True,
        )
        try:
            self.path = self._first_line()
        except BaseException:
            TwinChild.close(self)
            raise

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
        """The device that it prints when it serves; libraries may have said something before.

        Raises:
            TwinError: It ended before, or takes too long.
        """
        assert self._process.stdout is not None
        waited, begin = 0.0, time.monotonic()
        while waited < START_S:
            left = (USUAL_S if waited < USUAL_S else START_S) - waited
            if select.select([self._process.stdout], [], [], left)[0]:
                line = self._process.stdout.readline().decode()
                if line.startswith("/"):
                    return line.strip()
                if not line:
                    self._words.seek(0)
                    words = self._words.read().strip().splitlines()
                    raise TwinError(f"the twin did not start: {words[-1] if words else 'no answer'}")
            before, waited = waited, time.monotonic() - begin
            if before < USUAL_S <= waited:
                print(SLOW, file=sys.stderr, flush=True)
        raise TwinError(
            f"the twin did not start within {START_S:g} s; what it has compiled is kept, so try again, "
            "or with fewer other programs"
        )
