"""What the control loop needs of whatever tells an object's pose."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

UNIT_TOLERANCE = 0.01
"""Deviation of a quaternion's length from 1, above which it is none."""


class PoseSourceError(RuntimeError):
    """A source of poses, or a pose, that cannot be used; names the remedy."""


@dataclass(frozen=True, eq=False)
class StampedPose:
    """Where an object was at a time."""

    time_s: float
    """When it was there [s], on the clock of :func:`time.monotonic`: the exposure of an image."""
    pose: np.ndarray
    """Position [m] and quaternion xyzw, in the frame of the source [7]."""


class PoseSource(Protocol):
    """Whatever tells an object's pose."""

    name: str
    """As it is called on the command line."""
    trouble: str
    """Why there is nothing newer than what :meth:`read` gave last; empty: it is not known."""

    def read(self) -> StampedPose | None:
        """The newest pose; None before the first one. Does not wait for another.

        Raises:
            PoseSourceError: What came is no pose.
        """

    def close(self) -> None:
        """End it; no :meth:`read` after this."""


def make_pose(position: Sequence[float], quaternion: Sequence[float], where: str) -> np.ndarray:
    """A pose [7] of what somebody sent.

    Args:
        position: Metres.
        quaternion: Xyzw.
        where: Who sent it.

    Raises:
        PoseSourceError: It is none.
    """
    place = np.asarray(position, dtype=float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise PoseSourceError(f"{where}: position is {position}; send 3 finite numbers, metres")
    turn = np.asarray(quaternion, dtype=float)
    if turn.shape != (4,) or not abs(np.linalg.norm(turn) - 1.0) < UNIT_TOLERANCE:
        raise PoseSourceError(f"{where}: quaternion is {quaternion}; send x, y, z, w of length 1")
    return np.concatenate([place, turn / np.linalg.norm(turn)])
