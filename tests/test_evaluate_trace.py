"""Episodes, rules that stop them, and what is counted; with a test double of the environment."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from fake_env import FakeEnv, FakeObject
from scipy.spatial.transform import Rotation

from vd.envs.cfg import RandomisationCfg, ReorientCfg, SuccessCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.cfg import parse_groups
from vd.evaluate.goals import GoalSchedule
from vd.evaluate.result import OUTCOMES, SUCCESS, Agent, Protocol, Result, judge
from vd.evaluate.rollout import draw_starts_and_goals
from vd.evaluate.statistics import TOLERANCES_RAD
from vd.evaluate.trace import NEVER_RAD, record
from vd.geometry.quaternions import rotation_distance
from vd.policy.stopping import StoppingRule

CUBE = Rotation.create_group("O").as_quat()
SQUARE = Rotation.from_rotvec(np.outer(np.arange(4), [0.0, 0.0, np.pi / 2])).as_quat()
STEP_RAD = 0.1
"""What an object turns in a step."""


class Turner:
    """Turns the object about z by STEP_RAD a step, for some steps.

    Predicts the distance and an offset.
    """

    def __init__(self, env, *, until=100, offset=None):
        self.env, self.until = env, until
        if offset is not None:
            self.offset = offset
            self.predicted = torch.zeros(env.num_envs)

    def act(self, observation):
        """The same action in all environments."""
        if hasattr(self, "predicted"):
            true = rotation_distance(observation[:, :4].numpy(), observation[:, 4:8].numpy())
            self.predicted[:] = torch.as_tensor(true + self.offset)
        action = torch.zeros((self.env.num_envs, self.env.num_actions))
        action[:, 2] = STEP_RAD * 12.0 * (int(self.env.step_count.numpy()[0]) < self.until)
        wp.to_torch(self.env.smoothed)[:] = 0.5 * action  # a norm of 0.6: within the paper's bound
        return action


class HeldEnv(FakeEnv):
    """Objects that go on turning by a tenth of a radian a step while they are held.

    Some are lost then.
    """

    lost, held = (), 0

    def __init__(self, *args, lost=(), **settings):
        super().__init__(*args, tolerance=NEVER_RAD, **settings)
        self.cfg.success = SuccessCfg(fall_m=0.24)
        self.lost, self.tables, self.held_tables = lost, [], []
        self.sim.place_table = lambda present: self.tables.append(
            (int(self.step_count.numpy()[0]), present)
        )
        self.sim.place_tables = lambda count, last: self.held_tables.append(
            (count.numpy()[0], last.numpy()[0])
        )
        self.turned = wp.zeros((self.num_envs, 4), dtype=float, device="cpu")

    def motion(self):
        """Orientations."""
        self.turned.numpy()[:] = self._quat
        return {"turned": self.turned}

    def hold(self):
        """Turn on, from what was written into the arrays of the motion."""
        if self.held % 24 == 0:
            self._quat = self.turned.numpy().astype(float)
        self.held += 1
        turn = Rotation.from_rotvec([0.0, 0.0, STEP_RAD / 10.0])
        self._quat = (turn * Rotation.from_quat(self._quat)).as_quat()

    def _pose(self):
        pose = super()._pose()
        pose[list(self.lost), 2] -= 0.5 * (self.held > 0)
        return pose


def goal_ahead(angle, objects=1, episodes=1):
    starts = np.tile([0.0, 0.0, 0.0, 1.0], (objects, episodes, 1))
    goals = np.tile(Rotation.from_rotvec([0.0, 0.0, angle]).as_quat(), (objects, episodes, 1))
    return {"starts": starts, "goals": goals}


def traced(
    angle=0.85, *, objects=(FakeObject("a"),), episodes=1, policy=None, steps=12, **settings
):
    env = HeldEnv(objects, num_envs=len(objects) * episodes, max_episode_steps=steps, **settings)
    return record(
        env, Turner(env, **(policy or {})), episodes, **goal_ahead(angle, len(objects), episodes)
    )


def drawn(objects, episodes):
    """Starts and goals of objects as an evaluation draws them."""
    names = [item.name for item in objects]
    starts, goals = draw_starts_and_goals(names, episodes, seed=1, max_goal_angle=np.pi)
    return {"starts": starts, "goals": goals}


def protocol(episodes):
    return Protocol(
        objects="set",
        hand="dclaw3",
        hand_layer=None,
        episodes=episodes,
        seed=0,
        max_goal_angle_rad=float(np.pi),
        stop_tolerance_rad=0.4,
        episode_s=1.0,
        control_hz=12.0,
    )


def judged(
    trace, objects, *, policy="p", kind="teacher", sees="state", rules=lambda _: StoppingRule()
):
    agent = Agent(policy, kind, sees, rules)
    return judge(trace, protocol(trace.steps.shape[1]), list(objects), agent, group="training")


def rows_of(objects, episodes=10, fall_at=None):
    """Rows of a policy that does nothing.

    By the true distance, and by the success criteria of training.
    """
    env = HeldEnv(objects, num_envs=len(objects) * episodes, max_episode_steps=4, fall_at=fall_at)
    trace = record(env, Turner(env, until=0), episodes, **drawn(objects, episodes))
    return judged(trace, objects, policy="zero", kind="zero", sees="nothing")


def compared(offset=-0.3, fall_at=None, rules=lambda _: StoppingRule(0.2)):
    """Rows of a camera policy whose predictions are too small."""
    objects = (FakeObject("a"), FakeObject("b", warnings=("open", "parts are off")))
    trace = traced(objects=objects, episodes=4, policy={"offset": offset}, fall_at=fall_at)
    who = {"policy": "student.pt", "kind": "student", "sees": "complete clouds"}
    return judged(trace, objects, **who, rules=rules)


def test_what_happened_is_written_down_and_the_first_step_within_the_bounds_ends_it():
    trace = traced()
    assert trace.predicted is None and trace.steps[0, 0] == 12 and not trace.fell.any()
    np.testing.assert_allclose(
        trace.exact[0, 0], np.abs(0.85 - STEP_RAD * np.arange(13)), atol=1e-5
    )
    np.testing.assert_allclose(trace.error, trace.exact, atol=1e-9)
    assert np.isnan(trace.action_norm[0, 0, 12]) and np.isfinite(trace.action_norm[0, 0, :12]).all()
    for bound, steps, error in ((0.5, 4, 0.45), (0.3, 6, 0.25), (0.01, 12, 0.35)):
        (episode,) = trace.episodes(StoppingRule(bound, 2.0), "error")
        assert (episode.steps, episode.stopped) == (steps, bound > 0.1)
        assert episode.error_rad == pytest.approx(error, abs=1e-5), "at the stop, or at the end"
    # It rests from the third step on: the smoothed action has to be below the bound too.
    (quiet,) = traced(policy={"until": 3}).episodes(StoppingRule(0.9, 0.5), "error")
    assert quiet.steps == 4 and quiet.stopped


def test_a_prediction_stops_where_it_says_and_the_truth_is_scored():
    trace = traced(policy={"offset": -0.3})
    by_prediction, by_truth = (
        trace.episodes(StoppingRule(0.2, 2.0), by)[0] for by in ("predicted", "error")
    )
    assert by_prediction.steps == 4 and by_prediction.error_rad == pytest.approx(0.45, abs=1e-5)
    assert by_truth.steps == 7 and by_truth.error_rad == pytest.approx(0.15, abs=1e-5)


def test_nothing_stops_before_the_first_action_or_after_a_fall_or_a_failed_step():
    (episode,) = traced(0.05, policy={"until": 0}).episodes(StoppingRule(0.4, 2.0), "error")
    assert episode.steps == 1 and episode.stopped
    fallen = traced(fall_at={0: 3})
    assert fallen.fell[0, 0] and fallen.steps[0, 0] == 3
    assert np.isnan(fallen.exact[0, 0, 4:]).all(), "the next episode is not this one's"
    (lost,) = fallen.episodes(StoppingRule(0.3, 2.0), "error")
    assert lost.fell and lost.steps == 3
    (saved,) = fallen.episodes(StoppingRule(0.8, 2.0), "error")
    assert saved.stopped and not saved.fell and saved.steps == 1
    env = HeldEnv(num_envs=2, max_episode_steps=12)
    step = env.step

    def failing(action):  # the simulator puts it back and lets its time run out
        count = int(env.step_count.numpy()[0])
        step(action)
        env.done.numpy()[0] |= count == 2

    env.step = failing
    trace = record(env, Turner(env), 2, **goal_ahead(0.85, 1, 2))
    assert trace.steps.tolist() == [[3, 12]] and not trace.fell.any()
    assert np.isnan(trace.exact[0, 0, 4:]).all()


def test_errors_and_stops_are_up_to_symmetry_and_the_headline_is_of_the_very_goal():
    objects = (FakeObject("a"), FakeObject("b", SQUARE))
    trace = traced(np.pi / 2 + 0.3, objects=objects, episodes=2, policy={"until": 4})
    np.testing.assert_allclose(trace.error[1, 0, :4], [0.3, 0.2, 0.1, 0.0], atol=1e-5)
    np.testing.assert_allclose(trace.exact[1, 0], trace.exact[0, 0], atol=1e-9)
    assert trace.ends(StoppingRule(0.4, 2.0), "error")[1].tolist() == [[False, False], [True, True]]
    row = judged(trace.of([1]), objects[1:])[0]
    assert row.overall.symmetric.value == 1.0 and row.overall.outcomes["success"].value == 0.0
    assert row.episodes[0].error_rad == pytest.approx(0.1, abs=1e-5)
    assert row.episodes[0].exact_error_rad == pytest.approx(np.pi / 2 - 0.1, abs=1e-5)
    assert row.per_object[0].symmetric.value == 1.0 and row.overall.success["0.4"].value == 0.0


def test_up_to_symmetry_follows_the_stop_and_tolerance_by_object_too():
    """It passes what looks like the goal, and turns on: away by 0.67 rad at the end."""
    objects = (FakeObject("b", SQUARE),)
    trace = traced(np.pi / 2 + 0.3, objects=objects, policy={"until": 12})
    for row in judged(trace, objects)[:1]:
        assert row.episodes[0].error_rad > 0.4 and not row.episodes[0].stopped
        assert row.overall.symmetric.value == row.per_object[0].symmetric.value == 1.0
    agent = Agent("p", "teacher", "state", lambda _: StoppingRule())
    strict = replace(protocol(1), stop_tolerance_rad=0.01)
    row = judge(trace, strict, list(objects), agent, group="training")[0]
    assert row.per_object[0].symmetric.value == 1.0, "at the one step at which it looks like it"
    other = judge(traced(0.95), strict, [FakeObject("a")], agent, group="training")[0]
    assert other.per_object[0].symmetric.value == 0.0
    early = traced(0.85, policy={"offset": -0.3})  # stops 0.45 rad before the goal
    seeing = replace(agent, sees="complete clouds", rules=lambda _: StoppingRule(0.2))
    for tolerance in (0.4, 0.5):
        asked = replace(protocol(1), stop_tolerance_rad=tolerance)
        row = judge(early, asked, [FakeObject("a")], seeing, group="training")[0]
        assert row.per_object[0].symmetric.value == float(tolerance > 0.45)


def test_what_was_stopped_is_held_and_looked_at_again():
    """The rule stops at 0.35 rad of 0.85.

    In 2 s the object turns on by 0.24 rad, past the goal or away.
    """
    way = (StoppingRule(0.4, 2.0), "exact")
    env = HeldEnv([FakeObject("a")], num_envs=3, max_episode_steps=12, lost=[1])
    goals = goal_ahead(0.85, 1, 3)
    goals["goals"][0, 2] = Rotation.from_rotvec([0.0, 0.0, -2.0]).as_quat()
    schedule = GoalSchedule(table_s=8 / 12)
    trace = record(env, Turner(env), 3, schedule, **goals, ways=[way])
    ahead, lost, never = trace.held[way][0]
    assert (
        ahead == pytest.approx(0.35 - 0.24, abs=1e-4)
        and lost == pytest.approx(np.pi)
        and np.isnan(never)
    )
    assert env.held == 24 and env.held_tables[:4] == [(5, 8), (6, 8), (7, 8), (8, 8)], "in its time"
    assert trace.exact[0, 0, 12] == pytest.approx(0.35, abs=1e-5), (
        "the record itself is not changed"
    )
    assert trace.of([0]).held[way].shape == (1, 3)


def test_success_is_reported_at_the_stop_and_after_the_hold():
    objects = [FakeObject("a"), FakeObject("b")]
    env = HeldEnv(objects, num_envs=4, max_episode_steps=24, lost=[1])
    who = Agent("s", "vision", "rendered clouds", lambda _: StoppingRule(0.3, 2.5))
    held = list(who.ways_to_stop(0.4).values())
    trace = record(env, Turner(env, until=6, offset=0.0), 2, **goal_ahead(0.85, 2, 2), ways=held)
    rows = judge(trace, protocol(2), objects, who, group="g")
    assert [(row.stopped_by, row.rule.action_norm) for row in rows] == [
        ("prediction", 1.0),
        ("true distance", 1.0),
    ], "with the paper's bound of the action"
    assert [row.overall.outcomes["success"].value for row in rows] == [1.0, 1.0]
    assert [row.held.value for row in rows] == [0.75, 0.75]


def test_what_predicts_nothing_is_judged_by_the_success_criteria_of_training_too():
    """It comes within 0.4 rad after five steps and is not still before the seventh."""
    rows = judged(traced(policy={"until": 6}), [FakeObject("a")])
    assert [row.stopped_by for row in rows] == ["true distance", SUCCESS]
    assert [row.episodes[0].steps for row in rows] == [5, 7]
    assert rows[1].episodes[0].error_rad == pytest.approx(0.25, abs=1e-5)
    assert rows[1].precise.value == 0.0 and rows[1].held is None
    assert [row.headline for row in rows] == [True, False]


@pytest.mark.parametrize("envs", [5, 40])
def test_every_start_and_goal_is_run_once_whatever_the_number_of_environments(envs):
    objects = [FakeObject("a"), FakeObject("b", CUBE), FakeObject("c")]
    env = HeldEnv(objects, num_envs=envs, max_episode_steps=2)
    told = drawn(objects, 4)
    episodes = record(env, Turner(env, until=0), 4, **told).episodes(StoppingRule(0.0), "exact")
    assert [e.object_index for e in episodes] == [0] * 4 + [1] * 4 + [2] * 4
    np.testing.assert_allclose(
        [e.goal_quat for e in episodes], told["goals"].reshape(-1, 4), atol=1e-6
    )
    errors = [e.error_rad for e in episodes]
    np.testing.assert_allclose(errors, [e.start_error_rad for e in episodes], atol=2e-3)
    plain = rotation_distance(told["starts"], told["goals"]).ravel()
    np.testing.assert_allclose([e.exact_error_rad for e in episodes], plain, atol=1e-5)
    assert max(errors[4:8]) < 1.1 < plain[4:8].max(), "of a cube up to symmetry"
    env.world_object[:] = 0
    with pytest.raises(ValueError, match="simulates object 1"):
        record(env, Turner(env), 4, **told)


def test_what_the_environment_draws_is_recorded_and_does_not_depend_on_the_policy():
    def run(until, fall_at):
        # Environments that drop their object reset, and so draw, more often before the second round
        # begins.
        env = HeldEnv([FakeObject("a")], num_envs=3, max_episode_steps=6, fall_at=fall_at)
        return record(env, Turner(env, until=until), 9).episodes(StoppingRule(0.0), "exact")

    first, second = run(0, {0: 1}), run(6, {1: 2, 2: 3})
    assert [e.error_rad for e in first] != [e.error_rad for e in second]
    assert [(e.start_quat, e.goal_quat) for e in first] == [
        (e.start_quat, e.goal_quat) for e in second
    ]
    starts, goals = (
        np.array([getattr(e, name) for e in first]) for name in ("start_quat", "goal_quat")
    )
    np.testing.assert_allclose(
        [e.error_rad for e in first], rotation_distance(starts, goals), atol=2e-3
    )
    apart = rotation_distance(starts[:, None], starts[None]) + 4.0 * np.eye(len(starts))
    assert apart.min() > 1e-3, "a start was used twice"


def test_starts_and_goals_depend_on_name_and_seed_alone_and_goals_are_uniform_within_the_angle():
    def draw(name, count, seed, most=np.pi):
        starts, goals = draw_starts_and_goals([name], count, seed=seed, max_goal_angle=most)
        return starts[0], goals[0]

    start, goal = draw("shoe", 50, 3)
    both = draw_starts_and_goals(["boot", "shoe"], 50, seed=3, max_goal_angle=np.pi)
    for same, other in zip((start, goal), both, strict=True):
        np.testing.assert_array_equal(same, other[1])
    for name, seed in (("shoe", 4), ("boot", 3)):
        assert rotation_distance(start, draw(name, 50, seed)[0]).min() > 0.0
    angle = rotation_distance(*draw("x", 20_000, 0))
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.02)
    near = rotation_distance(*draw("x", 20_000, 0, most=1.0))
    assert near.max() <= 1.0
    # Of uniform rotations within 1 rad, the share within 0.8 rad:
    assert (near <= 0.8).mean() == pytest.approx((0.8 - np.sin(0.8)) / (1 - np.sin(1.0)), abs=0.015)


def test_every_episode_is_in_one_class_and_rates_count_them():
    rows = compared(fall_at={1: 2, 5: 12})
    assert [row.stopped_by for row in rows] == ["prediction", "true distance"]
    assert Result(tuple(rows)).warnings == {"b": "open; parts are off"}
    by_prediction, by_truth = (
        {k: v.value for k, v in row.overall.outcomes.items()} for row in rows
    )
    assert tuple(by_prediction) == OUTCOMES
    # It stops at 0.45 rad by its prediction, and at 0.35 by the truth; one fell before, one long
    # after.
    assert by_prediction == pytest.approx(
        dict(zip(OUTCOMES, (0.0, 7 / 8, 0.0, 1 / 8), strict=True))
    )
    assert by_truth == pytest.approx(dict(zip(OUTCOMES, (7 / 8, 0.0, 0.0, 1 / 8), strict=True)))
    assert rows[1].overall.time_s.value == pytest.approx(5 / 12) and rows[0].overall.time_s is None
    assert [one.outcomes["object falls"].value for one in rows[0].per_object] == [0.25, 0.0]
    assert compared(offset=5.0)[0].overall.outcomes["time-out"].value == 1.0
    row = rows_of([FakeObject("a"), FakeObject("b", CUBE)], fall_at={0: 1, 13: 2})[1]
    for tolerance in TOLERANCES_RAD:
        exact = np.mean([not e.fell and e.exact_error_rad <= tolerance for e in row.episodes])
        assert row.overall.success[str(tolerance)].value == pytest.approx(exact), "of the very goal"


def test_what_predictions_are_worth():
    by_prediction, by_truth = compared()
    prediction, true = by_prediction.prediction, np.abs(0.85 - STEP_RAD * np.arange(12))
    assert prediction.states == 8 * 12 and by_truth.prediction is None
    assert prediction.mean_error_rad == pytest.approx(0.3, abs=1e-4)
    said = true - 0.3 <= 0.4
    assert list(prediction.seen) == ["0.1", "0.4"] and prediction.seen["0.4"] == 1.0
    assert prediction.right["0.4"] == pytest.approx((true[said] <= 0.4).mean())
    sure = compared(offset=0.0, rules=StoppingRule)
    assert list(sure[0].prediction.right.values()) == [1.0, 1.0]
    assert sure[0].precise == sure[1].precise


def test_each_tolerance_has_its_own_rule():
    """Predictions are 0.3 rad too small.

    The rule for 0.4 rad knows of it, the one for 0.1 does not.
    """
    bounds = {0.1: 0.1, 0.4: 0.05}
    by_prediction, by_truth = compared(rules=lambda tolerance: StoppingRule(bounds[tolerance]))
    assert by_prediction.rule.distance_rad == 0.05 and by_truth.rule.distance_rad == 0.4
    assert (
        by_prediction.overall.outcomes["success"].value == 1.0
        and by_prediction.precise.value == 0.0
    )
    assert by_truth.precise.value == 1.0


def test_a_result_is_read_as_it_was_written_and_compares_policies_in_pairs(tmp_path):
    result = Result(tuple(compared()), {"torch": "2"}, (("air", "p", "out of time"),))
    result.write(tmp_path / "eval.json")
    assert Result.read(tmp_path / "eval.json") == result
    (tmp_path / "x.json").write_text('{"format": 1}')
    with pytest.raises(ValueError, match="vd-eval again"):
        Result.read(tmp_path / "x.json")
    row = result.rows[1]  # succeeds in all episodes
    lost = tuple(replace(e, stopped=e.object_index == 0) for e in row.episodes)
    other = replace(row, policy="other", episodes=lost)
    rows = [replace(one, kind="teacher", sees="state") for one in (row, other)]
    ((first, second, difference),) = Result(tuple(rows)).differences()
    assert (first.policy, second.policy, difference.value) == ("student.pt", "other", -0.5)


def test_groups_of_objects():
    assert parse_groups(["cube"]) == {"objects": ("cube",)}
    groups = {"training": ("a", "c"), "held-out": ("b",)}
    assert parse_groups(["training=a", "held-out=b", "training=c"]) == groups


def test_without_a_table_objects_fall_and_it_comes_back():
    class Still:
        def act(self, observation):
            """Nothing: open fingers hold nothing."""
            return torch.zeros((3, 9))

    # Frictions and gains are handed to the solver once a second, which must not move the table. No
    # pushes: they would lose objects from open fingers.
    task = ReorientCfg(
        hand="dclaw3",
        objects=("cube",),
        num_envs=3,
        episode_s=3.0,
        success=replace(SuccessCfg(), rotation_rad=NEVER_RAD),
        success_ends_episode=True,
        randomisation=RandomisationCfg(redraw_s=0.0, force_probability=0.0),
    )
    env = ReorientEnv(task, "cpu")
    starts, goals = (
        np.tile(quat, (1, 3, 1)) for quat in ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0])
    )
    settings = dict(starts=starts, goals=goals)
    rests = record(env, Still(), 3, **settings)
    falls = record(env, Still(), 3, GoalSchedule(table_s=2.0), **settings)
    again = record(env, Still(), 3, **settings)
    assert not rests.fell.any() and not again.fell.any()
    assert falls.fell.all() and (falls.steps > 24).all() and (falls.steps <= 28).all()
    env.sim.place_table(present=False)
    gone = env.sim.solver.mjw_data.geom_xpos.numpy().copy()
    env.randomiser.write_model()
    np.testing.assert_array_equal(env.sim.solver.mjw_data.geom_xpos.numpy(), gone)
    env.check()
