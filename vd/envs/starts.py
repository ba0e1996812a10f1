"""Poses in which an object lies at rest on the table, found by dropping it."""

import numpy as np

from vd.paper import PAPER

SETTLE_S = 1.5
"""Time an object has to come to rest after a drop [s]; some slim ones still rock then."""


def rest_poses(dropped: np.ndarray, fall_m: float) -> np.ndarray:
    """Where the objects came to lie, of those drops that stayed in the claw, float, shape [N, K, 7].

    A drop that left it is replaced by one of the same world that did not, or, if all did, by the start.

    Args:
        dropped: Poses after K drops, position [m] and quaternion xyzw, shape [N, K, 7].
        fall_m: Distance from the goal position at which an object counts as lost [m].
    """
    count = dropped.shape[1]
    inside = np.linalg.norm(dropped[:, :, :3] - PAPER.scene.goal_position_m, axis=2) < fall_m
    # Choose, for every slot, the slot itself or the first good one of the world.
    slot = np.where(inside, np.arange(count), np.argmax(inside, axis=1)[:, None])
    poses = np.take_along_axis(dropped, slot[:, :, None], axis=1)
    poses[~inside.any(axis=1)] = [*PAPER.scene.object_start_m, 0.0, 0.0, 0.0, 1.0]
    return poses
