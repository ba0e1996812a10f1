"""What a policy that sees by a camera is told before an action, and what it says."""

from dataclasses import dataclass

from vd.geometry.arrays import Array


@dataclass(frozen=True)
class Senses:
    """What N hands sense before an action, as a simulator or a robot's drivers report it."""

    joint_q: Array
    """Joint positions [rad] [N, D]."""
    joint_qd: Array
    """Joint velocities [rad/s] [N, D]."""
    action: Array
    """Moving average of the actions so far [N, D]."""
    goal_quat: Array
    """Wanted orientation of the object [N, 4]."""
    points: Array
    """What the camera sees, base frame [m], NaN for none [N, K, 3]."""
    fresh: Array
    """Where an episode begins: where the object was before means nothing; bool [N]."""


@dataclass(frozen=True)
class CameraDecision:
    """What a policy that sees by a camera says of N hands."""

    action: Array
    """Mean actions [N, D]."""
    angle: Array
    """How far the object is expected to be from its goal [rad] [N]: it is stopped by this."""
    position: Array
    """Where the object is believed to be, world frame [m] [N, 3]."""
    orientation: Array
    """How it is believed to be turned, world frame [N, 4]."""
    voxels: Array
    """How much is seen of it: voxels of the camera's points that are not the hand's [N]."""
