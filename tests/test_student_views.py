"""A student's head sees and acts in its teacher's views as the simulator does; labels are of each view."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.envs.view_tables import ViewTables, view_tables
from vd.kernels.task.observations import teacher_observation_slices
from vd.policy import PolicySpec, TrainedPolicy, perceptron
from vd.train.student.every_view import EveryView
from vd.views import ViewMaps
from vd.vision.state import UNSEEN, StateHead, state_cfg

WORLDS, WIDTH = 48, 8


@pytest.fixture(scope="module", params=[("dclaw3", "goal"), ("dclaw4", "goal"), ("dclaw3", "mirrored")])
def env(request):
    """Environments after some random steps, in views that were chosen for where the objects are then."""
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
        made.step(wp.array(random.uniform(-1, 1, (WORLDS, made.num_actions)), dtype=float, device="cpu"))
    every = wp.ones(WORLDS, dtype=wp.int32, device="cpu")
    made.views.choose(every, every)
    made.observe()
    return made


def views_of(env: ReorientEnv) -> int:
    return env.cfg.observation.views(env.num_fingers)


def tables_of(env: ReorientEnv) -> ViewTables:
    return view_tables(env.hand, env.cfg.observation, env.cfg.observation.view)


def teacher_of(env: ReorientEnv) -> TrainedPolicy:
    torch.manual_seed(0)
    spec = PolicySpec(env.num_observations, env.num_actions, (16, 8), "elu", "gaussian", True)
    weights = {f"mlp.{name}": value for name, value in perceptron(spec).state_dict().items()}
    weights["obs_normalizer._mean"] = torch.randn(1, env.num_observations)
    weights["obs_normalizer._std"] = 0.5 + torch.rand(1, env.num_observations)
    return TrainedPolicy(spec, weights, task={})


def head_of(env: ReorientEnv, policy: TrainedPolicy) -> StateHead:
    head = StateHead(state_cfg(policy.spec, views=views_of(env)), WIDTH, env.num_actions)
    assert head.adopt(policy.network, tables_of(env)), "random layers before"
    return head


def with_the_unseen_at_its_mean(env: ReorientEnv, policy: TrainedPolicy, seen: torch.Tensor) -> torch.Tensor:
    """Observations in the views as the head is to show them to the teacher, which it can know."""
    columns, seen = teacher_observation_slices(env.num_fingers), seen.clone()
    turn = seen[:, columns["relative_orientation"]]
    seen[:, columns["relative_orientation"]] = turn * turn[:, 3:].sign()
    for name in UNSEEN:
        seen[:, columns[name]] = policy.network.offset[:, columns[name]]
    return seen


def test_at_a_true_estimate_the_head_acts_as_the_teacher_in_the_simulators_view(env):
    policy = teacher_of(env)
    head, view = head_of(env, policy), wp.to_torch(env.views.view)
    assert set(view.tolist()) == set(range(views_of(env))), "every view is tried"
    world, seen = wp.to_torch(env.world_observation), wp.to_torch(env.observation)
    action, chosen = head.act(head.target(world))
    assert torch.equal(chosen, view.long())
    told = with_the_unseen_at_its_mean(env, policy, seen)
    wanted = env.views.world_action(wp.from_torch(policy.act(told).contiguous()))
    torch.testing.assert_close(action, wp.to_torch(wanted), rtol=1e-4, atol=1e-4)
    # in the world as it is the teacher would do something else
    assert (policy.act(world) - action)[view > 0].abs().max() > 0.1


def test_asking_for_the_maps_moves_nothing(env):
    before = env.sim.joint_q.numpy().copy(), env.sim.body_q.numpy().copy()
    assert np.abs(before[0][:, : env.num_actions]).min(axis=1).max() > 0.0, "fingers are bent"
    tables_of(env)
    np.testing.assert_array_equal(env.sim.joint_q.numpy(), before[0])
    np.testing.assert_allclose(env.sim.body_q.numpy(), before[1], atol=1e-6)


def test_maps_are_those_of_the_simulator(env):
    maps = ViewMaps(views_of(env), env.num_observations, env.num_actions)
    maps.adopt(tables_of(env))
    view = wp.to_torch(env.views.view).long()
    seen = maps.take(wp.to_torch(env.world_observation), view)
    torch.testing.assert_close(seen, wp.to_torch(env.observation), rtol=1e-5, atol=1e-6)


def test_the_label_of_each_view_is_the_teachers_action_in_it(env):
    policy = teacher_of(env)
    head, world = head_of(env, policy), wp.to_torch(env.world_observation)
    labels = EveryView(policy, head.views).act(world)
    assert labels.shape == (WORLDS, views_of(env), env.num_actions)
    own = env.views.world_action(wp.from_torch(policy.act(wp.to_torch(env.observation)).contiguous()))
    picked = labels[torch.arange(WORLDS), wp.to_torch(env.views.view).long()]
    torch.testing.assert_close(picked, wp.to_torch(own), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(labels[:, 0], policy.act(world), rtol=1e-4, atol=1e-4)
    assert (labels[:, 1] - labels[:, 0]).abs().max() > 0.1


def test_an_estimate_is_normalised_in_the_world_as_the_teachers_views_would_have_it(env):
    """Draws of a view, put back into the world from a view at random, have mean 0 and deviation 1."""
    policy = teacher_of(env)
    head = head_of(env, policy)
    tables, random = tables_of(env), torch.Generator().manual_seed(1)
    count, values = 30_000, env.num_observations
    offset, scale = policy.network.offset, policy.network.scale
    seen = offset + scale * torch.randn((count, values), generator=random)
    maps = np.zeros((views_of(env), values, values))
    for view in range(views_of(env)):
        for row in range(values):
            for column, factor in zip(tables.source[view, row], tables.factor[view, row], strict=True):
                maps[view, row, column] += factor
        np.testing.assert_allclose(maps[view] @ maps[view].T, np.eye(values), atol=1e-6)
    view = torch.randint(views_of(env), (count,), generator=random)
    back = torch.empty_like(seen)
    offsets = torch.from_numpy(tables.offset).float()
    for one, turn in enumerate(torch.from_numpy(maps).float()):  # back is its inverse, the transpose
        back[view == one] = (seen[view == one] - offsets[one]) @ turn
    world = (back - head.offset) / head.scale
    assert world.mean(dim=0).abs().max() < 0.03
    assert (world.std(dim=0) - 1.0).abs().max() < 0.03


def test_a_rotation_by_more_than_half_a_turn_is_in_the_view_of_the_shorter_one(env):
    maps = ViewMaps(views_of(env), env.num_observations, env.num_actions)
    maps.adopt(tables_of(env))
    observation = torch.zeros(50, env.num_observations)
    columns = teacher_observation_slices(env.num_fingers)["relative_orientation"]
    observation[:, columns] = torch.from_numpy(Rotation.random(50, random_state=0).as_quat()).float()
    assert torch.equal(maps.choose(observation), maps.choose(-observation))


def test_the_same_teacher_again_keeps_the_fitted_estimate_and_another_does_not(env):
    policy = teacher_of(env)
    head = head_of(env, policy)
    head.fit(torch.randn(200, WIDTH), torch.randn(200, env.num_observations))
    assert not head.adopt(policy.network, tables_of(env)) and head.fitted
    weights = dict(policy.weights) | {"mlp.0.bias": policy.weights["mlp.0.bias"] + 1.0}
    assert head.adopt(TrainedPolicy(policy.spec, weights, task={}).network, tables_of(env))
    assert not head.fitted
