"""Hands that are stuck open and try again, in the environment."""

import numpy as np
import pytest
import torch
import warp as wp

from vd.envs.cfg import GoalCfg, RandomisationCfg, ReorientCfg, RetryCfg
from vd.envs.reorient import ReorientEnv
from vd.paper import PAPER

BENT, SECOND = 6, 12
"""Control steps in which the fingers bend, and of a second."""
OPEN = np.tile(PAPER.scene.reset_joint_rad, 3)


def bend_and_hold(env: ReorientEnv, steps: int) -> np.ndarray:
    """Bend all fingers away from the open hand, then nothing; joint positions, [steps, N, D]."""
    found = []
    for step in range(steps):
        action = np.zeros((env.num_worlds, env.num_actions), dtype=np.float32)
        action[:, 2::3] = 1.0 if step < BENT else 0.0
        env.action.assign(action)
        env.step(env.action)
        found.append(env.measured_q.numpy()[:, : env.num_actions].copy())
    return np.array(found)


def make(retry: bool) -> ReorientEnv:
    return ReorientEnv(
        ReorientCfg(
            hand="dclaw3",
            num_worlds=2,
            randomisation=RandomisationCfg(enabled=False),
            retry=RetryCfg(enabled=retry),
        ),
        "cpu",
    )


def far_from_open(q: np.ndarray) -> np.ndarray:
    """Largest distance of a joint from the open hand [rad], shape [N]."""
    return np.abs(q - OPEN).max(axis=-1)


def turn_goals(env: ReorientEnv, angle: float) -> None:
    """Put every goal at an angle [rad] from where the object is, about the vertical."""
    from scipy.spatial.transform import Rotation

    here = Rotation.from_quat(env.object_pose()[:, 3:7])
    goal = (Rotation.from_rotvec([0.0, 0.0, angle]) * here).as_quat().astype(np.float32)
    env.goal_quat.assign(goal)


@pytest.fixture(scope="module")
def stuck() -> dict[bool, np.ndarray]:
    """How far each hand is from open, [steps, N], with retries and without."""
    found = {}
    for retry in (False, True):
        env = make(retry)
        turn_goals(env, 2.5)
        found[retry] = far_from_open(bend_and_hold(env, BENT + 3 * SECOND))
        env.check()
    return found


def test_without_retries_a_hand_that_is_told_nothing_stays(stuck):
    assert (stuck[False][-1] > 0.3).all()


def test_a_hand_that_is_stuck_far_from_the_goal_opens(stuck):
    waits = SECOND - 1
    assert np.allclose(stuck[True][:waits], stuck[False][:waits]), "nothing opens within the first second"
    assert (stuck[True].min(axis=0) < 0.1).all()


def test_a_prediction_of_being_there_keeps_the_hand_closed():
    env = make(True)
    turn_goals(env, 2.5)
    env.retries.predict(torch.zeros(2))
    assert (far_from_open(bend_and_hold(env, BENT + 3 * SECOND))[-1] > 0.3).all()
    env.retries.forget()
    zero = wp.zeros_like(env.action)
    for _ in range(3 * SECOND):
        env.step(zero)
    assert (far_from_open(env.measured_q.numpy()[:, : env.num_actions]) < 0.3).all()


def test_a_saved_environment_goes_on_opening():
    """Saved in the middle of the wait: the copy opens in the same step."""
    env, other = make(True), make(True)
    turn_goals(env, 2.5)
    bend_and_hold(env, BENT + 5)
    other.load_state_dict(env.state_dict())
    zero = wp.zeros_like(env.action)
    for _ in range(SECOND):
        env.step(zero)
        other.step(zero)
        assert np.allclose(env.measured_q.numpy(), other.measured_q.numpy(), atol=1e-6)


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ValueError, match=r"retry\.patience_s"):
        ReorientCfg(retry=RetryCfg(enabled=True, patience_s=0.0), goal=GoalCfg()).validate()
