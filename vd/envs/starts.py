"""Poses in which an object lies at rest on the table, found by dropping it."""

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

SETTLE_S = 1.5
"""Time an object has to come to rest after a drop [s]; some slim ones still rock then."""


def find_rest_poses(env: "ReorientEnv") -> wp.array:
    """Drop every object a few times and keep where it came to lie, shape [N, K].

    A drop that leaves the claw is replaced by one that did not.
    """
    count = env.cfg.start.poses
    poses = np.zeros((env.num_worlds, count, 7), dtype=np.float32)
    inside = np.zeros((env.num_worlds, count), dtype=bool)
    for k in range(count):
        env.reset()
        for _ in range(round(SETTLE_S * env.cfg.sim.control_hz)):
            wp.copy(env.sim.target, env.sim.joint_q)
            env.sim.step()
        env.check()
        poses[:, k] = env.object_pose()
        distance = np.linalg.norm(poses[:, k, :3] - PAPER.scene.goal_position_m, axis=1)
        inside[:, k] = distance < env.cfg.success.fall_m
    # Choose, for every slot, the slot itself or the first good one of the world.
    slot = np.where(inside, np.arange(count), np.argmax(inside, axis=1)[:, None])
    poses = np.take_along_axis(poses, slot[:, :, None], axis=1)
    lost = ~inside.any(axis=1)
    poses[lost] = [*PAPER.scene.object_start_m, 0.0, 0.0, 0.0, 1.0]
    return wp.array(poses, dtype=wp.transform, device=env.device)
