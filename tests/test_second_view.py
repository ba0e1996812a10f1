"""A teacher's second view: what there is to choose from, when it is chosen, and by what."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate import cli
from vd.evaluate.second_view import SecondView, view_maps
from vd.kernels.task.observations import teacher_observation_slices
from vd.policy import PolicySpec, TrainedPolicy, perceptron
from vd.tracking.views import AFTER_S, EVERY_S, ViewSelection
from vd.train.vec_env import ReorientVecEnv

WORLDS = 8
CFG = ReorientCfg(
    hand="dclaw3",
    objects=("cuboid",),
    num_envs=WORLDS,
    randomisation=RandomisationCfg(enabled=False),
    observation=ObservationCfg(shape="full", view="either"),
)


@pytest.fixture(scope="module", params=["dclaw3 either", "dclaw4 either", "dclaw3 mirrored"])
def env(request):
    hand, view = request.param.split()
    return ReorientEnv(replace(CFG, hand=hand, observation=replace(CFG.observation, view=view)), "cpu")


def as_goal(env: ReorientEnv) -> ReorientEnv:
    """The same without a second view."""
    return ReorientEnv(replace(env.cfg, observation=replace(CFG.observation, view="goal")), "cpu")


def weights_of(spec: PolicySpec) -> dict[str, torch.Tensor]:
    weights = {f"mlp.{name}": value for name, value in perceptron(spec).state_dict().items()}
    weights["obs_normalizer._mean"] = torch.randn(1, spec.num_observations)
    weights["obs_normalizer._std"] = 0.5 + torch.rand(1, spec.num_observations)
    return weights


def teacher_of(env: ReorientEnv) -> TrainedPolicy:
    torch.manual_seed(1)
    spec = PolicySpec(env.num_observations, env.num_actions, (16, 8), "elu", "state-dependent", True)
    critic = weights_of(replace(spec, num_actions=1, distribution="gaussian"))
    return TrainedPolicy(spec, weights_of(spec), task={}, critic=critic)


def begin(env: ReorientEnv, seed: int = 0) -> None:
    """All environments at a first step, with their goals far away."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(2, WORLDS, 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    env.reset(object_quat=quats[0], goal_quat=quats[1])


def steps_with_new_views(env: ReorientEnv, actor: SecondView, steps: int, far: bool = True) -> dict:
    """Steps, counted from the reset, at which views were chosen: what was shown and chosen there."""
    error = wp.to_torch(env.rotation_error)
    still, chosen, now = torch.zeros(WORLDS, env.num_actions), {}, [0]
    better = actor._selection.better

    def watched(world: torch.Tensor, value: Callable) -> torch.Tensor:
        chosen[now[0]] = world.clone(), better(world, value)
        return chosen[now[0]][1]

    actor._selection.better = watched
    for now[0] in range(steps):
        error.fill_(2.0 if far else 0.1)
        actor.act(wp.to_torch(env.observation))
        env.step(wp.from_torch(still, dtype=wp.float32))
    actor._selection.better = better
    return chosen


def test_the_environment_chooses_the_views_of_goal_and_shows_the_same(env):
    if env.cfg.observation.view == "mirrored":
        pytest.skip("which views it chooses is asked in test_envs_symmetry.py")
    begin(env)
    other = as_goal(env)
    begin(other)
    assert len(env.views.tables.sector) == {"dclaw3": 6, "dclaw4": 4}[env.cfg.hand], "mirror images: dclaw3"
    np.testing.assert_array_equal(env.views.view.numpy(), other.views.view.numpy())
    np.testing.assert_allclose(env.observation.numpy(), other.observation.numpy(), atol=1e-5)
    other.close()


def test_views_are_chosen_after_a_while_and_then_at_intervals_for_goals_that_are_far(env):
    actor = SecondView(env, teacher_of(env))
    after, every = (round(seconds * env.cfg.sim.control_hz) for seconds in (AFTER_S, EVERY_S))
    begin(env)
    assert list(steps_with_new_views(env, actor, after + every + 2)) == [after, after + every]
    begin(env, seed=1)  # in the middle of an interval: it is counted anew
    assert list(steps_with_new_views(env, actor, after + 1)) == [after]
    begin(env, seed=2)
    assert not steps_with_new_views(env, SecondView(env, teacher_of(env)), after + 1, far=False)


def test_a_new_goal_is_looked_at_anew(env):
    actor = SecondView(env, teacher_of(env))
    after = round(AFTER_S * env.cfg.sim.control_hz)
    begin(env)
    steps_with_new_views(env, actor, after - 1)
    wp.to_torch(env.goal_steps)[0] = 0
    ((world, view),) = steps_with_new_views(env, actor, 3).values()
    assert len(world) == len(view) == WORLDS - 1


def test_it_takes_the_view_of_which_the_critic_expects_more(env):
    policy = teacher_of(env)
    actor, after = SecondView(env, policy), round(AFTER_S * env.cfg.sim.control_hz)
    taken, fingers = set(), env.num_fingers
    for seed in range(3):
        begin(env, seed)
        chosen = steps_with_new_views(env, actor, after + 1)[after]
        world, view = chosen[0].numpy().astype(np.float64), chosen[1].numpy()
        np.testing.assert_array_equal(env.views.view.numpy(), view)
        tables = env.views.tables
        turn = world[:, teacher_observation_slices(fingers)["relative_orientation"]]
        axis = np.where(turn[:, 3:] < 0.0, turn[:, :3], -turn[:, :3])
        for row in range(len(world)):
            near = (tables.sector @ axis[row]).reshape(-1, fingers).argmax(axis=1)
            own = int(near[0])
            near = [own, int(near[1]) + fingers] if len(near) == 2 else range(fingers)
            seen = [
                (tables.factor[k] * world[row][tables.source[k]]).sum(axis=1) + tables.offset[k] for k in near
            ]
            values = [expected(policy, one) for one in seen]
            assert view[row] == near[int(np.argmax(values))]
            taken.add(view[row] == own)
    assert taken == {True, False}, "that in whose sector the goal lies, and others"


def expected(policy: TrainedPolicy, observation: np.ndarray) -> float:
    """The critic, with NumPy."""
    w = {name: value.numpy().astype(np.float64) for name, value in policy._critic.items()}
    x = (observation - w["obs_normalizer._mean"][0]) / (w["obs_normalizer._std"][0] + 1e-2)
    for layer in (0, 2):
        x = w[f"mlp.{layer}.weight"] @ x + w[f"mlp.{layer}.bias"]
        x = np.where(x > 0.0, x, np.expm1(x))
    return float((w["mlp.4.weight"] @ x + w["mlp.4.bias"])[0])


def test_actions_are_the_policys_in_the_view_that_was_taken(env):
    policy = teacher_of(env)
    actor, after = SecondView(env, policy), round(AFTER_S * env.cfg.sim.control_hz)
    begin(env)
    steps_with_new_views(env, actor, after)
    wp.to_torch(env.rotation_error).fill_(2.0)
    before = env.views.view.numpy().copy()
    action = actor.act(wp.to_torch(env.observation))
    assert (env.views.view.numpy() != before).any()
    env.observe()
    torch.testing.assert_close(action, policy.act(wp.to_torch(env.observation)))


def test_a_training_draws_one_of_these_views(env):
    after = round(AFTER_S * env.cfg.sim.control_hz)
    still, drawn = torch.zeros(WORLDS, env.num_actions), set()
    torch.manual_seed(0)
    for seed in range(2):
        begin(env, seed)
        learner, first = ReorientVecEnv(env, second_view=True), env.views.view.numpy().copy()
        for _ in range(after - 1):
            learner.step(still)
        np.testing.assert_array_equal(env.views.view.numpy(), first)
        wp.to_torch(env.goal_steps)[0] = 0  # has come to a goal, and is not due
        observed = learner.step(still)[0]["policy"]
        view, others = env.views.view.numpy(), ViewSelection(view_maps(env), env.cfg.sim.control_hz)
        assert view[0] == first[0]
        world = wp.to_torch(env.world_observation)
        offered = others.of(world).numpy()
        assert all(view[row] in offered[:, row] for row in range(1, WORLDS))
        drawn |= {int(np.flatnonzero(offered[:, row] == view[row])[0]) for row in range(1, WORLDS)}
        taken = others.maps.take(world, torch.tensor(view))
        torch.testing.assert_close(observed, taken, atol=1e-5, rtol=1e-5)
    assert drawn == set(range(len(offered))), "each of them"


def test_a_policy_without_a_critic_or_an_environment_of_one_view_is_refused(env):
    policy = teacher_of(env)
    with pytest.raises(ValueError, match="no critic; export it again"):
        SecondView(env, TrainedPolicy(policy.spec, policy.weights, task={}))
    other = as_goal(env)
    with pytest.raises(ValueError, match=r"observation\.view is goal"):
        SecondView(other, policy)
    other.close()


def test_the_command_refuses_policies_that_have_no_second_view(tmp_path, capsys):
    assert cli.main(["dclaw4-cube", "--second-view", "--device", "cpu", "--out", str(tmp_path)]) == 1
    assert "dclaw4-cube has no other view" in capsys.readouterr().err


def test_a_training_has_its_views_from_the_task_and_looks_twice_by_its_own_flag(tmp_path, capsys):
    from vd.train.cli import main as train

    flags = ["--preset", "cpu-demo", "--out", str(tmp_path / "run"), "--device", "cpu"]
    assert train(["teacher", *flags, "--env.observation.view", "either"]) == 1
    assert "train with goal" in capsys.readouterr().err
    assert train(["teacher", *flags, "--env.observation.view", "world", "--second-view"]) == 1
    assert "observation.view world" in capsys.readouterr().err


def test_an_evaluation_says_that_it_selected_views(tmp_path):
    arguments = ["dclaw3-table", "--objects", "cuboid", "--episodes", "2", "--device", "cpu", "--second-view"]
    assert cli.main([*arguments, "--episode-s", "0.5", "--out", str(tmp_path)]) == 0
    assert "symmetry-view selection" in (tmp_path / "eval.html").read_text()
    both = tmp_path / "both"
    assert cli.main([*arguments, "--agent", "zero", "--episode-s", "0.5", "--out", str(both)]) == 0
    assert "symmetry-view selection" in (both / "eval.html").read_text()
