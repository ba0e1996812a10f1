"""What is chosen once, when environments are built.

Sizes of objects, tables that leave.
"""

import numpy as np

from vd.envs.cfg import RandomisationCfg, ReorientCfg

ALWAYS = 2**31 - 1
"""Last step of a table that stays."""


def object_scales(
    random: RandomisationCfg, longest_side_m: float, hand_sizes_m: tuple[float, float]
) -> list[float]:
    """Size factors of an object; 1 alone where nothing is randomised.

    Args:
        random: What is drawn.
        longest_side_m: Of the object [m].
        hand_sizes_m: Smallest and largest longest side of the hand's objects [m].
    """
    if not random.enabled:
        return [1.0]
    if random.object_sizes:
        sizes = np.linspace(*hand_sizes_m, random.object_sizes)
        return (sizes / longest_side_m).tolist()
    return np.linspace(*random.object_scale, random.object_scale_count).tolist()


def table_steps(cfg: ReorientCfg, air: float) -> np.ndarray:
    """Control steps for which each environment's table stays, int32, shape [N].

    ``air`` is the level of the curriculum: what part of ``away_share`` loses its table.

    Which environments lose it, and when, is drawn once from the seed: an episode says nothing of it
    to the policy.
    """
    table = cfg.table
    n = cfg.num_envs
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
