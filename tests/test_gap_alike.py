"""What is alike: the joints of a finger, and causes that no recording tells apart."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_gap_fit import TRUE, problem_of, recorded
from test_gap_judge import FLOOR, made_up

import vd.kernels.servo.actuators as servo
from vd.gap import consensus, judge
from vd.gap.chain import candidates
from vd.gap.coordinates import Coordinate, Scales
from vd.gap.explanation import Accepted, Explanation, Trial, lacking
from vd.gap.fit import JointProblem
from vd.gap.hide import Hiding, simulate_hidden
from vd.gap.jitter import CALLS
from vd.gap.joint_fit import JointFit
from vd.gap.joints import _in_turn
from vd.gap.one_joint import Joint, beside, steady
from vd.gap.result import Verdict
from vd.gap.rollout import Rollouts
from vd.gap.select import Selection
from vd.gap.statistics import resamples
from vd.gap.team import JointSpec
from vd.gap.words import verdict_sentence
from vd.gap.workflow import explain

FRICTION = 0.08
CHOSEN = ("coulomb_friction", "command_delay", "torque_saturation", "gravity_load", "thermal_drift")


class Servo:
    """A servo with friction, or what else is hidden, its plain model, and how often fits are asked for."""

    def __init__(
        self,
        friction: float = FRICTION,
        hidden: dict[int, float] | None = None,
        chosen: tuple[str, ...] = CHOSEN,
    ) -> None:
        self.chosen = chosen
        self.problem: JointProblem = problem_of(recorded(hidden or {servo.COULOMB_TORQUE: friction}))
        base = self.problem.rollouts.chain.start_row.copy()
        for column, value in TRUE.items():
            base[0, column] = value
        self.scales = self.problem.scales(base[0], self.problem.floor)
        self.baseline: JointFit = self.problem.fit(base, (), [{}], self.scales)
        self.fits = 0

    def explain(self, like: tuple[tuple[str, ...], dict[str, float]]) -> Explanation:
        """What a search finds that knows what another joint lacks."""
        return self.selection(like).explain(self.baseline)

    def selection(self, like: tuple[tuple[str, ...], dict[str, float]]) -> Selection:
        """The search."""
        self.fits = 0

        def run(calls: list) -> list:
            self.fits += sum(name == "fit" for name, _ in calls)
            return [
                CALLS[name](self.problem, **options)
                if name in CALLS
                else getattr(self.problem, name)(**options)
                for name, options in calls
            ]

        return Selection(
            floor=self.problem.floor,
            weights=resamples(len(self.problem.trajectories), np.random.default_rng(0)),
            run=run,
            joint=0,
            others=(),
            candidates=candidates(self.problem.rollouts.chain, self.chosen),
            scales=self.scales,
            refits=3,
            like=like,
        )


def test_a_joint_lacks_what_another_of_its_finger_lacks_where_that_leaves_noise() -> None:
    joint = Servo()
    found = joint.explain(((), {}))
    alone = joint.fits
    effects, values = lacking(found)
    assert effects == ("coulomb_friction",)
    again = joint.explain((effects, {key: 1.3 * value for key, value in values.items()}))
    assert joint.fits == 2 < alone, "with the effect, and without"
    assert again.verdict == "effects" and [one.name for one in again.accepted] == ["coulomb_friction"]
    assert again.final.values["coulomb_friction.tau_c_nm"] == pytest.approx(FRICTION, rel=0.1)
    rows = {(row.name, row.decision, row.placebo) for row in again.trials}
    assert rows == {("coulomb_friction", "named", False), ("coulomb_friction", "rejected", True)}


@pytest.mark.parametrize(
    ("effects", "values"),
    [
        (("command_delay",), {"command_delay.delay_s": 0.02}),
        (
            ("coulomb_friction", "thermal_drift"),
            {"coulomb_friction.tau_c_nm": FRICTION, "thermal_drift.rate_per_s": 0.02},
        ),
    ],
    ids=["another cause", "one too many"],
)
def test_a_joint_that_lacks_something_else_is_searched_by_itself(
    effects: tuple[str, ...], values: dict[str, float]
) -> None:
    found = Servo().explain((effects, values))
    assert found.verdict == "effects" and [one.name for one in found.accepted] == ["coulomb_friction"]


def test_a_joint_may_lack_the_fuller_form_of_what_another_lacks() -> None:
    """A slow joint shows the ceiling of the torque alone; on a quick one the search missed the line."""
    line = {servo.STALL_TORQUE: 0.35, servo.NO_LOAD_SPEED: 3.0}
    joint = Servo(hidden=line, chosen=(*CHOSEN, "torque_limit", "torque_speed_limit"))
    found = joint.explain((("torque_limit",), {"torque_limit.tau_max_nm": 0.35}))
    assert found.verdict == "effects" and [one.name for one in found.accepted] == ["torque_speed_limit"]
    assert found.reason.startswith("torque_speed_limit") and joint.fits < 8, "without a search"
    assert found.final.values["torque_speed_limit.omega_0_rad_s"] == pytest.approx(3.0, rel=0.1)


def test_what_another_joint_lacks_is_not_named_where_it_is_too_small_to_show(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It leaves noise, and gains less on the plain model than an effect must: nothing else is tried."""
    monkeypatch.setattr(judge, "MIN_GAIN_FLOORS", 0.9)
    joint = Servo(0.0026)
    floors = joint.baseline.held_out_rmse / joint.problem.floor
    assert 1.15 < floors < 1.3, "the plain model is not enough"
    found = joint.explain((("coulomb_friction",), {"coulomb_friction.tau_c_nm": FRICTION}))
    assert found.verdict == "no_gap" and "below the noise floor" in found.reason
    assert joint.fits == 2


@pytest.mark.parametrize(
    ("least", "named"), [(0.01, True), (-0.09, False)], ids=["gains", "may gain nothing"]
)
def test_what_another_joint_lacks_is_named_however_small_where_the_rest_does_not_explain_a_joint(
    monkeypatch: pytest.MonkeyPatch, least: float, named: bool
) -> None:
    """Both of a delay and a load were less than an effect must gain: a filter was named in their place."""
    joint = Servo()
    search = joint.selection(
        (
            ("coulomb_friction", "thermal_drift"),
            {"coulomb_friction.tau_c_nm": FRICTION, "thermal_drift.rate_per_s": 0.02},
        )
    )
    both, alone = made_up(search.like[0], FLOOR), made_up(("coulomb_friction",), 1.2 * FLOOR)
    search.floor = FLOOR
    search.run = lambda calls: [both if name == "fit" else np.zeros(1) for name, _ in calls]
    search.refit = lambda fit, rest: alone  # type: ignore[method-assign]
    search.better = lambda *_: (False, "below the noise floor")  # type: ignore[method-assign]
    search.gain = lambda *_: (0.1, (least, 0.2))  # type: ignore[method-assign]
    search.noise_only = lambda fit, _: fit is both  # type: ignore[method-assign, assignment]
    search.too_coarse = lambda fit: False  # type: ignore[method-assign]
    search.refined = lambda fit: fit  # type: ignore[method-assign]
    search.conclude = (  # type: ignore[method-assign]
        lambda baseline, fit, *_: Explanation(baseline, fit, "effects", "")
    )
    search.explained = lambda found: found  # type: ignore[method-assign]
    asked: list[tuple[str, ...]] = []

    def simpler(inner: Selection, *_: object) -> None:
        asked.append(inner.like[0])

    real = consensus.as_another
    monkeypatch.setattr(consensus, "as_another", simpler)
    found = real(search, joint.baseline, "")
    assert asked[0] == ("thermal_drift",), "the rest was not tried alone"
    assert (found is not None and found.final is both) == named


def test_chance_is_no_cause_on_a_joint_where_another_is_explained_without() -> None:
    joint = Joint("tip", JointSpec(0, 1, (0,), (0,), FLOOR, ()), Scales(*[1.0] * 8), made_up((), 0.01))

    def found(*names: str, left: float = FLOOR, verdict: Verdict = "effects") -> Explanation:
        return Explanation(joint.fit, made_up(names, left), verdict, "")

    assert steady(joint, found("command_filter", "torque_limit"))
    assert not steady(joint, found("command_filter", left=1.5 * FLOOR)), "chance may be what is left"
    assert not steady(joint, found("command_filter", verdict="unknown"))
    assert not steady(joint, found("command_delay", "torque_limit")), "it may be the mean of random delays"
    assert not steady(joint, found("command_jitter"))


def test_on_a_pendulum_a_load_off_the_arm_and_an_offset_of_the_encoder_are_one(tmp_path: Path) -> None:
    load = {"gravity_load": {"tau_g_nm": 0.07, "phase_rad": 0.4}}
    (hidden,) = simulate_hidden([Hiding("pendulum", load, seed=5)])
    chosen = ("encoder_bias", "gravity_load", "coulomb_friction", "command_delay")
    report = explain(hidden.recording, None, tmp_path, effects=chosen, workers=1)
    assert [effect.name for effect in report.effects] == ["encoder_bias"]
    assert report.ambiguous == (("encoder_bias", "gravity_load"),)
    assert report.open_sets == () and report.next_experiment == ""
    assert "stands for gravity load too" in verdict_sentence(report)


STRIBECK = {servo.STRIBECK_STATIC: 0.13, servo.STRIBECK_SLIDING: 0.07, servo.STRIBECK_SPEED: 0.4}
PULL_NM = 0.02
"""Of an offset: half the difference of both sides of the friction that moves the joint alike."""


def test_beside_stribeck_friction_an_offset_moves_a_joint_as_friction_with_a_direction_does() -> None:
    problem = problem_of(recorded({}))
    plain = problem.rollouts.chain.start_row.copy()
    plain[0, list(TRUE)] = list(TRUE.values())
    offset, sides = plain.copy(), plain.copy()
    offset[0, list(STRIBECK)] = list(STRIBECK.values())
    sides[:] = offset
    offset[0, servo.ENCODER_BIAS] = PULL_NM / TRUE[servo.KP]
    sides[0, [servo.STRIBECK_STATIC, servo.STRIBECK_SLIDING]] -= PULL_NM
    sides[0, servo.FRICTION_MINUS] = 2.0 * PULL_NM
    paths = problem.rollouts.predict(np.stack([offset, sides, plain]))
    assert np.abs(paths[0] - paths[1]).max() < 1e-6
    assert np.abs(paths[0] - paths[2]).max() > 1e-2


@pytest.mark.parametrize("hidden", [{servo.ENCODER_BIAS: 0.008}, {servo.FRICTION_PLUS: 0.05}])
def test_beside_stribeck_friction_an_offset_stands_for_friction_with_a_direction(
    hidden: dict[int, float], tmp_path: Path
) -> None:
    chosen = ("stribeck_friction", "asymmetric_friction", "coulomb_friction", "encoder_bias", "command_delay")
    report = explain(recorded({**STRIBECK, **hidden}), None, tmp_path, effects=chosen, workers=1)
    assert {effect.name for effect in report.effects} == {"stribeck_friction", "encoder_bias"}
    assert report.ambiguous == (("encoder_bias", "asymmetric_friction"),)
    assert report.open_sets == () and report.next_experiment == ""
    assert "Encoder bias stands for asymmetric friction too" in verdict_sentence(report)


def test_an_offset_that_pulls_more_than_friction_holds_is_no_friction() -> None:
    keys = ("encoder_bias.bias_rad", "stribeck_friction.tau_c_nm")
    rows = np.zeros((1, servo.PARAMETER_COLUMNS))
    rows[0, servo.KP] = 3.0
    search = Servo().selection(((), {}))
    for sliding, same in ((0.03, ("asymmetric_friction",)), (0.02, ())):
        fit = replace(
            made_up(("stribeck_friction", "encoder_bias"), FLOOR),
            coordinates=tuple(Coordinate(key, 0, False, 1.0, -9.0, 9.0) for key in keys),
            x=np.array([-0.008, sliding]),
            rows=rows,
        )
        assert search.same_beside(fit, "encoder_bias") == same
        assert search.same_beside(fit, "stribeck_friction") == ()


@pytest.mark.parametrize(("line", "again"), [(0.98, True), (0.9999, False)])
def test_a_set_is_judged_beside_the_best_member_of_another(line: float, again: bool) -> None:
    """What a limit leaves where a line is would else decide whether friction or a dead zone is beside it."""
    selection = Servo().selection(((), {}))
    floor = selection.floor
    final = made_up(("coulomb_friction", "torque_limit"), floor)
    better = made_up(("coulomb_friction", "torque_speed_limit"), line * floor)
    dead = made_up(("torque_limit", "dead_zone"), 1.002 * floor)
    selection.weights = resamples(len(final.sse), np.random.default_rng(0))
    sets = [
        Accepted(name, 0.8, {}, (), (other,), False)
        for name, other in (("coulomb_friction", "dead_zone"), ("torque_limit", "torque_speed_limit"))
    ]
    fits = {"coulomb_friction": [final, dead], "torque_limit": [final, better]}
    result = Explanation(final, final, "ambiguous", "", tuple(sets), (), fits)
    asked: list[tuple[tuple[str, ...], str]] = []

    def rivals(present: JointFit, name: str) -> list[JointFit]:
        asked.append((present.effects, name))
        return [present]

    selection.rivals = rivals  # type: ignore[method-assign, assignment]
    found = selection.beside_better(result, final)
    assert asked == ([(("torque_speed_limit", "coulomb_friction"), "coulomb_friction")] if again else [])
    assert {*found} == ({"coulomb_friction"} if again else set())
    assert not selection.beside_better(replace(result, verdict="effects"), final), "a name stands"


def test_a_finer_problem_is_simulated_with_the_step_of_finished_estimates() -> None:
    problem = problem_of(recorded({servo.TORQUE_LIMIT: 0.8}))
    row = problem.rollouts.chain.start_row.copy()
    row[0, servo.TORQUE_LIMIT] = 0.8
    exact = Rollouts(problem.rollouts.chain, problem.rollouts.recording, dt=problem.rollouts.dt / 4)
    left = problem.rollouts.measured[:, 0] - exact.predict(row[None], joint=0)[0]
    assert problem.finer().residuals(row[None])[0] == pytest.approx(left)
    assert problem.residuals(row[None])[0] != pytest.approx(left)
    scales = problem.scales(row[0], problem.floor)
    fit = problem.fit(row, ("torque_limit",), [{}], scales)
    one, other = (each.refine(fit, scales) for each in (problem, problem.finer()))
    assert one.x == pytest.approx(other.x), "refined as before"


@pytest.mark.parametrize("restarts", [0, 1], ids=["first search", "another"])
@pytest.mark.parametrize(("refined", "again"), [(0.8, True), (0.95, False)])
def test_a_search_that_its_time_step_holds_up_is_made_with_a_finer_one(
    refined: float, again: bool, restarts: int
) -> None:
    baseline, found = made_up((), 0.1), made_up(("acceleration_limit",), 1.5 * FLOOR)
    asked = []

    class EndError(Exception):
        pass

    def run(calls: list) -> list:
        asked.extend((name, bool(options.get("finer"))) for name, options in calls)
        if calls[0][0] == "refine":
            return [made_up(found.effects, refined * 1.5 * FLOOR)]
        raise EndError

    selection = Selection(
        floor=FLOOR,
        weights=resamples(10, np.random.default_rng(0)),
        run=run,
        joint=0,
        others=(),
        candidates=(),
        scales=Scales(3.0, 0.5, 2.0, 6.0, 70.0, 1e-3, 1e-3, 12.0),
        restarts=restarts,
        clocked=True,
    )
    result = found, {"acceleration_limit": [found]}, []
    far = made_up(("torque_limit",), 20.0 * FLOOR)
    rows = [Trial(1, "acceleration_limit", made_up(found.effects, 0.05), 0.5, (0.4, 0.6), "tied")]
    first = result if not restarts else (far, {"torque_limit": [far]}, rows)
    selection.first = lambda _: first  # type: ignore[method-assign]
    selection.search = lambda *_: result  # type: ignore[method-assign]
    assert selection.too_coarse(found) == again
    with pytest.raises(EndError):
        selection.explain(baseline)
    assert asked[-1] == (("fit", True) if again else ("again", False))


def test_a_finger_is_explained_from_its_tip_on_each_joint_beside_those_before() -> None:
    """What the others were found to have is in the rows of a joint's chain, chance aside."""

    def made(name: str, chain: int, joint: int) -> Joint:
        fit = replace(made_up((), 0.01), rows=np.full((3, servo.PARAMETER_COLUMNS), 0.5))
        return Joint(name, JointSpec(chain, joint, (0,), (0,), FLOOR, ()), Scales(*[1.0] * 8), fit)

    def explained(joint: Joint, known: list) -> Explanation:
        seen[joint.name] = [other.name for other, _ in known]
        rows = joint.fit.rows + joint.spec.joint + 1.0
        final = replace(made_up(("backlash", "command_jitter"), FLOOR), rows=rows)
        return Explanation(joint.fit, final, "effects", joint.name)

    seen: dict[str, list[str]] = {}
    joints = [made("a1", 0, 0), made("b1", 1, 0), made("a2", 0, 1), made("a3", 0, 2)]
    found = _in_turn(joints, explained)
    assert [each.reason for each in found] == ["a1", "b1", "a2", "a3"]
    assert seen == {"a3": [], "a2": ["a3"], "a1": ["a3", "a2"], "b1": []}
    rows = beside(joints[2], list(zip(joints, found, strict=True)))
    chance = [servo.JITTER_SIGMA, servo.JITTER_DROP]
    assert rows[:, servo.KP].tolist() == [1.5, 0.5, 3.5] and not rows[[0, 2]][:, chance].any()


@pytest.mark.parametrize("first", ["command_delay", "backlash"])
def test_a_fixed_delay_before_chance_was_found_on_another_joint_is_looked_at_again(first: str) -> None:
    def explained(joint: Joint, known: list, own: Explanation | None = None) -> Explanation:
        asked.append((joint.name, [other.name for other, _ in known], own is not None))
        name = first if joint.name == "tip" and own is None else "command_jitter"
        return Explanation(joint.fit, made_up((name,), FLOOR), "effects", name)

    asked: list[tuple[str, list[str], bool]] = []
    specs = {name: JointSpec(0, i, (0,), (0,), FLOOR, ()) for i, name in enumerate(("palm", "tip"))}
    joints = [Joint(name, spec, Scales(*[1.0] * 8), made_up((), 0.01)) for name, spec in specs.items()]
    found = [each.reason for each in _in_turn(joints, explained)]
    again = [("tip", ["palm"], True)] if first == "command_delay" else []
    assert asked == [("tip", [], False), ("palm", ["tip"], False), *again]
    assert found == ["command_jitter", "command_jitter" if again else first]
