"""Where fits begin: without the right start no descent finds the bottom of a narrow valley."""

from dataclasses import replace

import numpy as np
import pytest
from test_gap_fit import TRUE, problem_of, recorded
from test_gap_judge import FLOOR, made_up

import vd.kernels.servo.actuators as servo
from vd.gap.coordinates import Coordinate, Scales, beside
from vd.gap.joint_fit import JointFit
from vd.gap.select import Selection
from vd.gap.statistics import resamples

SCALES = Scales(3.0, 0.5, 2.0, 6.0, 70.0, 1e-3, 1e-3, 12.0)


def search(extra: dict[int, float], *chosen: str) -> tuple[Selection, JointFit]:
    """A search among chosen effects on a servo that has more than the plain model, and its baseline."""
    problem = problem_of(recorded(extra))
    base = problem.rollouts.chain.start_row.copy()
    base[0, list(TRUE)] = list(TRUE.values())
    scales = problem.scales(base[0], problem.floor)
    baseline = problem.fit(base, (), [{}, {"inertia": 2.0 * TRUE[servo.INERTIA]}], scales)
    selection = Selection(
        floor=problem.floor,
        weights=resamples(len(problem.trajectories), np.random.default_rng(0)),
        run=lambda calls: [getattr(problem, name)(**options) for name, options in calls],
        joint=0,
        others=(),
        candidates=chosen,
        scales=problem.scales(baseline.rows[0], baseline.rmse),
    )
    return selection, baseline


def test_a_load_behind_a_spring_is_found_where_it_is_as_heavy_as_the_motor() -> None:
    spring = {servo.ELASTIC_STIFFNESS: 0.5, servo.ELASTIC_DAMPING: 3e-3, servo.ELASTIC_INERTIA: 1.5e-3}
    selection, baseline = search({**spring, servo.INERTIA: 1.5e-3}, "elastic_transmission")
    (fit,) = selection.fit_candidates(baseline).values()
    assert baseline.rmse > 3.0 * selection.floor > 2.5 * fit.rmse
    assert fit.values["elastic_transmission.k_nm_rad"] == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize(("share", "inertia"), [(0.22, 7e-4), (0.42, 7e-4), (0.27, 2e-3)])
def test_a_load_that_rings_far_below_the_drive_is_found(share: float, inertia: float) -> None:
    """It is hardly damped; the starts that tell its frequency are the ones that promise to explain it."""
    frequency = share * np.sqrt(TRUE[servo.KP] / TRUE[servo.INERTIA])
    stiffness = inertia * frequency**2
    spring = {
        servo.ELASTIC_STIFFNESS: stiffness,
        servo.ELASTIC_DAMPING: 0.06 * inertia * frequency,
        servo.ELASTIC_INERTIA: inertia,
    }
    selection, baseline = search(spring, "elastic_transmission")
    (fit,) = selection.fit_candidates(baseline).values()
    assert baseline.rmse > 3.0 * selection.floor > 2.5 * fit.rmse
    assert fit.values["elastic_transmission.k_nm_rad"] == pytest.approx(stiffness, rel=0.05)


def test_starts_that_differ_in_what_is_not_fitted_are_one() -> None:
    selection, baseline = search({}, "command_filter")
    free = len(selection.sized(baseline, "command_filter"))
    held = replace(baseline, coordinates=baseline.coordinates[:2], x=baseline.x[:2])
    assert "inertia" in baseline.values and "inertia" not in held.values
    assert len(selection.sized(held, "command_filter")) == free / 2


def test_a_limit_is_found_beside_the_line_that_stood_for_both() -> None:
    both = {servo.TORQUE_LIMIT: 1.2, servo.STALL_TORQUE: 2.5, servo.NO_LOAD_SPEED: 5.0}
    selection, baseline = search(both, "torque_limit", "torque_speed_limit")
    line = selection.fit_candidates(baseline)["torque_speed_limit"]
    fit = selection.fit_candidates(line)["torque_limit"]
    assert fit.values["torque_limit.tau_max_nm"] == pytest.approx(1.2, rel=0.05)
    assert fit.values["torque_speed_limit.omega_0_rad_s"] == pytest.approx(5.0, rel=0.05)


@pytest.mark.parametrize("level", ["torque_limit.tau_max_nm", "torque_saturation.tau_s_nm"])
def test_a_line_beside_another_loss_begins_steeper_and_ends_at_the_largest_speed(level: str) -> None:
    name = level.partition(".")[0]
    (start,) = beside("torque_speed_limit", {"kp": 3.0, level: 0.5}, SCALES)
    line = {"torque_speed_limit.tau_stall_nm": 1.0, "torque_speed_limit.omega_0_rad_s": SCALES.speed}
    assert {key: start[key] for key in line} == line
    assert start["velocity_limit"] > SCALES.speed, "that stood for the end of the line"
    (other,) = beside(name, {"torque_speed_limit.tau_stall_nm": 0.5}, SCALES)
    assert other == {**start, level: 0.5}
    assert not beside("supply_sag", {level: 0.5}, SCALES) and not beside(name, {level: 0.5}, SCALES)


def test_in_a_sharp_valley_others_begin_where_the_model_is() -> None:
    keys = ("kp", "acceleration_limit.a_max_rad_s2", "dead_zone.width_rad")

    def fit(name: str, error: float, *x: float) -> JointFit:
        own = {"dead_zone": keys[2], "coulomb_friction": "coulomb_friction.tau_c_nm"}.get(name)
        names = (*keys[:2], own or f"{name}.width_rad")
        return replace(
            made_up(("acceleration_limit", name), error * FLOOR),
            coordinates=tuple(Coordinate(key, 0, False, 1.0, -99.0, 99.0) for key in names),
            x=np.array(x),
        )

    present = fit("dead_zone", 1.0, 3.0, 66.0, 0.02)
    without = replace(
        made_up(("acceleration_limit",), 5.0 * FLOOR),
        coordinates=present.coordinates[:2],
        x=np.array([3.1, 66.5]),
    )
    near, far = fit("coulomb_friction", 2.5, 3.1, 66.5, 0.03), fit("backlash", 3.5, 3.1, 66.5, 0.03)
    asked: list[dict[str, float]] = []

    def run(calls: list) -> list[JointFit]:
        asked.extend(start for _, call in calls for start in call["starts"])
        return [fit("coulomb_friction", left, 3.0, 66.0, 0.03) for _ in calls]

    selection = Selection(
        floor=FLOOR,
        weights=resamples(10, np.random.default_rng(0)),
        run=run,
        joint=0,
        others=(),
        candidates=(),
        scales=SCALES,
    )
    fits = {"coulomb_friction": near, "backlash": far}
    for left in (1.01, 2.6):
        found = selection.from_present(present, without, fits)
        assert [f.rmse / FLOOR for f in found.values()] == ([pytest.approx(1.01)] if left < 2.5 else [])
    start = {"kp": 3.0, "acceleration_limit.a_max_rad_s2": 66.0, "coulomb_friction.tau_c_nm": 0.03}
    assert asked == [start, start], "only what is near begins anew, at the model's place and its own size"


def test_a_narrow_valley_is_followed_while_it_leads_down() -> None:
    down = [0.9, 1.0, 1.0, 0.8, 0.8, 1.0, 0.9, 1.0, 1.0, 1.0, 0.5]
    asked: list[str] = []

    def run(calls: list) -> list[JointFit]:
        ((name, call),) = calls
        asked.append(name)
        return [made_up(("torque_limit",), call["fit"].rmse * down[len(asked) - 1])]

    selection, _ = search({}, "torque_limit")
    selection.run, floor = run, selection.floor
    begun = made_up(("torque_limit",), 5.0 * floor)

    def refit(found: JointFit, _: tuple[str, ...]) -> JointFit:
        return found

    selection.refit = refit  # type: ignore[method-assign, assignment]
    found = selection.look_beside(begun, 100.0 * floor)
    assert found.rmse / floor == pytest.approx(5.0 * 0.9 * 0.8 * 0.8 * 0.9)
    assert len(asked) == 10, "three in a row that lead nowhere are the end"
    assert selection.look_beside(begun, 40.0 * floor) is begun, "a valley that is not narrow"
