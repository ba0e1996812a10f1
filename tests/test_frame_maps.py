"""Symmetry frames without a simulator are those of the environment."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.geometry.frame_maps import FrameMaps
from vd.kernels.task.observations import teacher_observation_slices

WORLDS = 48


@pytest.fixture(scope="module", params=[("dclaw4", "goal"), ("dclaw3", "mirrored")])
def env(request):
    """Worlds after some random steps, in frames that were chosen for where the objects are then."""
    made = ReorientEnv(
        ReorientCfg(
            hand=request.param[0],
            objects=("cuboid",),
            num_envs=WORLDS,
            randomisation=RandomisationCfg(enabled=False),
            observation=ObservationCfg(shape="full", view=request.param[1]),
        ),
        "cpu",
    )
    random = np.random.default_rng(0)
    for _ in range(5):
        made.step(
            wp.array(random.uniform(-1, 1, (WORLDS, made.num_actions)), dtype=float, device="cpu")
        )
    every = wp.ones(WORLDS, dtype=wp.int32, device="cpu")
    made.symmetry_frames.choose(every, every)
    made.observe()
    return made


@pytest.fixture
def maps(env):
    # Who is not asked.
    return FrameMaps(env.hand, replace(env.cfg.observation, dynamics="critic"), torch.device("cpu"))


def test_views_are_chosen_seen_and_acted_in_as_in_the_simulator(env, maps):
    world, view = wp.to_torch(env.world_observation), wp.to_torch(env.symmetry_frames.chosen).long()
    assert set(view.tolist()) == set(range(env.cfg.observation.num_frames(env.num_fingers))), (
        "all are tried"
    )
    assert torch.equal(maps.choose(world), view)
    torch.testing.assert_close(
        maps.take(world, view), wp.to_torch(env.observation), rtol=1e-5, atol=1e-6
    )
    action = torch.rand(WORLDS, env.num_actions)
    wanted = wp.to_torch(env.symmetry_frames.world_action(wp.from_torch(action)))
    torch.testing.assert_close(maps.world_action(action, view), wanted)


def test_a_rotation_by_more_than_half_a_turn_is_in_the_view_of_the_shorter_one(env, maps):
    observation = torch.zeros(50, env.num_observations)
    columns = teacher_observation_slices(env.num_fingers, env.num_actions)["relative_orientation"]
    observation[:, columns] = torch.from_numpy(
        Rotation.random(50, random_state=0).as_quat()
    ).float()
    assert torch.equal(maps.choose(observation), maps.choose(-observation))
