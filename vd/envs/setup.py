"""What is chosen once, when environments are built.

Sizes of objects, tables that leave, starts at rest.
"""

from typing import Any

import numpy as np
import warp as wp

from vd.envs.cfg import RandomisationCfg, ReorientCfg

ALWAYS = 2**31 - 1
"""Last step of a table that stays."""
SETTLE_S = 1.5
"""Time an object has to come to rest after a drop [s]; some slim ones still rock then."""


def object_scales(random: RandomisationCfg) -> list[float]:
    """Size factors of the objects; 1 alone where nothing is randomised."""
    if not random.enabled:
        return [1.0]
    return [float(scale) for scale in np.linspace(*random.object_scale, random.object_scale_count)]


def table_steps(cfg: ReorientCfg, air: float) -> np.ndarray:
    """Control steps for which each environment's table stays, int32, shape [N].

    ``air`` is the level of the curriculum: what part of ``away_share`` loses its table.

    Which environments lose it, and when, is drawn once from the seed: an episode says nothing of it
    to the policy.
    """
    table, n = cfg.table, cfg.num_envs
    draw = np.random.default_rng(cfg.seed)
    away = draw.permutation(n) < round(air * table.away_share * n)
    steps = np.maximum(1, np.round(draw.uniform(*table.away_s, size=n) * cfg.sim.control_hz))
    return np.where(away, steps, ALWAYS).astype(np.int32)


def chosen(cfg: ReorientCfg, share: float) -> np.ndarray:
    """1 in a share of the environments, int32, shape [N].

    They are chosen in the order of :func:`table_steps`: of two shares the smaller is a part of the
    larger.
    """
    n = cfg.num_envs
    return (np.random.default_rng(cfg.seed).permutation(n) < round(share * n)).astype(np.int32)


def rest_poses(env: Any) -> np.ndarray:
    """Drop every object of a ReorientEnv a few times.

    Where they came to lie, float, shape [N, K, 7].

    A drop that left the claw is replaced by one of the same environment that did not, or, if all
    did, by the start. Each is a position [m] and a quaternion xyzw.
    """
    workspace, dropped = env.hand.workspace, []
    for _ in range(env.cfg.start.poses):
        env.reset()
        for _ in range(round(SETTLE_S * env.cfg.sim.control_hz)):
            wp.copy(env.sim.target, env.sim.joint_q)
            env.sim.step()
        if env.cfg.failures_per_million > 0.0:  # what failed lies nowhere
            env.sim.failures.zero_()
        env.check()
        dropped.append(env.object_pose())
    landed = np.stack(dropped, axis=1)
    inside = np.linalg.norm(landed[:, :, :3] - workspace.goal_m, axis=2) < env.cfg.success.fall_of(
        workspace
    )
    # Choose, for every slot, the slot itself or the first good one of the world.
    slot = np.where(inside, np.arange(len(dropped)), np.argmax(inside, axis=1)[:, None])
    poses = np.take_along_axis(landed, slot[:, :, None], axis=1)
    poses[~inside.any(axis=1)] = [*workspace.drop_m, 0.0, 0.0, 0.0, 1.0]
    return poses
