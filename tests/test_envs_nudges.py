"""Hands that are stuck are nudged, in the environment."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.envs.cfg import NudgeCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv

SETTLE, WAIT = 30, 18
"""Control steps in which an object comes to rest, and more than a nudge takes to begin."""


def make(nudge: bool) -> ReorientEnv:
    """Worlds whose objects have come to rest 2.5 rad from their goals, and no nudge yet."""
    cfg = ReorientCfg(
        hand="dclaw3",
        num_worlds=2,
        randomisation=RandomisationCfg(enabled=False),
        nudge=NudgeCfg(enabled=nudge),
    )
    env = ReorientEnv(cfg, "cpu")
    if nudge:
        env.nudges.predict(torch.zeros(2))
    hold(env, SETTLE)
    here = Rotation.from_quat(env.object_pose()[:, 3:7])
    env.goal_quat.assign((Rotation.from_rotvec([0.0, 0.0, 2.5]) * here).as_quat().astype(np.float32))
    return env


def hold(env: ReorientEnv, steps: int) -> np.ndarray:
    """Do nothing; the norm of the smoothed action in every step, [steps, N]."""
    zero = wp.zeros_like(env.action)
    found = []
    for _ in range(steps):
        env.step(zero)
        found.append(np.linalg.norm(env.smoothed.numpy(), axis=1))
    return np.array(found)


def test_a_hand_is_moved_once_its_object_has_stood_still():
    env = make(True)
    env.nudges.forget()
    moved = hold(env, WAIT) > 0.05
    assert moved.any(axis=0).all()
    half_a_second = round(0.5 * env.cfg.sim.control_hz)
    assert not moved[: half_a_second - 1].any()
    env.check()


def test_without_nudges_and_near_the_goal_nothing_moves():
    """Near the goal by what a student predicts, whatever the truth."""
    assert not hold(make(False), WAIT).any()
    assert not hold(make(True), WAIT).any()


def test_a_saved_environment_is_nudged_alike():
    """Saved in the middle of the wait: the copy is nudged in the same step, and by the same action."""
    env, other = make(True), make(True)
    env.nudges.forget()
    hold(env, 3)
    other.load_state_dict(env.state_dict())
    ours, theirs = hold(env, WAIT), hold(other, WAIT)
    assert ours.any() and np.allclose(ours, theirs, atol=1e-6)


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ValueError, match=r"nudge\.still_s"):
        ReorientCfg(nudge=NudgeCfg(enabled=True, still_s=0.0)).validate()
