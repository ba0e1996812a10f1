"""Goal after goal: what is counted; with a test double of the environment."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from fake_env import FakeObject
from scipy.spatial.transform import Rotation
from test_evaluate_page import read_page
from test_evaluate_trace import STEP_RAD, HeldEnv, drawn, protocol

from vd.evaluate.goals import AIR_GOALS, CONSECUTIVE
from vd.evaluate.page import terminal_text, write_page
from vd.evaluate.result import Agent, Result, judge
from vd.evaluate.rollout import draw_turns
from vd.evaluate.trace import record
from vd.geometry.quaternions import rotation_distance
from vd.policy.stopping import StoppingRule

OBJECTS = (FakeObject("a"), FakeObject("b"))
EPISODES = 4


class SeriesEnv(HeldEnv):
    """Remembers which goals were given when."""

    def __init__(self, length_s=AIR_GOALS.length_s, **settings):
        self.given = []
        super().__init__(
            OBJECTS,
            num_envs=len(OBJECTS) * EPISODES,
            max_episode_steps=round(12 * length_s),
            **settings,
        )

    def give_goals(self, envs, goal_quat):
        """As of the environment."""
        self.given.append((int(self.step_count.numpy().max()), list(envs)))
        super().give_goals(envs, goal_quat)


class Seeker:
    """Turns every object to its goal by STEP_RAD a step.

    May predict the distance, by so much too small.
    """

    def __init__(self, env, blind_rad=None):
        self.env, self.blind_rad = env, blind_rad
        if blind_rad is not None:
            self.predicted = torch.zeros(env.num_envs)

    def act(self, observation):
        """Turn on."""
        quat, goal = (Rotation.from_quat(observation[:, i : i + 4].numpy()) for i in (0, 4))
        turn = (goal * quat.inv()).as_rotvec()
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        if self.blind_rad is not None:
            self.predicted[:] = torch.as_tensor(angle[:, 0] - self.blind_rad)
        action = torch.zeros((self.env.num_envs, self.env.num_actions))
        action[:, :3] = torch.as_tensor(
            12.0 * turn / np.maximum(angle, 1e-9) * np.minimum(angle, STEP_RAD)
        )
        wp.to_torch(self.env.smoothed)[:] = 0.5 * action
        return action


def flown(blind_rad=None, **settings):
    """What became of the episodes, the environment, and where the goals were."""
    env = SeriesEnv(**settings)
    turns = draw_turns([item.name for item in OBJECTS], EPISODES, 3, seed=2, max_goal_angle=np.pi)
    policy, by = Seeker(env, blind_rad), "exact" if blind_rad is None else "predicted"
    way = StoppingRule(), by
    start = drawn(OBJECTS, EPISODES)
    trace = record(env, policy, EPISODES, AIR_GOALS, ways=[way], turns=turns, **start)
    return trace, env, turns


def agent(blind=False):
    """A teacher, or what stops by its own prediction."""
    return Agent("p", "teacher", "clouds" if blind else "state", lambda _: StoppingRule())


def row_of(trace, objects=OBJECTS, **asked):
    """The only row."""
    how = replace(protocol(EPISODES), **asked)
    (row,) = judge(trace, how, list(objects), agent(trace.predicted is not None), group="held-out")
    return row


def test_goals_follow_one_another_once_the_table_is_gone():
    trace, env, turns = flown(lost=(1,))
    assert env.tables[0] == (24, False) and env.tables[-1][1]
    assert trace.given.all() and (trace.reached == 3).all() and not trace.fell.any()
    assert env.given[0] == (36, list(range(8))), "all get the first goal at once"
    assert sum(len(envs) for _, envs in env.given) == 3 * 8 and len(env.given) > 3, (
        "and others as they come"
    )
    angle = Rotation.from_quat(turns[:, :, 0].reshape(-1, 4)).magnitude().reshape(2, 4)
    np.testing.assert_allclose(
        rotation_distance(trace.start_quat, trace.goal_quat), angle, atol=1e-5
    )
    row = row_of(trace, air_goals=True)
    steps = np.reshape([e.steps for e in row.episodes], (2, 4))
    np.testing.assert_array_equal(steps, np.maximum(1, np.floor((angle - 0.4) / STEP_RAD) + 1))
    assert all(e.stopped and e.exact_error_rad < 0.4 for e in row.episodes)
    (held,) = trace.held.values()
    np.testing.assert_array_equal(held == np.pi, [[0, 1, 0, 0], [0, 0, 0, 0]])
    assert row.successes.all() and row.in_air.in_a_row.value == 1.0 and row.in_air.let_go == 1 / 8


def test_what_is_lost_before_or_after_the_first_goal_was_drawn_is_told_apart(tmp_path):
    trace, _, _ = flown(fall_at={0: 20, 5: 37})
    np.testing.assert_array_equal(
        trace.fell, [[True, False, False, False], [False, True, False, False]]
    )
    np.testing.assert_array_equal(trace.given, [[False, True, True, True], [True] * 4])
    row = row_of(trace, air_goals=True)
    assert row.overall.outcomes["success"].value == row.in_air.in_a_row.value == 6 / 8
    assert row.overall.outcomes["object falls"].value == 2 / 8
    assert (row.in_air.first, row.in_air.lost) == pytest.approx((6 / 7, 1 / 7))
    assert row.in_air.let_go == 0.0
    result = Result((row,))
    write_page(result, tmp_path / "eval.html")
    for text in (
        read_page(tmp_path / "eval.html")[0].replace("\N{NO-BREAK SPACE}", " "),
        terminal_text(result),
    ):
        assert "14.3 %" in text and "85.7 %" in text
    result.write(tmp_path / "eval.json")
    assert Result.read(tmp_path / "eval.json") == result


def test_a_stop_away_from_the_goal_ends_the_row():
    trace, env, _ = flown(blind_rad=0.5)
    assert trace.given.all() and len(env.given) == 1 and not trace.fell.any()
    far = rotation_distance(trace.start_quat, trace.goal_quat) > 1.0
    row = row_of(trace, air_goals=True)
    assert far.any() and all(e.stopped for e in row.episodes) and not trace.reached[far].any()
    assert row.overall.outcomes["orientation error"].value >= far.mean()


def test_successes_in_a_row_end_with_a_fall_or_a_goal_that_takes_too_long(tmp_path):
    series = replace(CONSECUTIVE, most=6, goal_s=1.5)
    env = SeriesEnv(series.length_s, fall_at={0: 1, 5: 20})
    turns = draw_turns(["a", "b"], EPISODES, series.most, seed=2, max_goal_angle=1.5)
    turns[0, 2, 3] = Rotation.from_rotvec(
        [0.0, 0.0, 3.0]
    ).as_quat()  # 26 steps away, of which it has 18
    start = drawn(OBJECTS, EPISODES)["starts"]
    ahead = Rotation.from_rotvec([0.0, 1.05, 0.0]) * Rotation.from_quat(start.reshape(-1, 4))
    given = {"starts": start, "goals": ahead.as_quat().reshape(start.shape)}
    (way,) = agent().ways_to_stop(0.4, series).values()
    assert way[0].action_norm > env.num_actions, "no action is too much"
    trace = record(env, Seeker(env), EPISODES, series, ways=[way], turns=turns, **given)
    assert not env.tables, "the table is left alone"
    np.testing.assert_allclose(
        rotation_distance(trace.start_quat, trace.goal_quat), 1.05, atol=1e-5
    )
    reached = trace.reached.tolist()
    assert (
        reached[0][0] == 0
        and reached[0][2] == 3
        and 1 <= reached[1][1] < 6
        and trace.fell.sum() == 2
    )
    assert [count for row in reached for count in row if count == 6] == [6] * 5
    row = row_of(trace, consecutive=True, episode_s=1.5)
    assert {e.steps for e in row.episodes[2:4] + row.episodes[6:]} == {7}
    both, a, b = row.consecutive
    total = trace.reached.sum()
    assert (both.mean, both.median, both.full, both.lost) == pytest.approx(
        (total / 8, 6.0, 5 / 8, 2 / 8)
    )
    assert both.goals == pytest.approx(total / (total + 3)) and (a.name, b.name) == ("a", "b")
    assert a.mean == pytest.approx(15 / 4) and a.median == 4.5 and row.successes.sum() == 7
    write_page(Result((row,)), tmp_path / "eval.html")
    for text in (read_page(tmp_path / "eval.html")[0], terminal_text(Result((row,)))):
        assert (
            "of all goals" in text and "3.8" in text and "4.5" in text and "episode s 1.5" in text
        )


def test_up_to_symmetry_a_first_goal_is_judged_like_a_single_one():
    """A quarter turn about the axis of a square looks like none: the first step is near enough."""
    square = Rotation.from_rotvec(np.outer(np.arange(4), [0.0, 0.0, np.pi / 2])).as_quat()
    objects = (FakeObject("a", square),)
    env = HeldEnv(objects, num_envs=1, max_episode_steps=12 * 3)
    series = replace(CONSECUTIVE, most=3, goal_s=0.5)
    ahead = {
        "starts": np.array([[[0.0, 0.0, 0.0, 1.0]]]),
        "goals": Rotation.from_rotvec([[0.0, 0.0, np.pi / 2 + 0.2]]).as_quat()[None],
    }
    (way,) = agent().ways_to_stop(0.4, series).values()
    turns = draw_turns(["a"], 1, 3, seed=0, max_goal_angle=np.pi)
    trace = record(env, Seeker(env), 1, series, ways=[way], turns=turns, **ahead)
    (row,) = judge(trace, protocol(1), list(objects), agent(), group="held-out")
    assert row.overall.outcomes["time-out"].value == 1.0 and row.overall.symmetric.value == 1.0
    assert row.episodes[0].start_error_rad == pytest.approx(0.2, abs=1e-5)
