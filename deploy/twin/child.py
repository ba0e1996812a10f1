"""A twin as a process of its own, which ends with the one that started it.

Beside its motors it tells what no real hand does: the object's true pose and depth images of it.
"""

import multiprocessing
import select
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import Frame, StaleCamera

START_S = 1200.0
"""Longest start: on a machine that has not compiled the simulator's kernels, and has other work."""
END_S = 5.0
"""Time that a twin has to end."""
ANSWER_S = 5.0
"""Longest wait for an answer that the loop does not depend on."""


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
        self._pipe, far = multiprocessing.Pipe()
        self._lock = threading.Lock()
        self._words = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed with the twin)
        # A session of its own: Ctrl-C in the terminal is for the one who drives the hand.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "vd.deploy.twin.twin", "--side", str(far.fileno()), *arguments],
            stdout=subprocess.PIPE,
            stderr=self._words,
            bufsize=0,
            pass_fds=[far.fileno()],
            start_new_session=True,
        )
        far.close()
        try:
            self.path = self._first_line()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End it."""
        assert self._process.stdout is not None
        self._pipe.close()
        try:
            self._process.wait(timeout=END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._words.close()

    def object_pose(self) -> np.ndarray:
        """The object's true position [m] and quaternion xyzw [7].

        Raises:
            TwinError: No answer.
        """
        return np.asarray(self._ask("pose"))

    def place_object(self) -> None:
        """Put the object where an episode starts; it falls from there.

        Raises:
            TwinError: No answer.
        """
        self._ask("place")

    def depth(self, timeout_s: float) -> tuple[np.ndarray, float]:
        """A depth image of the present [m] [H, W], and its time [s].

        Raises:
            TwinError: No answer.
        """
        image, time_s = self._ask("depth", timeout_s)
        return image, time_s

    def _ask(self, what: str, timeout_s: float = ANSWER_S) -> Any:
        with self._lock:
            try:
                while self._pipe.poll():  # an answer that came too late
                    self._pipe.recv()
                self._pipe.send(what)
                if self._pipe.poll(timeout_s):
                    return self._pipe.recv()
            except (OSError, EOFError) as error:
                raise TwinError("the twin is gone") from error
        raise TwinError(f"the twin does not answer within {timeout_s:.2f} s")

    def _first_line(self) -> str:
        """The device that it prints when it serves; libraries may have said something before.

        Raises:
            TwinError: It ended before, or takes too long.
        """
        assert self._process.stdout is not None
        end = time.monotonic() + START_S
        while select.select([self._process.stdout], [], [], max(0.0, end - time.monotonic()))[0]:
            line = self._process.stdout.readline().decode()
            if line.startswith("/"):
                return line.strip()
            if not line:
                self._words.seek(0)
                words = self._words.read().strip().splitlines()
                raise TwinError(f"the twin did not start: {words[-1] if words else 'no answer'}")
        raise TwinError(
            f"the twin did not start within {START_S:g} s; what it has compiled is kept, so try again, "
            "or with fewer other programs"
        )


class TwinCamera:
    """The depth camera of a twin: an image whenever one is wanted.

    Args:
        twin: The twin.
        intrinsics: Of the camera that it was told to have.
    """

    def __init__(self, twin: TwinChild, intrinsics: Intrinsics):
        self._twin, self.intrinsics = twin, intrinsics

    def read(self, timeout_s: float) -> Frame:
        """An image of the present.

        Raises:
            StaleCamera: None came in time.
        """
        try:
            return Frame(*self._twin.depth(timeout_s))
        except TwinError as error:
            raise StaleCamera(str(error)) from error

    def close(self) -> None:
        """Nothing to stop: the twin goes on."""
