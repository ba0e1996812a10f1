"""What a hand has to do for whoever drives it, whether real motors, a ROS 2 driver or a twin."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from vd.deploy.clock import Clock
from vd.deploy.hardware.answers import HandState


class Motors(Protocol):
    """The motors of a hand. Arrays have shape [D], in the motors' order.

    Each method raises :class:`vd.deploy.hardware.answers.BusError` where it could not be done.
    """

    ids: tuple[int, ...]
    clock: Clock

    def read_state(self, *, retries: int | None = None) -> HandState:
        """The newest state, asked for again so often where no sound one came."""

    def write_goals(self, goals: np.ndarray, *, with_state: bool = False) -> None:
        """Send goals [rad], at once or with the question of the next :meth:`read_state`."""

    def freeze(self) -> None:
        """Have the motors stop where they are, though nobody knows where that is."""

    def stiffen(self, share: float, ids: Sequence[int] | None = None) -> None:
        """Have motors, all by default, hold with a share of their own position gain."""

    def torque(self, on: bool, ids: Sequence[int] | None = None) -> dict[int, str]:
        """Switch the torque of motors, all by default; what failed, by ID."""

    def read_torque(self) -> np.ndarray:
        """Whether each motor has its torque on, bool."""

    def read_tripped(self) -> np.ndarray:
        """Whether each motor was stopped by its bus watchdog, and refuses goals, bool."""

    def hardware_errors(self) -> dict[int, str]:
        """Errors of the motors that have one, in words, by ID."""

    def watch(self, seconds: float) -> None:
        """Have the motors stop by themselves after so much silence [s]; 0 for never."""

    def release(self) -> None:
        """Switch the torque of all motors off at once; nobody answers."""


class FaultlessMotors:
    """What a hand answers whose motors nobody looks after here: a twin's, or those behind ROS 2."""

    ids: tuple[int, ...]

    def read_tripped(self) -> np.ndarray:
        """None was stopped by a watchdog."""
        return np.zeros(len(self.ids), dtype=bool)

    def hardware_errors(self) -> dict[int, str]:
        """None that we know."""
        return {}

    def watch(self, seconds: float) -> None:
        """Nothing to set."""
