"""Selection of effects: the rules on made-up fits, and whole analyses of small recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_gap_fit import recorded

import vd.kernels.actuators as servo
from vd.gap.consensus import share
from vd.gap.coordinates import Coordinate, Scales
from vd.gap.explanation import Accepted, Explanation, Trial, intervals
from vd.gap.fit import JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.recording import Recording
from vd.gap.result import Predictions, Report
from vd.gap.select import Selection
from vd.gap.statistics import resamples
from vd.gap.telemetry import vetoes
from vd.gap.verdict import Verdicts, cancelled
from vd.gap.words import verdict_sentence
from vd.gap.workflow import explain, find
from vd.kernels.effects import EFFECTS

FLOOR = 1e-3
COUNT = np.full(10, 500.0)
SMALL = ("command_delay", "coulomb_friction", "torque_saturation", "thermal_drift", "command_filter")


def made_up(effects: tuple[str, ...], errors: np.ndarray | float, fitted: float | None = None) -> JointFit:
    """A fit with given held-out RMSE of each trajectory [rad]."""
    held_out = COUNT * np.broadcast_to(errors, COUNT.shape) ** 2
    size = 3 + len(effects)
    return JointFit(
        effects=effects,
        coordinates=tuple(Coordinate(f"p{i}", i, False, 1.0, -9.0, 9.0) for i in range(size)),
        x=np.zeros(size),
        rows=np.zeros((1, servo.PARAMETER_COLUMNS)),
        sse=held_out if fitted is None else COUNT * fitted**2,
        held_out=held_out,
        count=COUNT,
        gram=np.tile(np.eye(size), (10, 1, 1)),
        gradient=np.zeros((10, size)),
    )


@pytest.fixture
def judge() -> Verdicts:
    return Verdicts(floor=FLOOR, weights=resamples(10, np.random.default_rng(0)))


def test_gain_must_hold_over_trajectories(judge: Verdicts) -> None:
    before = made_up((), 0.010)
    assert judge.better(before, made_up(("backlash",), 0.005))[0]
    assert not judge.better(before, made_up(("backlash",), 0.0097))[0]
    # One trajectory gains much, others lose a little: the interval over trajectories covers 0.
    uneven = np.full(10, 0.0102)
    uneven[0] = 0.0
    assert not judge.better(before, made_up(("backlash",), uneven))[0]


def test_what_is_under_the_noise_floor_is_no_gain(judge: Verdicts) -> None:
    accepted, why = judge.better(made_up((), 1.15e-3), made_up(("backlash",), 1.05e-3))
    assert not accepted and "noise floor" in why


def test_a_tie_is_a_set(judge: Verdicts) -> None:
    rng = np.random.default_rng(1)
    winner = made_up(("coulomb_friction",), 0.004)
    noise = rng.normal(0.0, 1e-3, 10)
    assert judge.tied(winner, made_up(("dead_zone",), 0.004 + noise - noise.mean()))[0]
    assert not judge.tied(winner, made_up(("backlash",), 0.006))[0]


def test_at_the_floor_samples_decide(judge: Verdicts) -> None:
    """An explained recording tells candidates apart even if one motion alone shows the difference."""
    errors = np.full(10, FLOOR)
    winner = made_up(("coulomb_friction",), errors)
    errors = errors.copy()
    errors[3] = 1.5 * FLOOR
    assert not judge.tied(winner, made_up(("dead_zone",), errors))[0]
    assert judge.tied(winner, made_up(("dead_zone",), FLOOR))[0]


def test_the_simpler_of_nested_effects_wins_a_tie(judge: Verdicts) -> None:
    simple = made_up(("coulomb_friction",), 1.000e-3)
    complex_ = made_up(("stribeck_friction",), 0.970e-3, fitted=0.999e-3)
    assert judge.winner([complex_, simple]) is simple
    better = made_up(("stribeck_friction",), 1.0e-3)
    worse = made_up(("coulomb_friction",), 1.6e-3)
    assert judge.winner([better, worse]) is better


def test_at_the_floor_the_samples_choose_not_the_luck_of_a_motion(judge: Verdicts) -> None:
    right = made_up(("coulomb_friction",), 1.06 * FLOOR, fitted=1.00 * FLOOR)
    lucky = made_up(("dead_zone",), 1.01 * FLOOR, fitted=1.02 * FLOOR)
    assert judge.winner([lucky, right]) is right
    far = made_up(("dead_zone",), 5.0 * FLOOR, fitted=6.0 * FLOOR)
    farther = made_up(("coulomb_friction",), 5.5 * FLOOR, fitted=5.0 * FLOOR)
    assert judge.winner([far, farther]) is far, "away from it unseen motions do"


def test_a_small_excess_tells_apart_only_if_most_motions_show_it(judge: Verdicts) -> None:
    winner = made_up(("coulomb_friction",), FLOOR)
    everywhere = np.full(10, np.sqrt(1.01) * FLOOR)
    assert not judge.tied(winner, made_up(("dead_zone",), everywhere))[0]
    assert judge.tied(winner, made_up(("dead_zone",), everywhere), loose=True)[0]
    somewhere = np.full(10, np.sqrt(0.996) * FLOOR)
    somewhere[:2] = np.sqrt(1.07) * FLOOR  # the same in all, but most motions say the opposite
    assert judge.tied(winner, made_up(("dead_zone",), somewhere))[0]
    slightly = made_up(("dead_zone",), np.sqrt(1.002) * FLOOR)
    assert judge.tied(winner, slightly)[0], "what models leave"
    richer = replace(slightly, x=np.zeros(len(slightly.x) + 2))
    assert not judge.tied(winner, richer)[0], "more parameters that do worse"
    assert judge.tied(winner, replace(richer, sse=0.999 * winner.sse))[0]


def test_a_fuller_form_that_is_a_little_better_makes_a_set(judge: Verdicts) -> None:
    limit = made_up(("torque_limit",), FLOOR)
    for excess, tied in ((0.993, ("torque_speed_limit",)), (0.999, ()), (1.01, ())):
        line = made_up(("torque_speed_limit",), np.sqrt(excess) * FLOOR)
        assert judge.accept(limit, "torque_limit", [limit, line], {}, limit).tied == tied
    friction = made_up(("coulomb_friction",), FLOOR)
    fuller = made_up(("stribeck_friction",), np.sqrt(0.993) * FLOOR)
    assert judge.accept(friction, "coulomb_friction", [friction, fuller], {}, friction).tied == ()


def test_a_load_and_an_offset_that_cancel_at_rest_are_a_spring() -> None:
    def fit(torque: float, phase: float, bias: float) -> JointFit:
        plain = made_up(("gravity_load", "encoder_bias"), FLOOR)
        keys = ("gravity_load.tau_g_nm", "gravity_load.phase_rad", "encoder_bias.bias_rad")
        some = tuple(Coordinate(key, 0, False, 1.0, -9.0, 9.0) for key in keys)
        rows = plain.rows.copy()
        rows[0, servo.KP] = 3.0
        x = np.array([0.0, 0.0, torque, phase, bias])
        return replace(plain, coordinates=(*plain.coordinates[:2], *some), x=x, rows=rows)

    assert "spring" in cancelled(fit(0.015, -1.15, -0.00457), 0, 0.0)
    assert cancelled(fit(0.015, -1.15, 0.00457), 0, 0.0) == "", "together they hold it off"
    assert cancelled(fit(0.015, -1.15, -0.0065), 0, 0.0) == ""
    assert cancelled(fit(0.015, -1.15, -0.00457), 0, 0.8) == "", "and elsewhere it rests elsewhere"
    assert cancelled(made_up(("gravity_load",), FLOOR), 0, 0.0) == ""


def test_friction_with_a_direction_stands_for_dry_friction_and_an_offset(tmp_path: Path) -> None:
    hidden = {servo.FRICTION_PLUS: 0.09, servo.FRICTION_MINUS: 0.04}
    effects = ("coulomb_friction", "asymmetric_friction", "encoder_bias", "gravity_load")
    report = analysed(recorded(hidden), tmp_path, effects=effects)
    assert [effect.name for effect in report.effects] == ["asymmetric_friction"]
    assert report.ambiguous == (("asymmetric_friction", "coulomb_friction", "encoder_bias"),)
    assert report.open_sets == () and "stands for" in verdict_sentence(report)


@pytest.mark.parametrize(("excess", "merged"), [(1.0, True), (1.1, False)])
def test_dry_friction_and_an_offset_are_put_together_where_one_cause_does_as_well(
    excess: float, merged: bool
) -> None:
    one = made_up(("torque_limit", "asymmetric_friction"), FLOOR * np.sqrt(excess))
    two = made_up(("torque_limit", "coulomb_friction", "encoder_bias"), FLOOR)
    scales = Scales(3.0, 0.5, 2.0, 6.0, 70.0, 1e-3, 1e-3, 12.0)

    def run(calls: list[tuple[str, dict[str, object]]]) -> list[object]:
        wanted = [tuple(options["effects"]) for _, options in calls]  # type: ignore[arg-type]
        return [one if effects == one.effects else made_up(effects, 0.01) for effects in wanted]

    selection = Selection(
        floor=FLOOR,
        weights=resamples(10, np.random.default_rng(0)),
        run=run,  # type: ignore[arg-type]
        joint=0,
        others=(),
        candidates=("asymmetric_friction", *two.effects),
        scales=scales,
    )
    found = selection.put_together(two)
    assert (found is one) == merged and (found is two) != merged
    assert selection.apart == ({"asymmetric_friction": two} if merged else {})
    assert selection.put_together(one) is one, "nothing to put together"


def test_a_bound_is_no_estimate(judge: Verdicts) -> None:
    stuck = made_up(("backlash",), 0.004)
    end = Coordinate("backlash.width_rad", servo.BACKLASH_WIDTH, False, 1.0, 0.0, 9.0)
    stuck = replace(stuck, coordinates=(*stuck.coordinates[:-1], end), x=np.array([0.0, 0.0, 0.0, 9.0]))
    inside = made_up(("dead_zone",), 0.005)
    assert stuck.at_bound == ("backlash.width_rad",)
    assert judge.winner([stuck, inside]) is inside


def test_sets_of_several_joints_meet_in_one_name() -> None:
    def explanation(name: str, *tied: str) -> Explanation:
        accepted = Accepted(name, 0.6 if tied else 1.0, {}, (), tied, False)
        fits = [made_up((other,), 0.01) for other in (name, *tied)]
        verdict = "ambiguous" if tied else "effects"
        return Explanation(made_up((), 0.02), fits[0], verdict, "", (accepted,), (), {name: fits})

    def names(*explanations: Explanation, groups: list[int] | None = None) -> list[str]:
        shared = share(explanations, [FLOOR] * len(explanations), groups)
        return [e.accepted[0].name if e.accepted[0].named else "?" for e in shared]

    one, other = explanation("backlash", "dead_zone"), explanation("backlash", "coulomb_friction")
    assert names(one, other) == ["backlash", "backlash"]
    assert names(one, explanation("backlash")) == ["backlash", "backlash"]
    assert names(one, explanation("dead_zone")) == ["dead_zone", "dead_zone"]
    assert names(one, explanation("thermal_drift")) == ["?", "thermal_drift"]
    assert names(one) == ["?"]
    # Separate servos share gravity, not the play of one gear.
    assert names(one, explanation("backlash"), groups=[0, 1]) == ["?", "backlash"]
    # What is worse by more than an effect must gain is not adopted, unless it was not fitted to the end.
    poor = explanation("dead_zone", "backlash")
    poor.rivals["dead_zone"][1] = made_up(("backlash",), 0.013)  # type: ignore[index]
    assert names(poor, explanation("backlash")) == ["?", "backlash"]
    ended = [lambda fit: made_up(fit.effects, 0.0102)] * 2
    shared = share([poor, explanation("backlash")], [FLOOR] * 2, polish=ended)
    assert [e.accepted[0].name for e in shared] == ["backlash"] * 2 and shared[0].accepted[0].named
    assert shared[0].final.held_out_rmse == pytest.approx(0.0102)
    loaded = explanation("encoder_bias", "gravity_load")
    assert names(loaded, explanation("gravity_load"), groups=[0, 1]) == ["gravity_load", "gravity_load"]
    # What another joint adds to a name is said, too.
    dry = explanation("coulomb_friction").accepted
    both = replace(
        loaded, verdict="effects", accepted=(*dry, *loaded.accepted), reason="friction explains it"
    )
    adopted = share([both, explanation("gravity_load")], [FLOOR] * 2, [0, 1])[0]
    assert adopted.reason == "coulomb_friction and gravity_load explain it, as on the other joints"


@pytest.mark.parametrize(("floor", "tied"), [(FLOOR, ("supply_sag",)), (10.0 * FLOOR, ())])
def test_forms_of_one_loss_are_a_set_only_far_from_the_floor(floor: float, tied: tuple[str, ...]) -> None:
    judge = Verdicts(floor=floor, weights=resamples(10, np.random.default_rng(0)))
    judge.without["torque_saturation"] = 0.040
    soft, sag, delay, limit = (
        made_up((name,), error)
        for name, error in (
            ("torque_saturation", 0.012),
            ("supply_sag", 0.020),
            ("command_delay", 0.020),
            ("torque_limit", 0.035),
        )
    )
    accepted = judge.accept(soft, "torque_saturation", [soft, sag, delay, limit], {}, soft)
    assert accepted.tied == tied


def test_friction_of_one_direction_alone_is_a_load() -> None:
    def fit(plus: float, minus: float, *others: str) -> JointFit:
        plain = made_up((*others, "asymmetric_friction"), 0.01)
        keys = [f"asymmetric_friction.tau_{side}_nm" for side in ("plus", "minus")]
        sides = tuple(Coordinate(key, 0, False, 1.0, 0.0, 9.0) for key in keys)
        return replace(
            plain, coordinates=(*plain.coordinates[:-2], *sides), x=np.array([*plain.x[:-2], plus, minus])
        )

    assert fit(0.0, 0.2).at_bound == ("asymmetric_friction.tau_plus_nm",)
    assert fit(1e-4, 0.2).at_bound == ("asymmetric_friction.tau_plus_nm",), "a descent stops short of zero"
    assert fit(0.05, 0.2).at_bound == ()
    assert fit(0.0, 0.2, "coulomb_friction").at_bound == ()


def test_load_and_friction_are_found_together(tmp_path: Path) -> None:
    hidden = {servo.GRAVITY_TORQUE: 0.3, servo.GRAVITY_PHASE: -1.0, servo.COULOMB_TORQUE: 0.08}
    effects = ("coulomb_friction", "asymmetric_friction", "gravity_load", "encoder_bias")
    report = analysed(recorded(hidden), tmp_path, effects=effects)
    assert {effect.name for effect in report.effects} == {"coulomb_friction", "gravity_load"}
    # Neither was the best alone: the evidence says with what each was accepted.
    accepted = {row.name: row.given for row in report.evidence if row.decision == "named"}
    assert accepted == {"coulomb_friction": ("gravity_load",), "gravity_load": ("coulomb_friction",)}


def concluded(judge: Verdicts, left: float = FLOOR, **options: object) -> Explanation:
    """A conclusion about Coulomb friction that is beyond doubt but for ``options``."""
    baseline, final = made_up((), 0.010), made_up(("coulomb_friction",), left)
    simpler = made_up(("stribeck_friction",), left)  # a form of it is no rival
    rivals = {"coulomb_friction": [final, simpler, made_up(("backlash",), 0.004)]}
    return judge.conclude(baseline, final, rivals, [], "", **options)  # type: ignore[arg-type]


def test_two_searches_that_disagree_by_more_than_the_gain_give_no_name(judge: Verdicts) -> None:
    assert [a.named for a in concluded(judge).accepted] == [True]
    left = 1.5 * FLOOR
    # Its gain is what the next best leaves: 4 - 1.5 mrad.
    near = concluded(judge, left, again=made_up(("coulomb_friction",), 0.0035))
    assert near.verdict == "effects" and near.accepted[0].named
    far = concluded(judge, left, again=made_up(("coulomb_friction",), 0.0045))
    assert far.verdict == "unknown" and not far.accepted[0].named
    assert "two searches" in far.reason and "3.00 mrad" in far.reason


def test_a_worse_optimum_says_nothing_against_a_model_at_the_noise_floor(judge: Verdicts) -> None:
    worse = concluded(judge, FLOOR, again=made_up(("coulomb_friction",), 0.0095))
    assert worse.verdict == "effects" and worse.accepted[0].named


def test_what_has_structure_is_not_explained(judge: Verdicts) -> None:
    final = made_up(("coulomb_friction",), FLOOR)
    pairs = np.full(10, 400.0)

    def with_structure(share: float | np.ndarray, rms: float = 1.1 * FLOOR) -> Explanation:
        left = replace(final, sse=COUNT * rms**2, structure=np.stack([share * FLOOR**2 * pairs, pairs]))
        return concluded(judge, refined=left)

    assert with_structure(0.03).verdict == "effects", "what the right models leave"
    lacking = with_structure(0.3)
    assert lacking.verdict == "unknown" and "structure" in lacking.reason
    once = np.zeros(10)
    once[0] = 3.0  # a single motion is no rule
    assert with_structure(once).verdict == "effects"
    # Far from the floor a real machine's repeatability is not known.
    assert with_structure(8.0, rms=5.0 * FLOOR).verdict == "effects"


def test_what_the_time_step_leaves_open_widens_the_interval(judge: Verdicts) -> None:
    fit = made_up((), FLOOR)
    plain = intervals(fit, FLOOR)["p0"]
    wide = intervals(replace(fit, step_error=np.full(3, 0.5)), FLOOR)["p0"]
    half = 0.5 * (plain[1] - plain[0])
    assert 0.5 * (wide[1] - wide[0]) == pytest.approx(np.hypot(half, 0.5))
    given = replace(fit, extents={"p0": (-1.0, 3.0)})
    assert intervals(given, FLOOR)["p0"] == (-1.0, 3.0)


def test_one_delay_stands_for_both(tmp_path: Path) -> None:
    """A late reading moves the positions as a late command does: one name, and the set that it stands for."""
    for column in (servo.COMMAND_DELAY, servo.READ_DELAY):
        data = recorded({column: 0.025})
        chosen = ("command_delay", "read_delay", "coulomb_friction")
        report = analysed(data, tmp_path / str(column), effects=chosen)
        assert [e.name for e in report.effects] == ["command_delay"]
        assert report.effects[0].parameters["delay_s"].value == pytest.approx(0.025, rel=0.02)
        assert report.ambiguous == (("command_delay", "read_delay"),)
        assert report.open_sets == () and report.next_experiment == ""
        assert "stands for read delay too" in verdict_sentence(report)
        (row,) = [row for row in report.evidence if row.name == "read_delay"]
        assert "stands for both" in row.reason
    alone = analysed(data, tmp_path / "alone", effects=("read_delay", "coulomb_friction"))
    assert [e.name for e in alone.effects] == ["read_delay"] and not alone.ambiguous


def test_a_baseline_gone_astray_does_not_hold_the_search() -> None:
    """Fits with a further effect start from the nominal model too, torques in its unit."""
    chosen = Selection(
        floor=FLOOR,
        weights=resamples(10, np.random.default_rng(0)),
        run=lambda calls: [],
        joint=0,
        others=(),
        candidates=SMALL,
        scales=None,  # type: ignore[arg-type]
        nominal={"kp": 3.0, "kd": 0.3},
    )
    far = made_up(("load_friction",), 0.01)
    names = ("kp", "kd", "velocity_limit", "load_friction.k_load")
    values = {"kp": 60.0, "kd": 8.0, "velocity_limit": 5.0, "load_friction.k_load": 0.2}
    coordinates = tuple(Coordinate(name, i, False, 1.0, -99.0, 99.0) for i, name in enumerate(names))
    far = replace(far, coordinates=coordinates, x=np.array([values[name] for name in names]))
    added = [{"coulomb_friction.tau_c_nm": 2.0}, {"coulomb_friction.tau_c_nm": 8.0}]
    first, second, nominal = chosen.starts(far, added)
    assert first == {**values, **added[0]} and second == {**values, **added[1]}
    expected = {**values, "kp": 3.0, "kd": 0.3, "coulomb_friction.tau_c_nm": 2.0 * 3.0 / 60.0}
    assert nominal == pytest.approx(expected)
    near = replace(far, x=np.array([3.3, 0.25, 5.0, 0.2]))
    assert len(chosen.starts(near, added)) == 2


def test_the_evidence_says_what_the_screening_left_out(tmp_path: Path) -> None:
    report = analysed(recorded({servo.COMMAND_DELAY: 0.03}), tmp_path, effects=tuple(EFFECTS))
    out = [row for row in report.evidence if row.reason.startswith("screened out: promised")]
    first = {row.name for row in report.evidence if row.round == 1}
    assert out and all(np.isnan(row.held_out_rmse_rad) and row.decision == "rejected" for row in out)
    assert {"load_friction", "encoder_bias", "command_delay"} <= first


def analysed(recording: Recording, out: Path, **options: object) -> Report:
    return explain(recording, None, out, workers=1, **{"effects": SMALL, **options})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "parameter", "column", "value"),
    [
        ("coulomb_friction", "tau_c_nm", servo.COULOMB_TORQUE, 0.05),
        ("command_filter", "tau_s", servo.FILTER_TAU, 0.04),
    ],
)
def test_a_hidden_effect_is_named(
    name: str, parameter: str, column: int, value: float, tmp_path: Path
) -> None:
    report = analysed(recorded({column: value}), tmp_path)
    assert report.verdict == "effects"
    assert [effect.name for effect in report.effects] == [name]
    estimate = report.effects[0].parameters[parameter]
    assert estimate.value == pytest.approx(value, rel=0.1)
    assert report.effects[0].confidence >= 0.9
    assert report.held_out.identified_rmse_rad < 1.3 * report.noise_floor_rad
    placebos = [c for c in report.evidence if c.placebo]
    assert placebos and all(c.gain < 0.05 and c.decision == "rejected" for c in placebos)


def test_nothing_hidden_is_no_gap_and_resumes(tmp_path: Path) -> None:
    recording = recorded({})
    report = analysed(recording, tmp_path)
    assert report.verdict == "no_gap" and not report.effects and not report.ambiguous
    lines: list[str] = []
    again = explain(recording, None, tmp_path, workers=1, effects=SMALL, progress=lines.append)
    assert again == report and any("already done" in line for line in lines)
    curves = Predictions.read(tmp_path / "predictions.npz")
    assert np.isfinite(curves.identified).all()
    other = explain(recording, None, tmp_path, workers=1, effects=SMALL[:2], progress=lines.append)
    assert other.seconds != report.seconds


def test_a_short_search_that_ends_astray_does_not_hold_the_baseline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From an inertia too small to show no descent comes back."""

    def astray(problem: JointProblem, base: np.ndarray, *_: object, **__: object) -> np.ndarray:
        rows = base.copy()
        rows[problem.joint, servo.INERTIA] = 1e-5
        return rows

    monkeypatch.setattr(JointProblem, "start_baseline", astray)
    report = analysed(recorded({}), tmp_path, effects=("command_delay",))
    assert report.verdict == "no_gap" and report.baseline.rmse_rad < 1.1 * report.noise_floor_rad


def test_an_effect_that_is_not_considered_ends_unknown_or_tied(tmp_path: Path) -> None:
    report = analysed(recorded({servo.BACKLASH_WIDTH: 0.08}), tmp_path, effects=("thermal_drift",))
    assert report.verdict == "unknown" and not report.effects


def test_few_trajectories_are_under_excited(tmp_path: Path) -> None:
    report = analysed(recorded({servo.COULOMB_TORQUE: 0.05}).subset([0, 3]), tmp_path)
    assert report.verdict == "under_excited" and not report.effects


def test_unknown_effects_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="slime"):
        find(recorded({}), None, tmp_path, effects=("slime",))


def test_telemetry_contradicts_a_cause() -> None:
    """A duty cycle in proportion to the error leaves no room for a delay; a steady voltage none for sag."""
    from vd.gap.chain import chains
    from vd.gap.team import JointSpec

    recording = recorded({servo.COULOMB_TORQUE: 0.05})
    parts = tuple(
        replace(t, pwm=0.5 * (t.command - t.position), voltage=np.full(t.position.shape, 7.4))
        for t in recording.trajectories
    )
    (chain,) = chains(recording)
    spec = JointSpec(0, 0, tuple(range(len(parts))), tuple(range(len(parts))), FLOOR, ("kd",))
    found = vetoes(replace(recording, trajectories=parts), chain, spec, chain.start_row)
    assert {"supply_sag", "command_delay", "dead_zone"} <= set(found)
    assert "coulomb_friction" not in found and "torque_saturation" not in found
    assert vetoes(recording, chain, spec, chain.start_row) == {}
    falling = tuple(
        replace(t, voltage=7.4 - 2.0 * np.abs(t.command - t.position)) for t in recording.trajectories
    )
    assert "supply_sag" not in vetoes(replace(recording, trajectories=falling), chain, spec, chain.start_row)


def test_a_model_with_chance_in_it_is_judged_by_its_likelihood(judge: Verdicts) -> None:
    """A few motions hold most of the squared error; what matters is how surely all are known."""
    errors = np.full(10, 1e-3)
    errors[:2] = 6e-3
    before = made_up((), errors)
    spread = errors.copy()
    spread[0] *= 1.05  # one motion a little worse
    after = made_up(("command_jitter",), 0.9 * spread)
    assert judge.better(before, after)[0]
    assert not judge.better(before, made_up(("command_jitter",), errors.mean() * 2.0))[0]
    # A motion that is predicted badly without it, but fits, is no sign of chance.
    fits_well = replace(before, sse=COUNT * (0.9 * spread) ** 2)
    assert not judge.better(fits_well, after)[0]


def searching(answers: list[float]) -> tuple[Selection, list[int]]:
    """A selection whose other searches end at given errors, and the seeds that it asked for."""
    seeds: list[int] = []

    def run(calls: list[tuple[str, dict[str, object]]]) -> list[object]:
        ((method, options),) = calls
        assert method == "again"
        seeds.append(options["seed"])  # type: ignore[arg-type]
        return [made_up(("backlash",), answers[len(seeds) - 1])]

    selection = Selection(
        floor=FLOOR,
        weights=resamples(10, np.random.default_rng(0)),
        run=run,  # type: ignore[arg-type]
        joint=0,
        others=(),
        candidates=SMALL,
        scales=None,  # type: ignore[arg-type]
    )
    return selection, seeds


@pytest.mark.parametrize("named", ["torque_speed_limit", "torque_limit"])
def test_the_simpler_of_two_stands_for_the_other_only_if_it_is_earned(named: str) -> None:
    """On one motion the simpler one does well, so that they tie; on the whole it may gain too little."""
    before = made_up(("load_friction",), 0.010)
    uneven = np.full(10, 0.0125)
    uneven[:4] = 0.002
    simple = np.tile([0.0076, 0.0082], 5) if named == "torque_limit" else uneven
    fits = {"torque_speed_limit": 0.0079, "torque_limit": simple}
    selection, _ = searching([])
    selection.candidates, selection.floor = tuple(fits), 1e-2 * FLOOR
    made = {name: made_up(("load_friction", name), value) for name, value in fits.items()}
    selection.fit_candidates = lambda *_, **__: made  # type: ignore[method-assign]
    selection.run = lambda calls: [0.0 for _ in calls]
    longer, _, trials = selection.extend(before, 0)
    assert longer.effects[1] == named and trials[0].round == 1


def test_a_fit_that_is_worse_than_without_begins_anew_nearly_off() -> None:
    present = made_up((), 0.010)
    begun = []

    def run(calls: list) -> list:
        answers = []
        for name, call in calls:
            if name == "promise":
                answers.append(np.linspace(0.9, 0.1, len(call["starts"])))
                continue
            starts = [s.get("coulomb_friction.tau_c_nm", 1.0) for s in call["starts"]]
            begun.append(starts)
            answers.append(made_up(call["effects"], 0.02 if starts[0] > 0.01 else 0.006))
        return answers

    selection, _ = searching([])
    selection.run, selection.candidates = run, ("coulomb_friction",)
    selection.scales = Scales(1.0, 1.0, 2.0, 3.0, 10.0, 1e-3, 0.01, 6.0)
    fits = selection.fit_candidates(present)
    assert fits["coulomb_friction"].rmse == pytest.approx(0.006)
    assert begun[-1] == [pytest.approx(0.1 * begun[0][0])]


def test_far_from_the_floor_the_search_begins_anew_where_first_effects_tied() -> None:
    baseline, first = made_up((), 0.10), made_up(("torque_saturation",), 0.08)
    beginnings = []

    def search(_: JointFit, start: JointFit) -> tuple:
        beginnings.append(start.effects)
        if start is not baseline:
            return made_up((*start.effects, "torque_limit"), 0.04), {}, []
        names = {"torque_saturation": "named", "load_friction": "tied", "thermal_drift": "rejected"}
        fits = {name: first if name == first.effects[0] else made_up((name,), 0.08) for name in names}
        rows = [Trial(1, name, fits[name], 0.2, (0.1, 0.3), names[name]) for name in names]
        return made_up(("torque_saturation", "coulomb_friction"), 0.05), {}, rows

    class FoundError(Exception):
        pass

    def better(_: JointFit, present: JointFit) -> tuple[bool, str]:
        raise FoundError(present)

    selection, _ = searching([])
    selection.search, selection.better = search, better  # type: ignore[method-assign, assignment]
    with pytest.raises(FoundError) as found:
        selection.explain(baseline)
    assert beginnings == [(), ("load_friction",)]
    assert found.value.args[0].effects == ("load_friction", "torque_limit")


def test_a_search_that_comes_back_to_where_it_began_ends() -> None:
    baseline, rounds = made_up((), 0.10), []

    def extend(present: JointFit, done: int) -> tuple:
        rounds.append(done + 1)
        added = made_up((*present.effects, "gravity_load" if present.effects else "coulomb_friction"), 0.05)
        return added, {}, [Trial(done + 1, added.effects[-1], added, 0.5, (0.4, 0.6), "named")]

    def revise(present: JointFit) -> tuple:
        return made_up(("coulomb_friction",), 0.06), {}

    selection, _ = searching([])
    selection.extend, selection.revise = extend, revise  # type: ignore[method-assign, assignment]
    found, _, _ = selection.search(baseline, baseline)
    assert found.effects == ("coulomb_friction",) and rounds == [1, 2]


def test_a_search_that_fails_is_repeated_before_it_counts() -> None:
    present = made_up(("backlash",), 0.004)
    selection, seeds = searching([0.030, 0.00401, 0.0])
    again = selection.search_again(present)
    assert again is not None and again.rmse == pytest.approx(0.00401) and len(set(seeds)) == 2
    selection, seeds = searching([0.030, 0.020, 0.010])
    again = selection.search_again(present)
    assert again is not None and again.rmse == pytest.approx(0.010) and len(set(seeds)) == 3
    selection, seeds = searching([])
    assert selection.search_again(made_up(("backlash",), FLOOR)) is None, "nothing is better than the floor"
