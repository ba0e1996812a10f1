"""What a policy that sees by a camera is told before an action, by a simulator or a robot's drivers."""

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
