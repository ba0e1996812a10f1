"""Policies that aim past near goals, in the environment."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from vd.aim import AimCfg
from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.kernels.observations import teacher_observation_slices

AWAY_RAD = np.array([0.25, 1.5])
"""How far the goals of the two worlds are: one near, one not."""


def observed(aim: AimCfg) -> tuple[ReorientEnv, np.ndarray, np.ndarray]:
    """An environment, and how far its observation says that the goals are [rad], by both columns."""
    exact = RandomisationCfg(enabled=False, observation_noise_mean=0.0, observation_noise_std=0.0)
    cfg = ReorientCfg(
        hand="dclaw3",
        num_worlds=2,
        aim=aim,
        randomisation=exact,
        observation=ObservationCfg(shape="full", view="goal"),
    )
    env = ReorientEnv(cfg, "cpu")
    here = Rotation.from_quat(env.object_pose()[:, 3:7])
    turn = Rotation.from_rotvec(AWAY_RAD[:, None] * np.array([0.6, 0.0, 0.8]))
    env.goal_quat.assign((turn * here).as_quat().astype(np.float32))
    env.observe()
    seen, columns = env.observation.numpy(), teacher_observation_slices(env.num_fingers)
    left = Rotation.from_quat(seen[:, columns["relative_orientation"]]).magnitude()
    goal = Rotation.from_quat(seen[:, columns["goal_orientation"]])
    place = Rotation.from_quat(seen[:, columns["object_orientation"]])
    assert np.allclose((place * goal.inv()).magnitude(), left, atol=1e-3), "both columns say the same"
    return env, left, seen


def test_a_near_goal_is_observed_farther_than_it_is_and_counts_where_it_is():
    aim = AimCfg(enabled=True, past_rad=0.3, within_rad=0.5)
    env, left, seen = observed(aim)
    assert np.allclose(left, [0.55, 1.5], atol=2e-3)
    plain, exact, before = observed(AimCfg())
    assert np.allclose(exact, AWAY_RAD, atol=2e-3)
    assert np.allclose(seen[1], before[1], atol=1e-5), "what is far is as it was"
    assert not np.allclose(seen[0, -30:], before[0, -30:], atol=1e-4), "the shape at the goal moves along"
    for world in (env, plain):
        world.step(wp.zeros_like(world.action))
    assert np.allclose(env.rotation_error.numpy(), plain.rotation_error.numpy(), atol=1e-5)
    env.check()


def test_an_aim_of_no_size_is_refused():
    with pytest.raises(ValueError, match=r"aim\.past_rad"):
        ReorientCfg(aim=AimCfg(enabled=True, past_rad=0.0)).validate()
