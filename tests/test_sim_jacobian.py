"""A sparse Jacobian is a way to keep the same numbers: physics does not change with it."""

import numpy as np
import pytest
import warp as wp

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.sim.cfg import SimCfg

WORLDS, STEPS = 6, 6


def joints_of_a_closing_hand(device: str, hand: str, cfg: SimCfg) -> tuple[np.ndarray, float]:
    """Joints and object poses [STEPS, N, D + 7] while a hand closes, and contacts of a world at the end."""
    env = ReorientEnv(
        ReorientCfg(
            hand=hand,
            objects=("cube", "procedural-2-seed0"),
            num_envs=WORLDS,
            randomisation=RandomisationCfg(enabled=False),
            sim=cfg,
        ),
        device,
    )
    wp.to_torch(env.action).fill_(-0.7)
    path = []
    for _ in range(STEPS):
        env.step(env.action)
        path.append(env.sim.joint_q.numpy().copy())
    env.check()
    contacts = float(env.sim.solver.mjw_data.nacon.numpy()[0]) / WORLDS
    env.close()
    return np.array(path), contacts


@pytest.mark.parametrize("hand", ["dclaw3", "dclaw4"])
def test_sparse_and_dense_move_alike(device, hand):
    sparse, contacts = joints_of_a_closing_hand(device, hand, SimCfg(jacobian="sparse"))
    dense, _ = joints_of_a_closing_hand(device, hand, SimCfg(jacobian="dense"))
    assert contacts > 3.0
    difference = np.abs(sparse - dense).max(axis=2)
    # Sums are rounded in another order; a world in which an edge then slips a step sooner soon looks another.
    assert difference[0].max() < 1e-4
    assert np.median(difference[-1]) < 1e-3
