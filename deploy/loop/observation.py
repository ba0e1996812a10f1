"""What a loop knows of a hand, and what of it policies are told that see by a camera.

Base frame for clouds, world frame for goals and the object; metres, radians, quaternions xyzw.
"""

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from vd.senses import Senses
from vd.sensors.depth_cloud import CameraCloud


@dataclass(frozen=True)
class Sensed:
    """What is known before an action; D joints."""

    joint_q: np.ndarray
    """Joint positions as measured [rad] [D]."""
    joint_qd: np.ndarray
    """Joint velocities as measured [rad/s] [D]."""
    smoothed: np.ndarray
    """Moving average of the actions so far [D]."""
    goal_quat: np.ndarray
    """Wanted orientation of the object [4]."""
    depth: np.ndarray | None = None
    """Depth image [m], 0 for none [H, W]."""
    object_pose: np.ndarray | None = None
    """True pose of the object [7]: a twin's only."""
    object_velocity: np.ndarray | None = None
    """Its true linear [m/s] and angular [rad/s] velocity [6]: a twin's only."""


def seen_points(cloud: CameraCloud, depth: np.ndarray | None) -> torch.Tensor:
    """What a camera sees in an image, base frame [m], NaN for none [1, K, 3]; overwritten by the next call.

    Raises:
        ValueError: There is no image.
    """
    if depth is None:
        raise ValueError("the policy sees by a depth camera, but there is no image")
    points, count = cloud.make(depth)
    seen = wp.to_torch(points)
    if not count.numpy()[0]:  # the false point of an empty cloud counts for nothing
        seen.fill_(torch.nan)
    return seen


def senses_of(sensed: Sensed, points: torch.Tensor, *, fresh: torch.Tensor | None = None) -> Senses:
    """What a policy that sees by a camera is told of one hand.

    Args:
        sensed: What is known.
        points: What its camera sees [1, K, 3].
        fresh: Whether an episode begins [1]; not by default.
    """

    def row(values: np.ndarray) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32)[None]

    return Senses(
        joint_q=row(sensed.joint_q),
        joint_qd=row(sensed.joint_qd),
        action=row(sensed.smoothed),
        goal_quat=row(sensed.goal_quat),
        points=points,
        fresh=torch.zeros(1, dtype=torch.bool) if fresh is None else fresh,
    )
