"""Rules that stop episodes, applied to what happened; with a test double of the environment."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp
from fake_env import FakeEnv, FakeObject
from scipy.spatial.transform import Rotation

from vd.envs.cfg import RandomisationCfg, ReorientCfg, SuccessCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.cfg import parse_groups
from vd.evaluate.result import OUTCOMES, OWN_NORM, SUCCESS, Protocol, Result, judge, ways_to_stop
from vd.evaluate.trace import NEVER_RAD, record
from vd.stopping import StoppingRule

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
HALF_TURN = Rotation.from_rotvec([0.0, 0.0, np.pi]).as_quat()
STEP_RAD = 0.1
"""What an object turns in a step."""


class Turner:
    """Turns the object about z by STEP_RAD a step, for some steps; predicts the distance and an offset."""

    def __init__(self, env, *, until=100, offset=None):
        self.env, self.until, self.steps = env, until, 0
        if offset is not None:
            self.offset = offset
            self.predicted = torch.zeros(env.num_envs)

    def act(self, observation):
        """The same action in all environments."""
        start, goal = observation[:, :4].numpy(), observation[:, 4:8].numpy()
        if hasattr(self, "predicted"):
            true = (Rotation.from_quat(start).inv() * Rotation.from_quat(goal)).magnitude()
            self.predicted[:] = torch.as_tensor(true + self.offset)
        self.steps = int(self.env.step_count.numpy()[0])
        action = torch.zeros((self.env.num_envs, self.env.num_actions))
        action[:, 2] = STEP_RAD * 12.0 * (self.steps < self.until)
        wp.to_torch(self.env.smoothed)[:] = 0.5 * action  # a norm of 0.6: within the paper's bound
        return action


def fake_env(objects=(FakeObject("a"),), envs=1, steps=12, **settings):
    env = FakeEnv(objects, num_envs=envs, max_episode_steps=steps, tolerance=NEVER_RAD, **settings)
    env.table = []
    env.sim.place_table = lambda present: env.table.append((int(env.step_count.numpy()[0]), present))
    return env


def goal_ahead(angle, objects=1, episodes=1):
    starts = np.tile(IDENTITY, (objects, episodes, 1))
    goals = np.tile(Rotation.from_rotvec([0.0, 0.0, angle]).as_quat(), (objects, episodes, 1))
    return {"starts": starts, "goals": goals}


def traced(angle=0.85, *, objects=(FakeObject("a"),), episodes=1, policy=None, **settings):
    env = fake_env(objects, envs=len(objects) * episodes, **settings)
    return record(env, Turner(env, **(policy or {})), episodes, **goal_ahead(angle, len(objects), episodes))


def test_what_happened_is_written_down():
    trace = traced()
    assert trace.predicted is None and trace.steps[0, 0] == 12 and not trace.fell.any()
    passed = np.abs(0.85 - STEP_RAD * np.arange(13))
    np.testing.assert_allclose(trace.exact[0, 0], passed, atol=1e-5)
    np.testing.assert_allclose(trace.error, trace.exact, atol=1e-9)
    assert np.isnan(trace.action_norm[0, 0, 12]) and np.isfinite(trace.action_norm[0, 0, :12]).all()


@pytest.mark.parametrize(
    ("bound", "steps", "error"),
    [(0.5, 4, 0.45), (0.3, 6, 0.25), (0.01, 12, 0.35)],
    ids=["early", "later", "never"],
)
def test_the_first_step_within_the_bounds_ends_it(bound, steps, error):
    (episode,) = traced().episodes(StoppingRule(bound, 2.0), "error")
    assert (episode.steps, episode.stopped) == (steps, bound > 0.1)
    assert episode.error_rad == pytest.approx(error, abs=1e-5), "at the stop, or at the end"


def test_a_loud_action_does_not_stop():
    """The object rests from the third step on: the smoothed action has to be below the bound too."""
    trace = traced(policy={"until": 3})
    (episode,) = trace.episodes(StoppingRule(0.9, 0.5), "error")
    assert episode.steps == 4 and episode.stopped


def test_a_prediction_stops_where_it_says_and_the_truth_is_scored():
    trace = traced(policy={"offset": -0.3})
    (by_prediction,) = trace.episodes(StoppingRule(0.2, 2.0), "predicted")
    (by_truth,) = trace.episodes(StoppingRule(0.2, 2.0), "error")
    assert by_prediction.steps == 4 and by_prediction.error_rad == pytest.approx(0.45, abs=1e-5)
    assert by_truth.steps == 7 and by_truth.error_rad == pytest.approx(0.15, abs=1e-5)
    with pytest.raises(ValueError, match="only camera policies predict"):
        traced().episodes(StoppingRule(), "predicted")


def test_nothing_stops_before_the_first_action_or_after_a_fall():
    near = traced(0.05, policy={"until": 0})
    (episode,) = near.episodes(StoppingRule(0.4, 2.0), "error")
    assert episode.steps == 1 and episode.stopped
    fallen = traced(fall_at={0: 3})
    assert fallen.fell[0, 0] and fallen.steps[0, 0] == 3
    assert np.isnan(fallen.exact[0, 0, 4:]).all(), "the next episode is not this one's"
    (lost,) = fallen.episodes(StoppingRule(0.3, 2.0), "error")
    assert lost.fell and lost.steps == 3
    (saved,) = fallen.episodes(StoppingRule(0.8, 2.0), "error")
    assert saved.stopped and not saved.fell and saved.steps == 1


def test_errors_and_stops_are_up_to_symmetry():
    square = FakeObject("b", Rotation.from_rotvec(np.outer(np.arange(4), [0.0, 0.0, np.pi / 2])).as_quat())
    trace = traced(np.pi / 2 + 0.3, objects=(FakeObject("a"), square), episodes=2)
    assert trace.error.shape == (2, 2, 13)
    np.testing.assert_allclose(trace.error[1, 0, :4], [0.3, 0.2, 0.1, 0.0], atol=1e-5)
    np.testing.assert_allclose(trace.exact[1, 0], trace.exact[0, 0], atol=1e-9)
    stopped = trace.ends(StoppingRule(0.4, 2.0), "error")[1]
    assert stopped.tolist() == [[False, False], [True, True]]
    quiet = traced(np.pi / 2 + 0.3, objects=(FakeObject("a"), square), episodes=2, policy={"until": 4})
    (row, _) = judge(
        quiet.of([1]),
        protocol(2),
        [square],
        policy="zero",
        kind="zero",
        sees="nothing",
        group="b",
        rules=lambda _: StoppingRule(),
    )
    assert row.symmetric.value == 1.0 and row.overall.outcomes["success"].value == 0.0
    assert row.episodes[0].error_rad == pytest.approx(0.1, abs=1e-5)
    assert row.episodes[0].exact_error_rad == pytest.approx(np.pi / 2 - 0.1, abs=1e-5)
    assert row.overall.symmetric["0.4"].value == 1.0
    assert row.overall.success["0.4"].value == 0.0, "the headline is against the very goal"


class HeldEnv(FakeEnv):
    """Objects that go on turning by a tenth of a radian a step while they are held; some are lost then."""

    lost, held = (), 0

    def __init__(self, *args, lost=(), **settings):
        super().__init__(*args, **settings)
        self.cfg.success = SimpleNamespace(fall_m=0.24)
        self.lost, self.tables = lost, []
        self.sim.place_table = lambda present: None
        self.sim.place_tables = lambda count, last: self.tables.append((count.numpy()[0], last.numpy()[0]))
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


def test_what_was_stopped_is_held_and_looked_at_again():
    """The rule stops at 0.35 rad of 0.85; in 2 s the object turns on by 0.24 rad, past the goal or away."""
    rule = StoppingRule(0.4, 2.0)
    env = HeldEnv([FakeObject("a")], num_envs=3, max_episode_steps=12, tolerance=NEVER_RAD, lost=[1])
    goals = goal_ahead(0.85, 1, 3)
    goals["goals"][0, 2] = Rotation.from_rotvec([0.0, 0.0, -2.0]).as_quat()
    trace = record(env, Turner(env), 3, **goals, held=[(rule, "exact")], table_steps=8)
    hold = trace.hold(rule, "exact")
    assert hold.exact[0, 0] == pytest.approx(0.35 - 0.24, abs=1e-4)
    assert hold.exact[0, 1] == pytest.approx(np.pi), "lost while it was held"
    assert np.isnan(hold.exact[0, 2]) and np.isnan(hold.error[0, 2]), "never stopped"
    assert trace.hold(StoppingRule(0.3, 2.0), "exact") is None
    assert env.held == 24 and env.tables[:4] == [(5, 8), (6, 8), (7, 8), (8, 8)], "the table goes in its time"
    assert trace.exact[0, 0, 12] == pytest.approx(0.35, abs=1e-5), "the record itself is not changed"
    assert trace.of([0]).hold(rule, "exact").exact.shape == (1, 3)


def test_success_is_reported_at_the_stop_and_after_the_hold():
    objects = [FakeObject("a"), FakeObject("b")]
    env = HeldEnv(objects, num_envs=4, max_episode_steps=24, tolerance=NEVER_RAD, lost=[1])
    rules = ways_to_stop(lambda _: StoppingRule(0.3, 2.5), 0.4, predicts=True)
    assert [(w.stopped_by, w.rule.action_norm, bool(w.ours)) for w in rules] == [
        ("prediction", 1.0, False),
        ("true distance", 1.0, False),
        ("prediction", 2.5, True),
    ], "the paper's bound is the headline, the student's own stands below"
    trace = record(
        env,
        Turner(env, until=6, offset=0.0),
        2,
        **goal_ahead(0.85, 2, 2),
        held=[(way.rule, way.by) for way in rules],
    )
    rows = judge(
        trace,
        protocol(2),
        objects,
        policy="s",
        kind="vision",
        sees="rendered clouds",
        group="g",
        rules=lambda _: StoppingRule(0.3, 2.5),
    )
    assert [row.ours for row in rows] == ["", "", OWN_NORM]
    assert [row.overall.outcomes["success"].value for row in rows] == [1.0, 1.0, 1.0]
    assert [row.held.value for row in rows] == [0.75, 0.75, 0.75]


def test_what_predicts_nothing_is_judged_by_the_success_criteria_of_training_too():
    """It comes within 0.4 rad after five steps and is not still before the seventh."""
    trace = traced(policy={"until": 6})
    told = dict(policy="p", kind="teacher", sees="state", group="g", rules=lambda _: StoppingRule())
    rows = judge(trace, protocol(1), [FakeObject("a")], **told)
    assert [row.stopped_by for row in rows] == ["true distance", SUCCESS]
    assert [row.episodes[0].steps for row in rows] == [5, 7]
    assert rows[1].episodes[0].error_rad == pytest.approx(0.25, abs=1e-5)
    assert rows[1].precise.value == 0.0 and rows[1].held is None
    assert [row.headline for row in rows] == [True, False]
    with pytest.raises(ValueError, match="does not know what is still"):
        replace(trace, still=None).ends(StoppingRule(), "success")


def test_a_world_whose_step_failed_ends_there():
    """The simulator puts it back and lets its time run out; what follows is of another episode."""
    env = fake_env(envs=2)
    step = env.step

    def failing(action):
        count = int(env.step_count.numpy()[0])
        step(action)
        env.done.numpy()[0] |= count == 2

    env.step = failing
    trace = record(env, Turner(env), 2, **goal_ahead(0.85, 1, 2))
    assert trace.steps.tolist() == [[3, 12]] and not trace.fell.any()
    assert np.isnan(trace.exact[0, 0, 4:]).all()


def test_the_table_goes_and_comes_back():
    env = fake_env(envs=1, steps=6)
    record(env, Turner(env), 2, **goal_ahead(1.0, 1, 2), table_steps=2)
    assert env.table == [(0, True), (2, False), (0, True), (2, False), (0, True)]


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


def compared(offset=-0.3, fall_at=None, rules=lambda _: StoppingRule(0.2)):
    objects = (FakeObject("a"), FakeObject("b", warnings=("open", "parts are off")))
    trace = traced(objects=objects, episodes=4, policy={"offset": offset}, fall_at=fall_at)
    return judge(
        trace,
        protocol(4),
        list(objects),
        policy="student.pt",
        kind="tracking",
        sees="complete clouds",
        group="training",
        rules=rules,
    )


def test_every_episode_is_in_one_class():
    rows = compared(fall_at={1: 2, 5: 12})
    assert [row.stopped_by for row in rows] == ["prediction", "true distance"]
    assert Result(tuple(rows)).warnings == {"b": "open; parts are off"}
    by_prediction, by_truth = ({k: v.value for k, v in row.overall.outcomes.items()} for row in rows)
    assert tuple(by_prediction) == OUTCOMES
    # It stops at 0.45 rad by its prediction, and at 0.35 by the truth; one fell before, one long after.
    assert by_prediction == pytest.approx(dict(zip(OUTCOMES, (0.0, 7 / 8, 0.0, 1 / 8), strict=True)))
    assert by_truth == pytest.approx(dict(zip(OUTCOMES, (7 / 8, 0.0, 0.0, 1 / 8), strict=True)))
    assert rows[1].overall.time_s.value == pytest.approx(5 / 12) and rows[0].overall.time_s is None
    assert [one.outcomes["object falls"].value for one in rows[0].per_object] == [0.25, 0.0]
    never = compared(offset=5.0)
    assert never[0].overall.outcomes["time-out"].value == 1.0


def test_what_predictions_are_worth():
    by_prediction, by_truth = compared()
    prediction, true = by_prediction.prediction, np.abs(0.85 - STEP_RAD * np.arange(12))
    assert prediction.states == 8 * 12 and by_truth.prediction is None
    assert prediction.mean_error_rad == pytest.approx(0.3, abs=1e-4)
    said = true - 0.3 <= 0.4
    assert list(prediction.seen) == ["0.1", "0.4"]
    assert prediction.seen["0.4"] == 1.0
    assert prediction.right["0.4"] == pytest.approx((true[said] <= 0.4).mean())
    sure = compared(offset=0.0, rules=StoppingRule)
    assert list(sure[0].prediction.right.values()) == [1.0, 1.0]
    assert sure[0].precise == sure[1].precise


def test_each_tolerance_has_its_own_rule():
    """Predictions are 0.3 rad too small; the rule for 0.4 rad knows of it, the one for 0.1 does not."""
    bounds = {0.1: 0.1, 0.4: 0.05}
    by_prediction, by_truth = compared(rules=lambda tolerance: StoppingRule(bounds[tolerance]))
    assert by_prediction.rule.distance_rad == 0.05 and by_truth.rule.distance_rad == 0.4
    assert by_prediction.overall.outcomes["success"].value == 1.0 and by_prediction.precise.value == 0.0
    assert by_truth.precise.value == 1.0


def test_a_result_is_read_as_it_was_written(tmp_path):
    result = Result(tuple(compared()), {"torch": "2"}, (("air", "p", "out of time"),))
    result.write(tmp_path / "eval.json")
    assert Result.read(tmp_path / "eval.json") == result
    (tmp_path / "x.json").write_text('{"format": 1}')
    with pytest.raises(ValueError, match="run vd-eval again"):
        Result.read(tmp_path / "x.json")


def test_policies_on_the_same_episodes_are_compared_in_pairs():
    row = compared()[1]  # succeeds in all episodes
    lost = tuple(replace(e, stopped=e.object_index == 0) for e in row.episodes)
    other = replace(row, policy="other", episodes=lost)
    rows = [replace(one, kind="teacher", sees="state") for one in (row, other)]
    ((first, second, difference),) = Result(tuple(rows)).differences()
    assert (first.policy, second.policy, difference.value) == ("student.pt", "other", -0.5)


def test_groups_of_objects():
    assert parse_groups(["cube"]) == {"objects": ("cube",)}
    assert parse_groups(["training=a", "held-out=b", "training=c"]) == {
        "training": ("a", "c"),
        "held-out": ("b",),
    }


def test_without_a_table_objects_fall_and_it_comes_back():
    class Still:
        def act(self, observation):
            """Nothing: open fingers hold nothing."""
            return torch.zeros((3, 9))

    # Over a second long: the solver is told of new frictions in between.
    # Frictions and gains are handed to the solver now and then, which must not move the table. No
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
    starts, goals = (np.tile(quat, (1, 3, 1)) for quat in ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]))
    settings = dict(starts=starts, goals=goals)
    rests = record(env, Still(), 3, **settings)
    falls = record(env, Still(), 3, **settings, table_steps=24)
    again = record(env, Still(), 3, **settings)
    assert not rests.fell.any() and not again.fell.any()
    assert falls.fell.all() and (falls.steps > 24).all() and (falls.steps <= 28).all()
    env.check()
