"""Selection of effects: the search on made-up fits, and whole analyses of small recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_gap_fit import TRUE, blank, recorded
from test_gap_judge import FLOOR, made_up

import vd.kernels.servo.actuators as servo
from vd.gap.chain import chains
from vd.gap.coordinates import Coordinate, Scales
from vd.gap.explanation import Trial
from vd.gap.fit import JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.recording import Recording
from vd.gap.result import Predictions, Report
from vd.gap.rollout import Rollouts
from vd.gap.select import Selection
from vd.gap.statistics import resamples
from vd.gap.telemetry import vetoes
from vd.gap.words import verdict_sentence
from vd.gap.workflow import explain, find
from vd.kernels.servo.effects import EFFECTS

SMALL = ("command_delay", "coulomb_friction", "torque_saturation", "thermal_drift", "command_filter")


def test_friction_with_a_direction_stands_for_dry_friction_and_an_offset(tmp_path: Path) -> None:
    hidden = {servo.FRICTION_PLUS: 0.09, servo.FRICTION_MINUS: 0.04}
    effects = ("coulomb_friction", "asymmetric_friction", "encoder_bias", "gravity_load")
    report = analysed(recorded(hidden), tmp_path, effects=effects)
    assert [effect.name for effect in report.effects] == ["asymmetric_friction"]
    assert report.ambiguous == (("asymmetric_friction", "coulomb_friction", "encoder_bias"),)
    assert report.open_sets == () and "stands for" in verdict_sentence(report)


@pytest.mark.parametrize(("excess", "merged"), [(1.0, True), (1.015, True), (1.1, False)])
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


@pytest.mark.parametrize("bias", [0.01, -0.01])
def test_both_ways_is_the_friction_that_moves_as_dry_friction_and_an_offset_do(bias: float) -> None:
    rollouts = Rollouts(chains(blank())[0], blank())
    row = rollouts.chain.start_row.copy()
    row[0, list(TRUE)] = list(TRUE.values())
    keys = "coulomb_friction.tau_c_nm", "encoder_bias.bias_rad"
    fit = replace(
        made_up(("coulomb_friction", "encoder_bias"), FLOOR),
        coordinates=tuple(Coordinate(key, 0, False, 1.0, -9.0, 9.0) for key in keys),
        x=np.array([0.06, bias]),
        rows=row,
    )
    two, one = row.copy(), row.copy()
    two[0, [servo.COULOMB_TORQUE, servo.ENCODER_BIAS]] = fit.x
    sides = Selection(
        floor=FLOOR,
        weights=resamples(10, np.random.default_rng(0)),
        run=lambda calls: [],
        joint=0,
        others=(),
        candidates=(),
        scales=Scales(3.0, 0.5, 2.0, 6.0, 70.0, 1e-3, 1e-3, 12.0),
    ).both_ways(fit)
    one[0, [servo.FRICTION_PLUS, servo.FRICTION_MINUS]] = list(sides.values())
    paths = rollouts.predict(np.stack([two, one, row]))
    assert np.abs(paths[0] - paths[1]).max() < 1e-6
    assert np.abs(paths[0] - paths[2]).max() > 1e-2


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
    # Friction was not the best alone: the evidence says with what it was accepted.
    accepted = {row.name: row.given for row in report.evidence if row.decision == "named"}
    assert {*accepted} == {"coulomb_friction", "gravity_load"}
    assert accepted["coulomb_friction"] == ("gravity_load",)


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
        clocked=True,
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


def friction(torque: float, error: float) -> JointFit:
    """A made-up fit with Coulomb friction of a given torque."""
    key = Coordinate("coulomb_friction.tau_c_nm", servo.COULOMB_TORQUE, False, 1.0, 0.0, 10.0)
    return replace(made_up(("coulomb_friction",), error), coordinates=(key,), x=np.array([torque]))


def test_a_fit_that_is_worse_than_without_begins_anew_nearly_off() -> None:
    present = made_up((), 0.010)
    begun = []

    def run(calls: list) -> list:
        answers = []
        for name, call in calls:
            if name == "promise":
                answers.append(np.linspace(0.9, 0.1, len(call["starts"])))
                continue
            starts = [s["coulomb_friction.tau_c_nm"] for s in call["starts"]]
            begun.append(starts)
            answers.append(friction(starts[0], 0.02 if starts[0] > 0.01 else 0.006))
        return answers

    selection, _ = searching([])
    selection.run, selection.candidates = run, ("coulomb_friction",)
    selection.scales = Scales(1.0, 1.0, 2.0, 3.0, 10.0, 1e-3, 0.01, 6.0)
    fits = selection.fit_candidates(present)
    assert fits["coulomb_friction"].rmse == pytest.approx(0.006)
    assert begun[-2] == begun[-1] == [pytest.approx(0.1 * begun[0][0])], "and is fitted to the end from there"


@pytest.mark.parametrize(("promised", "found"), [(0.9, 0.0015), (0.1, 0.004)])
def test_a_speed_limit_above_all_speeds_is_brought_to_them_where_that_promises_more(
    promised: float, found: float
) -> None:
    """There it has no slope: the descent from where it binds leaves less."""

    def fast(effects, rmse, speed):
        fit = made_up(effects, rmse)
        names, values = ("kp", "velocity_limit"), np.array([3.0, speed])
        coordinates = tuple(Coordinate(name, i, False, 1.0, -99.0, 99.0) for i, name in enumerate(names))
        return replace(fit, coordinates=coordinates, x=values)

    def run(calls: list) -> list:
        return [
            np.array([promised]) if name == "promise" else fast(call["effects"], 0.0015, 6.5)
            for name, call in calls
            if name == "promise" or call["starts"] == [{"kp": 3.0, "velocity_limit": 6.0}]
        ]

    selection, _ = searching([])
    selection.run, selection.scales = run, Scales(1.0, 1.0, 2.0, 6.0, 10.0, 1e-3, 0.01, 6.0)
    near, far = fast(("coulomb_friction",), 0.004, 12.0), fast(("backlash",), 0.05, 12.0)
    fits = selection.slowed(made_up((), 0.1), [near, far])
    assert [fit.rmse for fit in fits] == pytest.approx([found, 0.05])
    bound = fast(("coulomb_friction",), 0.004, 5.9)
    assert selection.slowed(made_up((), 0.1), [bound]) == [bound]


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
        pair = made_up(
            ("load_friction", "gravity_load"), 0.05
        )  # two that were taken together are no beginning
        rows += [Trial(1, name, pair, 0.5, (0.4, 0.6), "named") for name in pair.effects]
        return made_up(("torque_saturation", "coulomb_friction"), 0.05), {}, rows

    class FoundError(Exception):
        pass

    def better(_: JointFit, present: JointFit) -> tuple[bool, str]:
        raise FoundError(present)

    selection, _ = searching([])
    selection.search, selection.better = search, better  # type: ignore[method-assign, assignment]
    with pytest.raises(FoundError) as found:
        selection.explain(baseline)
    assert beginnings == [(), (), ("load_friction",)], "from the best starts, from all, with the tied one"
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


@pytest.mark.parametrize(("whole", "most"), [(30.0, 1.22), (70.0, 1.4), (200.0, 2.0)])
def test_beside_a_large_gap_a_little_more_than_noise_begins_no_search(whole: float, most: float) -> None:
    """In noise floors; a right model leaves 1.3 beside a gap of 70 where times are good to 0.1 ms."""
    selection, _ = searching([])
    selection.refined = lambda fit: fit  # type: ignore[method-assign]
    selection.whole, pairs = whole * FLOOR, np.full(10, 400.0)
    for left, ends in ((0.98, True), (1.02, False)):
        fit = made_up(("coulomb_friction",), left * most * FLOOR)
        fit = replace(fit, structure=np.stack([0.05 * FLOOR**2 * pairs, pairs]))
        assert selection.noise_only(fit) is ends
    # What the time step of the search leaves beside it is not held against a model.
    selection.refined = lambda fit: made_up(fit.effects, fit.rmse / 1.08)  # type: ignore[method-assign]
    assert selection.noise_only(made_up(("command_delay",), 1.06 * most * FLOOR))
    assert not selection.noise_only(made_up(("command_delay",), 1.1 * most * FLOOR))


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


def test_an_effect_that_leaves_noise_where_structure_was_is_earned_however_small() -> None:
    pairs = np.full(10, 400.0)

    def leaving(effects: tuple[str, ...], error: float, shared: float) -> JointFit:
        return replace(made_up(effects, error), structure=np.stack([shared * FLOOR**2 * pairs, pairs]))

    selection, _ = searching([])
    selection.refined = lambda fit: fit  # type: ignore[method-assign]
    one = leaving(("supply_sag",), 1.05 * FLOOR, 0.3)
    both = leaving(("supply_sag", "torque_limit"), 0.95 * FLOOR, 0.02)
    assert not selection.better(one, both)[0] and selection.whitens(one, both)
    assert not selection.finished(one) and selection.finished(both)
    assert not selection.whitens(one, leaving(both.effects, 0.95 * FLOOR, 0.2)), "structure is left"
    assert not selection.whitens(leaving(("supply_sag",), 1.05 * FLOOR, 0.02), both), "there was none"
    assert not selection.whitens(leaving((), 9.0 * FLOOR, 9.0), both), "far from the floor it says nothing"
