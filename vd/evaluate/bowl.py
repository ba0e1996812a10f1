"""Whether a hand whose palm looks up starts as a bowl: what falls into it stays."""

from pathlib import Path

import numpy as np
import warp as wp

from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.conditions import CONDITIONS
from vd.paper import PAPER
from vd.sim.cfg import MANY_COLLIDERS, in_mujoco

CUBES = 60
"""Our choice: a share of 9 in 10 has a standard error of 4 %."""
STAY_S = 5.0
"""Time that a cube has to stay [s] (ours)."""


def share_kept(hand: Path) -> float:
    """Share of cubes that stay in a hand while nobody acts.

    The task's own starts, drives and sizes of condition ``sizes``, in MuJoCo's engine at the task's
    rate: on a CPU it is four times as fast as Newton, and loses the same cubes.

    Args:
        hand: Its USD.
    """
    cfg = ReorientCfg(
        hand=str(hand),
        num_envs=CUBES,
        failures_per_million=20.0,  # a step that fails ends its episode
        sim=in_mujoco(MANY_COLLIDERS, PAPER.scene.physics_hz),
        randomisation=CONDITIONS["sizes"],
    )
    env = ReorientEnv(cfg, "cpu")
    steps = round(STAY_S * cfg.sim.control_hz)
    action = wp.zeros_like(env.action)
    for _ in range(steps):
        env.step(action)
    return float(np.mean(env.step_count.numpy() == steps))
