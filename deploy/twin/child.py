"""A twin as a process of its own, which ends with the one that started it.

Beside its motors it tells what no real hand does: the object's true pose and depth images of it.
"""

import multiprocessing
import os
import threading
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import Frame, StaleCamera
from vd.deploy.twin.twin import TwinCommand

START_S = 1200.0
"""Longest start: on a machine that has not compiled the simulator's kernels, and has other work."""
END_S = 5.0
"""Time that a twin has to end."""
ANSWER_S = 5.0
"""Longest wait for an answer that the loop does not depend on."""


class TwinError(RuntimeError):
    """The twin did not start, or is gone."""


class TwinChild:
    """A running twin, with the device of its bus as ``path``.

    Raises:
        TwinError: It did not start; says why.
    """

    def __init__(self, command: TwinCommand):
        """Start it and wait until it serves."""
        new = multiprocessing.get_context("spawn")
        self._pipe, far = new.Pipe()
        self._lock = threading.Lock()
        self._process = new.Process(target=_serve, args=(command, far), daemon=True)
        self._process.start()
        far.close()
        try:
            self.path = self._started()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End it."""
        self._pipe.close()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def object_state(self) -> np.ndarray:
        """The object's true position [m], quaternion xyzw, velocity [m/s] and spin [rad/s] [13].

        Raises:
            TwinError: No answer.
        """
        return np.asarray(self.ask("object"))

    def place_object(self) -> None:
        """Put the object where an episode starts; it falls from there.

        Raises:
            TwinError: No answer.
        """
        self.ask("place")

    def ask(self, what: str, timeout_s: float = ANSWER_S) -> Any:
        """The answer to a request of :meth:`vd.deploy.twin.twin.TwinCommand.serve`.

        Raises:
            TwinError: None within ``timeout_s``.
        """
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

    def _started(self) -> str:
        """The device of its bus, once it serves."""
        if not self._pipe.poll(START_S):
            raise TwinError(
                f"the twin did not start within {START_S:g} s; what it has compiled is kept, so "
                "try again, or with fewer other programs"
            )
        try:
            told = self._pipe.recv()
        except EOFError:
            told = TwinError("it ended")
        if isinstance(told, Exception):
            raise TwinError(f"the twin did not start: {told}")
        return str(told)


def _serve(command: TwinCommand, pipe: Connection) -> None:
    """Be a twin, in a process of its own."""
    os.setsid()  # Ctrl-C in the terminal is for the one who drives the hand
    os.dup2(2, 1)  # what libraries say is no output of a command
    try:
        command.serve(pipe)
    except (ValueError, OSError, RuntimeError) as error:
        pipe.send(TwinError(str(error)))


class TwinCamera:
    """The depth camera that a twin was told to have: an image whenever one is wanted."""

    def __init__(self, twin: TwinChild, intrinsics: Intrinsics):
        self._twin, self.intrinsics = twin, intrinsics

    def read(self, timeout_s: float) -> Frame:
        """An image of the present.

        Raises:
            StaleCamera: None came in time.
        """
        try:
            return Frame(*self._twin.ask("depth", timeout_s))
        except TwinError as error:
            raise StaleCamera(str(error)) from error

    def close(self) -> None:
        """Nothing to stop: the twin goes on."""
