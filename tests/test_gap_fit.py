"""Fit of a joint's servo model.

Floors, folds, intervals, and what the optimiser finds in simulated data.
"""

from dataclasses import replace

import numpy as np
import pytest
from gap_recordings import ENCODER_COUNT, TRUE, blank, problem_of, recorded, true_row

import vd.kernels.servo.actuators as servo
from vd.gap.chain import chains
from vd.gap.design import design
from vd.gap.find import findings
from vd.gap.fit import JointFit, JointProblem, intervals
from vd.gap.rollout import Rollouts
from vd.gap.rules import candidates
from vd.gap.statistics import noise_floor
from vd.kernels.servo.effects import EFFECTS

NEAR = {"kp": 3.0, "kd": 0.25, "velocity_limit": 7.0, "inertia": 2.5e-3}
"""Where a fit of the servo that all recordings are of may begin."""


def fitted(problem: JointProblem, *effects: str, **start: float) -> JointFit:
    """A fit from near the truth; ``effect__parameter`` starts an effect."""
    base = problem.rollouts.chain.start_row
    values = {key.replace("__", "."): value for key, value in start.items()}
    return problem.fit(base, effects, [{**NEAR, **values}], problem.scales(base[0], 1e-2))


def test_baseline_is_recovered_within_its_intervals() -> None:
    problem = problem_of(recorded({}))
    base = problem.rollouts.chain.start_row
    scales = problem.scales(base[0], problem.floor)
    fit = problem.fit(base, (), [{}, {"velocity_limit": 1.05 * scales.speed}], scales)
    assert fit.rmse < 1.2 * problem.floor
    assert fit.held_out_rmse < 1.3 * problem.floor
    for key in ("kd", "velocity_limit", "inertia"):
        assert fit.values[key] == pytest.approx(NEAR[key], rel=0.1), key
        low, high = intervals(fit, problem.floor)[key]
        assert low < fit.values[key] < high < 2.0 * low


@pytest.mark.parametrize(
    ("effect", "column", "value"),
    [
        ("command_delay", servo.COMMAND_DELAY, 0.023),
        ("coulomb_friction", servo.COULOMB_TORQUE, 0.06),
        ("backlash", servo.BACKLASH_WIDTH, 0.03),
    ],
)
def test_effect_is_recovered_with_the_baseline(effect: str, column: int, value: float) -> None:
    problem = problem_of(recorded({column: value}))
    start = problem.rollouts.chain.start_row
    base = true_row(start, {own: 1.1 * true for own, true in TRUE.items() if own != servo.KP})
    key = next(k for k in problem.fitted((effect,)) if k.startswith(effect))
    starts = [{key: 0.5 * value}, {key: 2.0 * value}]
    fit = problem.fit(base, (effect,), starts, problem.scales(base[0], 0.02), iterations=15)
    assert fit.values[key] == pytest.approx(value, rel=0.05)
    assert fit.rmse < 1.2 * problem.floor


def test_a_refined_fit_depends_less_on_the_step() -> None:
    """Values at a coarse step come near those at a fine one, and say how near."""
    problem = problem_of(recorded({servo.COULOMB_TORQUE: 0.1}))
    coarse_dt = 1 / 60
    problem.rollouts = problem.slopes = problem.rollouts.at(coarse_dt)
    coarse = fitted(problem, "coulomb_friction", coulomb_friction__tau_c_nm=0.1)
    refined = problem.refine(coarse)
    assert problem.rollouts.dt == coarse_dt, "the problem's own step is back"
    off = [abs(fit.values["inertia"] / 2.5e-3 - 1.0) for fit in (coarse, refined)]
    assert off[0] > 0.05 and off[1] < 0.4 * off[0]
    assert (refined.step_error > 0.0).all()
    np.testing.assert_array_equal(refined.held_out, coarse.held_out)


def test_held_out_errors_see_no_fold_that_they_predict() -> None:
    """A trajectory that contradicts the rest is fitted badly when held out, better when not."""
    recording = recorded({})
    odd = recording.trajectories[0]
    parts = (replace(odd, position=odd.position + 0.05), *recording.trajectories[1:])
    problem = problem_of(replace(recording, trajectories=parts))
    base = true_row(problem.rollouts.chain.start_row, {})
    scales = problem.scales(base[0], 0.01)
    bias = {"encoder_bias.bias_rad": 0.01}
    fit = problem.fit(base, ("encoder_bias",), [bias], scales)
    assert fit.held_out[0] > fit.sse[0]
    assert fit.held_out.sum() > fit.sse.sum()


def test_noise_floor_is_the_larger_of_quantum_and_noise() -> None:
    quiet, loud = recorded({}, noise=0.0), recorded({}, noise=4e-3)
    assert noise_floor(quiet, 0) == pytest.approx(ENCODER_COUNT / np.sqrt(12.0), rel=0.25)
    assert noise_floor(loud, 0) == pytest.approx(4e-3, rel=0.2)


def test_conditions_are_held_out_before_motions() -> None:
    recording = blank(gains=(100.0, 400.0, 800.0))
    (chain,) = chains(recording)
    trajectories, folds, aside = design(recording, chain, 0)
    assert aside not in trajectories
    gains = [recording.trajectories[t].conditions["p_gain"] for t in trajectories]
    assert len(set(folds)) == 3
    assert all(
        len({g for g, f in zip(gains, folds, strict=True) if f == fold}) == 1 for fold in set(folds)
    )
    recording = blank()
    (chain,) = chains(recording)
    assert len(set(design(recording, chain, 0)[1])) == 5


def test_one_of_enough_motions_is_kept_from_every_fit() -> None:
    few, many = blank(), blank(gains=(100.0, 400.0, 800.0))
    assert design(few, chains(few)[0], 0)[2] is None
    trajectories, _, aside = design(many, chains(many)[0], 0)
    assert {*trajectories, aside} == {*range(len(many.trajectories))}


def test_what_the_baseline_fits_is_no_candidate() -> None:
    (bare,), (pendulum,) = chains(blank()), chains(blank(model="pendulum"))
    assert "gravity_load" in candidates(bare, tuple(EFFECTS))
    assert "gravity_load" not in candidates(pendulum, tuple(EFFECTS))
    assert not {"payload_inertia", "joint_coupling"} & {*candidates(bare, tuple(EFFECTS))}


def test_findings_say_where_friction_shows() -> None:
    recording = recorded({servo.COULOMB_TORQUE: 0.1})
    rollouts = Rollouts(chains(recording)[0], recording)
    predicted = rollouts.predict(true_row(rollouts.chain.start_row, {})[None])[0].astype(float)
    found = findings(recording, predicted, {"j": noise_floor(recording, 0)})
    assert found and all(f.joint == "j" and f.where.startswith("j: ") for f in found)
    assert all(f.signature["rms_rad"] > f.signature["noise_floor_rad"] for f in found)
    same = findings(
        recording, np.concatenate([t.position for t in recording.trajectories]), {"j": 1e-3}
    )
    assert same == []
