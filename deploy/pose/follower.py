"""From poses that somebody sends to the state that a teacher observes, and whether to believe them."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import compose
from vd.deploy.pose.source import PoseSource

FASTEST_M_S, FASTEST_RAD_S = 1.0, 15.0
"""Speeds above which a pose is not believed. In 2848 control steps of ``leap-cube`` in simulation a
cube has at most 0.75 m/s and 15 rad/s, where it falls, and 0.4 m/s and 9 rad/s in 99.9 %."""
LONGEST_S = 0.1
"""Most time between two poses that is counted for that [s]: a pose that turns over stays refused."""


@dataclass(frozen=True, eq=False)
class FollowedObject:
    """An object at a control step."""

    state: np.ndarray | None
    """Position [m], quaternion xyzw, velocity [m/s] and spin [rad/s] in the world frame [13]; None
    before the first pose."""
    time_s: float
    """When it was there [s]."""
    fault: str
    """Why there is no newer state; empty where there is one, or nobody knows why."""


class PoseFollower:
    """An object whose poses come from outside.

    Velocities are the difference of two poses, as in training
    (:mod:`vd.kernels.task.tracked_pose`).

    Args:
        source: Who tells them.
        frame: Pose of the source's frame in the world frame [7].
        begin_s: When it is begun [s]: from then on a first pose is waited for.
    """

    def __init__(self, source: PoseSource, frame: np.ndarray, begin_s: float):
        self._source = source
        self._frame = frame
        self._object = FollowedObject(None, begin_s, f"no pose has come from {source.name}")

    def look(self) -> FollowedObject:
        """The object as it is known now.

        Raises:
            PoseSourceError: What came is no pose.
        """
        newest = self._source.read()
        last = self._object
        if newest is None or newest.time_s <= last.time_s:
            fault = self._source.trouble or (last.fault if last.state is None else "")
            return FollowedObject(last.state, last.time_s, fault)
        pose = compose(self._frame, newest.pose)
        if last.state is None:
            velocity = np.zeros(6)
        else:
            between_s = newest.time_s - last.time_s
            moved = difference(pose, last.state[:7])
            if fault := _jump(moved, between_s):
                return FollowedObject(last.state, last.time_s, f"{self._source.name} {fault}")
            velocity = moved / between_s
        self._object = FollowedObject(np.concatenate([pose, velocity]), newest.time_s, "")
        return self._object


def difference(pose: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Translation [m] and rotation vector [rad] from one pose [7] to another, world frame [6]."""
    turn = Rotation.from_quat(pose[3:]) * Rotation.from_quat(before[3:]).inv()
    return np.concatenate([pose[:3] - before[:3], turn.as_rotvec()])


def _jump(moved: np.ndarray, between_s: float) -> str:
    """Why nothing moves [6] like this in a time [s]; empty if it can."""
    counted_s = min(between_s, LONGEST_S)
    distance_m = float(np.linalg.norm(moved[:3]))
    angle_rad = float(np.linalg.norm(moved[3:]))
    if distance_m <= FASTEST_M_S * counted_s and angle_rad <= FASTEST_RAD_S * counted_s:
        return ""
    return (
        f"jumps by {1e3 * distance_m:.0f} mm and {np.degrees(angle_rad):.0f} degrees in "
        f"{1e3 * between_s:.0f} ms"
    )
