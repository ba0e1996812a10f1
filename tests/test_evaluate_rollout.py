"""Which step of which episode the success criteria of training end, on a stand-in environment."""

import numpy as np
import pytest
import torch
from fake_env import FakeEnv, FakeObject
from scipy.spatial.transform import Rotation

from vd.evaluate.result import Protocol, judge
from vd.evaluate.rollout import draw_starts_and_goals
from vd.evaluate.statistics import TOLERANCES_RAD, rotation_angle
from vd.evaluate.trace import NEVER_RAD, record
from vd.stopping import StoppingRule

CONTROL_HZ = 12.0
CUBE = Rotation.create_group("O").as_quat()


class Turn:
    """Turns every object about the vertical at a fixed speed, and stops after ``until`` steps."""

    def __init__(self, speed, until=10**9):
        self.speed, self.until, self.calls = speed, until, 0

    def act(self, observation):
        """The same action in every world."""
        self.calls += 1
        action = torch.zeros(len(observation), 9)
        action[:, 2] = self.speed if self.calls <= self.until else 0.0
        return action


def fake(*args, **settings):
    """An environment in which no state but a fall ends an episode."""
    env = FakeEnv(*args, tolerance=NEVER_RAD, **settings)
    env.sim.place_table = lambda present: None
    return env


def collect(env, policy, starts=None, goals=None, *, episodes=0):
    """The episodes as the success criteria end them."""
    episodes = episodes or starts.shape[1]
    return record(env, policy, episodes, starts=starts, goals=goals).episodes(StoppingRule(0.4), "success")


def quarter_turn_ahead(envs=1, angle=np.pi / 2):
    start = np.tile([0.0, 0.0, 0.0, 1.0], (1, envs, 1))
    goal = np.tile(Rotation.from_rotvec([0, 0, angle]).as_quat(), (1, envs, 1))
    return start, goal


def test_a_policy_that_passes_the_goal_and_leaves_has_its_last_error():
    env = fake(max_episode_steps=24)
    starts, goals = quarter_turn_ahead()
    (episode,) = collect(env, Turn(np.pi / 2), starts, goals)  # half a turn in two seconds; passes after one
    assert episode.steps == 24 and not episode.stopped and not episode.fell
    assert episode.error_rad == pytest.approx(np.pi / 2, abs=1e-5)


def test_a_drop_ends_the_episode_and_fails_at_every_tolerance():
    env = fake(max_episode_steps=24, fall_at={0: 5})
    starts, goals = quarter_turn_ahead(angle=0.6)
    (episode,) = collect(env, Turn(0.6 * 12 / 5), starts, goals)  # within 0.1 rad at the moment of the drop
    assert episode.fell and not episode.stopped and episode.steps == 5
    assert episode.error_rad < 0.1


def test_only_the_first_episode_of_a_world_in_a_round_counts():
    env = fake(num_envs=2, max_episode_steps=24, fall_at={0: 3})  # world 0 goes on dropping every 3 steps
    starts, goals = quarter_turn_ahead(envs=2)
    first, second = collect(env, Turn(0.0), starts, goals)
    assert first.fell and first.steps == 3
    assert not second.fell and second.steps == 24
    assert env.resets == 2  # one of the constructor, one round


@pytest.mark.parametrize("envs", [3, 5, 12, 40])
def test_every_start_and_goal_is_run_once_whatever_the_number_of_worlds(envs):
    objects = [FakeObject("a"), FakeObject("b", CUBE), FakeObject("c")]
    drawn = [draw_starts_and_goals(o.name, 4, seed=1) for o in objects]
    starts, goals = (np.stack([pair[i] for pair in drawn]) for i in range(2))
    episodes = collect(fake(objects, num_envs=envs, max_episode_steps=2), Turn(0.0), starts, goals)
    assert [e.object_index for e in episodes] == [0] * 4 + [1] * 4 + [2] * 4
    np.testing.assert_allclose([e.goal_quat for e in episodes], goals.reshape(-1, 4), atol=1e-6)
    # Nothing moves, so the error stays: up to symmetry for the cube.
    np.testing.assert_allclose(
        [e.error_rad for e in episodes], [e.start_error_rad for e in episodes], atol=2e-3
    )
    plain = rotation_angle(starts[1], goals[1])
    assert all(e.error_rad <= a + 1e-3 for e, a in zip(episodes[4:8], plain, strict=True))
    assert max(e.error_rad for e in episodes[4:8]) < 1.1 < plain.max()


def test_episodes_the_environment_draws_are_recorded_as_they_were_run():
    env = fake([FakeObject("a"), FakeObject("b", CUBE)], num_envs=4, max_episode_steps=2)
    # Nothing moves: the error at the end is the angle between the start and the goal that are recorded.
    episodes = collect(env, Turn(0.0), episodes=5)
    assert [e.object_index for e in episodes] == [0] * 5 + [1] * 5
    ends = [rotation_angle(np.array(e.start_quat), np.array(e.goal_quat)) for e in episodes[:5]]
    np.testing.assert_allclose([e.error_rad for e in episodes[:5]], ends, atol=2e-3)
    starts = np.array([e.start_quat for e in episodes])
    apart = rotation_angle(starts[:, None], starts[None]) + 4.0 * np.eye(len(starts))
    assert apart.min() > 1e-3, "a start was used twice"


def test_starts_and_goals_the_environment_draws_do_not_depend_on_the_policy():
    def run(speed, fall_at):
        # Environments that drop their object reset, and so draw, more often before the second round begins.
        env = fake([FakeObject("a")], num_envs=3, max_episode_steps=6, fall_at=fall_at)
        return collect(env, Turn(speed), episodes=9)

    first, second = run(0.0, {0: 1}), run(2.0, {1: 2, 2: 3})
    assert [e.error_rad for e in first] != [e.error_rad for e in second]
    assert [(e.start_quat, e.goal_quat) for e in first] == [(e.start_quat, e.goal_quat) for e in second]


def test_fewer_worlds_than_objects_is_refused():
    env = fake([FakeObject("a"), FakeObject("b")], num_envs=2)
    env.world_object[:] = 0
    with pytest.raises(ValueError, match="no environment simulates object 1"):
        collect(env, Turn(0.0), *(np.tile(x, (2, 1, 1)) for x in quarter_turn_ahead()))


def test_starts_and_goals_depend_on_name_and_seed_alone():
    start, goal = draw_starts_and_goals("shoe", 50, seed=3)
    again = draw_starts_and_goals("shoe", 50, seed=3)
    np.testing.assert_array_equal(start, again[0])
    np.testing.assert_array_equal(goal, again[1])
    assert rotation_angle(start, draw_starts_and_goals("shoe", 50, seed=4)[0]).min() > 0.0
    assert rotation_angle(start, draw_starts_and_goals("boot", 50, seed=3)[0]).min() > 0.0


def test_goals_are_uniform_within_the_largest_angle():
    angle = rotation_angle(*draw_starts_and_goals("x", 20_000, seed=0))
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.02)
    near = rotation_angle(*draw_starts_and_goals("x", 20_000, seed=0, max_goal_angle=1.0))
    assert near.max() <= 1.0
    # Of uniform rotations within 1 rad, the share within 0.8 rad:
    assert (near <= 0.8).mean() == pytest.approx((0.8 - np.sin(0.8)) / (1 - np.sin(1.0)), abs=0.015)


def rows_of(objects, episodes=10, envs=None, fall_at=None, policy=None):
    """The rows of a policy that predicts nothing: by the true distance, and by the success criteria."""
    drawn = [draw_starts_and_goals(o.name, episodes, seed=1) for o in objects]
    starts, goals = (np.stack([pair[i] for pair in drawn]) for i in range(2))
    env = fake(objects, num_envs=envs or len(objects) * episodes, max_episode_steps=4, fall_at=fall_at)
    trace = record(env, policy or Turn(0.0), episodes, starts=starts, goals=goals)
    protocol = Protocol(
        objects="set",
        hand="dclaw3",
        hand_layer=None,
        episodes=episodes,
        seed=1,
        max_goal_angle_rad=float(np.pi),
        stop_tolerance_rad=0.4,
        episode_s=4 / CONTROL_HZ,
        control_hz=CONTROL_HZ,
    )
    told = dict(kind="zero", sees="nothing", group="objects", rules=lambda _: StoppingRule())
    return judge(trace, protocol, objects, policy="zero", **told)


def test_rates_count_what_happened():
    row = rows_of([FakeObject("a"), FakeObject("b", CUBE)], episodes=10, fall_at={0: 1, 13: 2})[1]
    assert row.overall.outcomes["object falls"].value == pytest.approx(2 / 20)
    assert [s.outcomes["object falls"].value for s in row.per_object] == pytest.approx([0.1, 0.1])
    for tolerance in TOLERANCES_RAD:
        exact, alike = (
            np.mean([not e.fell and getattr(e, name) <= tolerance for e in row.episodes])
            for name in ("exact_error_rad", "error_rad")
        )
        assert row.overall.success[str(tolerance)].value == pytest.approx(exact), "of the very goal"
        assert row.overall.symmetric[str(tolerance)].value == pytest.approx(alike)
    assert row.overall.success["0.8"].value < row.overall.symmetric["0.8"].value, "one is a cube"
    assert all(e.error_rad <= e.exact_error_rad + 1e-9 for e in row.episodes)
    assert row.overall.unit == "episode"
