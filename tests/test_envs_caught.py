"""Goals that are pursued for long: their time is counted and seen, and caught worlds may go on."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from vd.envs.cfg import CaughtCfg, ObservationCfg, RandomisationCfg, ReorientCfg, SuccessCfg, TableCfg
from vd.envs.reorient import ReorientEnv
from vd.kernels.observations import GOAL_TIME_UNIT_S

WORLDS = 4
LOOSE = SuccessCfg(
    rotation_rad=0.4,
    joint_speed_rad_s=0.0,
    object_speed_m_s=0.0,
    object_spin_rad_s=0.0,
    action_norm=0.0,
    fall_m=1.0,
)
CFG = ReorientCfg(
    hand="dclaw3",
    objects=("cuboid",),
    num_worlds=WORLDS,
    randomisation=RandomisationCfg(enabled=False),
    observation=ObservationCfg(shape="full", view="either", goal_time=True),
    success=LOOSE,
)


def make(device: str = "cpu", **changes) -> ReorientEnv:
    return ReorientEnv(dataclasses.replace(CFG, **changes), device)


def begin(env: ReorientEnv) -> None:
    """All goals are half a turn away, about the vertical: a hand that does nothing reaches none."""
    start = np.tile([0.0, 0.0, 0.0, 1.0], (env.num_worlds, 1))
    env.reset(object_quat=start, goal_quat=np.tile([0.0, 0.0, 1.0, 0.0], (env.num_worlds, 1)))


def rest(env: ReorientEnv, steps: int) -> None:
    env.action.zero_()
    for _ in range(steps):
        env.step(env.action)


def arrive(env: ReorientEnv, world: int) -> None:
    """Let a world's goal be where its object is."""
    goals = env.goal_quat.numpy()
    goals[world] = env.object_pose()[world, 3:]
    env.goal_quat.assign(goals)


def test_the_time_of_a_goal_is_seen_last_and_in_all_views(device):
    env, without = (
        make(device),
        make(device, observation=dataclasses.replace(CFG.observation, goal_time=False)),
    )
    assert env.num_observations == without.num_observations + 1
    for each in (env, without):
        begin(each)
        rest(each, 5)
    arrive(env, 1)
    rest(env, 1)
    rest(without, 1)
    assert env.success.numpy().tolist() == [0, 1, 0, 0]
    np.testing.assert_array_equal(env.goal_steps.numpy(), [6, 0, 6, 6])
    wanted = env.goal_steps.numpy() / (env.cfg.sim.control_hz * GOAL_TIME_UNIT_S)
    for view in range(len(env.views.tables.sector)):
        env.views.view.fill_(view)
        env.observe()
        np.testing.assert_allclose(env.observation.numpy()[:, -1], wanted, rtol=1e-6)
        without.views.view.fill_(view)
        without.observe()
        before = np.delete(env.observation.numpy()[:, :-1], 1, axis=0)
        np.testing.assert_array_equal(before, np.delete(without.observation.numpy(), 1, axis=0))


def test_time_out_gives_a_new_goal_its_time():
    env = make(episode_s=0.5)
    begin(env)
    rest(env, 5)
    assert (env.goal_steps.numpy() == 5).all()
    rest(env, 1)
    assert env.timed_out.numpy().all() and not env.goal_steps.numpy().any()


def test_caught_worlds_go_on_as_they_are_with_the_time_of_another_episode():
    on = make(episode_s=1.0, caught=CaughtCfg(after_s=0.5, go_on_share=0.999))
    begin(on)
    rest(on, 11)
    before = on.object_pose()
    arrive(on, 2)
    rest(on, 1)
    # One has come to its goal in the last step, which ends its episode; the others are caught.
    assert on.success.numpy().tolist() == on.done.numpy().tolist() == [0, 0, 1, 0]
    assert not on.timed_out.numpy().any()
    assert on.step_count.numpy().tolist() == [0, 0, 0, 0]
    assert on.goal_steps.numpy().tolist() == [12, 12, 0, 12], "their goals stay"
    moved = np.linalg.norm(on.object_pose()[:, :3] - before[:, :3], axis=1)
    assert np.delete(moved, 2).max() < 0.02 < moved[2], "only that one is dropped anew"
    rest(on, 11)
    assert not on.done.numpy().any(), "another whole episode"
    young = make(episode_s=1.0, caught=CaughtCfg(after_s=1.5, go_on_share=0.999))
    begin(young)
    rest(young, 12)
    assert young.timed_out.numpy().all(), "goals that are not that old are not caught"


def test_a_step_that_failed_ends_its_episode_also_where_it_was_caught():
    env = make(episode_s=5.0, failures_per_million=1e5, caught=CaughtCfg(after_s=0.25, go_on_share=0.999))
    begin(env)
    rest(env, 6)
    env.sim.joint_qd.numpy()[1, 0] = np.nan
    rest(env, 1)
    assert env.timed_out.numpy().tolist() == [0, 1, 0, 0] and env.step_count.numpy()[1] == 0
    assert env.goal_steps.numpy().tolist() == [7, 0, 7, 7]


def test_the_age_of_goals_is_saved_and_older_checkpoints_have_that_of_episodes():
    env, other = make(), make()
    begin(env)
    rest(env, 3)
    wp.to_torch(env.goal_steps)[0] = 1
    state = env.state_dict()
    other.load_state_dict(state)
    assert other.goal_steps.numpy().tolist() == [1, 3, 3, 3]
    arrays = {name: value for name, value in state["arrays"].items() if name != "goal_steps"}
    other.load_state_dict(state | {"arrays": arrays})
    assert other.goal_steps.numpy().tolist() == [3, 3, 3, 3]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"caught": CaughtCfg(after_s=0.0)}, "caught.after_s is 0"),
        ({"caught": CaughtCfg(beyond_rad=-1.0)}, "caught.beyond_rad is -1"),
        ({"caught": CaughtCfg(go_on_share=1.0)}, "caught.go_on_share is 1; it is from 0 to below 1"),
        ({"caught": CaughtCfg(go_on_share=0.5), "table": TableCfg(away_share=0.5)}, "table.away_share 0.5"),
    ],
)
def test_settings_that_cannot_work_name_their_field(changes, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(CFG, **changes).validate()
