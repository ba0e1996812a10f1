"""Hands that are stuck are nudged, in the environment."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.envs.cfg import ExploreCfg, NudgeCfg, RandomisationCfg, ReorientCfg
from vd.envs.nudges import Nudges
from vd.envs.reorient import ReorientEnv

SETTLE, WAIT = 30, 18
"""Control steps in which an object comes to rest, and more than a nudge takes to begin."""


def make(nudge: bool, explore: bool = False) -> ReorientEnv:
    """Worlds whose objects have come to rest 2.5 rad from their goals, and no nudge or noise yet."""
    cfg = ReorientCfg(
        hand="dclaw3",
        num_worlds=2,
        randomisation=RandomisationCfg(enabled=False),
        nudge=NudgeCfg(enabled=nudge),
        explore=ExploreCfg(enabled=explore),
    )
    env = ReorientEnv(cfg, "cpu")
    if env.nudges is not None:
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


def test_noise_moves_hands_from_the_first_step_on_while_the_goal_is_far():
    env = make(False, explore=True)
    assert not hold(env, 3).any(), "the predicted distance says that the goal is reached"
    env.nudges.forget()
    assert (hold(env, 3) > 0.05).all()
    env.nudges.predict(torch.full((2,), 0.1))
    hold(env, SETTLE)  # the average of the actions forgets
    assert np.abs(hold(env, 1)).max() < 1e-6
    env.check()


def test_a_nudge_takes_the_place_of_noise():
    """A nudge is one action for three steps; noise is another in every step."""
    task = ReorientCfg(nudge=NudgeCfg(enabled=True), explore=ExploreCfg(enabled=True))
    nudges = Nudges(task, 3, 1, "cpu")
    zero, far = wp.zeros((1, 3), dtype=float, device="cpu"), wp.full(1, 2.0, dtype=float, device="cpu")
    count, same = wp.full(1, 5, dtype=wp.int32, device="cpu"), wp.zeros(1, dtype=wp.int32, device="cpu")
    applied = np.array([nudges.action(zero, far, count, same).numpy()[0].copy() for _ in range(WAIT)])
    assert np.abs(applied).min(axis=1).all() and not zero.numpy().any()
    waits, lasts = (round(s * task.sim.control_hz) for s in (task.nudge.still_s, task.nudge.nudge_s))
    held = (np.diff(applied, axis=0) == 0.0).all(axis=1)
    expected = np.zeros(WAIT - 1, dtype=bool)
    for first in range(waits, WAIT, waits + lasts - 1):
        expected[first : first + lasts - 1] = True
    assert np.array_equal(held, expected), (held, expected)


def test_noise_of_no_size_is_refused():
    with pytest.raises(ValueError, match=r"explore\.action_std"):
        ReorientCfg(explore=ExploreCfg(enabled=True, action_std=0.0)).validate()
