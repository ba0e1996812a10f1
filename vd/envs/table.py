"""Tables that are taken away during an episode, and environments in which they must not be touched."""

import numpy as np
import warp as wp

from vd.envs.cfg import ReorientCfg

ALWAYS = 2**31 - 1
"""Last step of a table that stays."""


def table_steps(cfg: ReorientCfg) -> np.ndarray:
    """Control steps for which each world's table stays, int32, shape [N].

    Which environments lose it, and when, is drawn once from the seed: an episode says nothing of it to the
    policy.
    """
    table, n = cfg.table, cfg.num_envs
    draw = np.random.default_rng(cfg.seed)
    away = draw.permutation(n) < round(table.away_share * n)
    steps = np.maximum(1, np.round(draw.uniform(*table.away_s, size=n) * cfg.sim.control_hz))
    return np.where(away, steps, ALWAYS).astype(np.int32)


def must_lift(cfg: ReorientCfg) -> np.ndarray:
    """1 where success asks that the object does not touch the table, int32, shape [N].

    Environments are chosen in the order of :func:`table_steps`: of two shares the smaller is a part of the
    larger.
    """
    n, share = cfg.num_envs, cfg.table.lift_share
    return (np.random.default_rng(cfg.seed).permutation(n) < round(share * n)).astype(np.int32)


def table_array(cfg: ReorientCfg, device: str) -> wp.array | None:
    """:func:`table_steps` on the device, or None where all tables stay."""
    if cfg.table.away_share == 0.0:
        return None
    return wp.array(table_steps(cfg), dtype=wp.int32, device=device)
