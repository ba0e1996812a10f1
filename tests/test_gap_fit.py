"""Fit of a joint's servo model: floors, folds, intervals, and what the optimiser finds in simulated data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vd.gap.fit
import vd.kernels.servo.actuators as servo
from vd.gap.chain import candidates, chains
from vd.gap.coordinates import coordinate
from vd.gap.descent import Descent, LeastSquares
from vd.gap.design import design
from vd.gap.explanation import intervals
from vd.gap.find import findings, phases
from vd.gap.fit import JointProblem
from vd.gap.holding import Holding
from vd.gap.recording import Recording, Trajectory
from vd.gap.rollout import Rollouts
from vd.gap.statistics import covariance, noise_floor, resamples, rmse
from vd.gap.workflow import baseline_of

COUNT = 2.0 * np.pi / 4096
TRUE = {servo.KP: 3.0, servo.KD: 0.25, servo.VELOCITY_LIMIT: 7.0, servo.INERTIA: 2.5e-3}


def motions() -> list[tuple[str, np.ndarray, np.ndarray]]:
    time = np.arange(0.0, 3.0, 0.01)
    step = np.where(time > 0.3, 0.8, 0.0) - np.where(time > 1.6, 1.3, 0.0)
    return [
        ("step", time, step),
        ("step_small", time, 0.2 * step),
        ("sine_0.3", time, 0.7 * np.sin(2 * np.pi * 0.3 * time)),
        ("sine_0.8", time, 0.7 * np.sin(2 * np.pi * 0.8 * time)),
        ("sine_1.5", time, 0.6 * np.sin(2 * np.pi * 1.5 * time)),
    ]


def blank(model: str = "servo", gains: tuple[float, ...] = ()) -> Recording:
    parts = []
    for name, time, command in motions():
        for gain in gains or (None,):
            still = np.zeros((len(time), 1))
            parts.append(
                Trajectory(
                    file=f"{name}_{gain}.csv",
                    excitation=name,
                    joints=("j",),
                    conditions={} if gain is None else {"p_gain": gain},
                    time=time,
                    command=command[:, None],
                    position=still,
                    enabled=np.ones((len(time), 1), bool),
                )
            )
    return Recording(Path("made up"), model, ("j",), {}, COUNT, tuple(parts))


def recorded(extra: dict[int, float], seed: int = 0, noise: float = 3e-4) -> Recording:
    """What a servo with the true parameters and ``extra`` columns would have answered."""
    recording = blank()
    (chain,) = chains(recording)
    row = chain.start_row.copy()
    for column, value in {**TRUE, **extra}.items():
        row[0, column] = value
    rollouts = Rollouts(chain, recording)
    path = rollouts.predict(row[None])[0].astype(float)
    rng = np.random.default_rng(seed)
    path = np.round((path + rng.normal(0.0, noise, path.shape)) / COUNT) * COUNT
    parts = [
        replace(t, position=path[rollouts.sample_trajectory == i])
        for i, t in enumerate(recording.trajectories)
    ]
    return replace(recording, trajectories=tuple(parts))


def problem_of(recording: Recording) -> JointProblem:
    (chain,) = chains(recording)
    trajectories, folds = design(recording, chain, 0)
    floor = noise_floor(recording, 0)
    return JointProblem(Rollouts(chain, recording), 0, trajectories, folds, floor, baseline_of(chain))


def test_baseline_is_recovered_within_its_intervals() -> None:
    problem = problem_of(recorded({}))
    base = problem.rollouts.chain.start_row
    scales = problem.scales(base[0], problem.floor)
    start = problem.start_baseline(base, scales, seed=0, generations=8)
    fit = problem.fit(start, (), [{}, {"velocity_limit": 1.05 * scales.speed}], scales)
    assert fit.rmse < 1.2 * problem.floor
    assert fit.held_out_rmse < 1.3 * problem.floor
    for key, column in (
        ("kd", servo.KD),
        ("velocity_limit", servo.VELOCITY_LIMIT),
        ("inertia", servo.INERTIA),
    ):
        assert fit.values[key] == pytest.approx(TRUE[column], rel=0.1), key
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
    base = problem.rollouts.chain.start_row.copy()
    for own, true in TRUE.items():
        base[0, own] = 1.1 * true if own != servo.KP else true
    scales = problem.scales(base[0], 0.02)
    key = next(k for k in problem.fitted((effect,)) if k.startswith(effect))
    starts = [{key: 0.5 * value}, {key: 2.0 * value}]
    fit = problem.fit(base, (effect,), starts, scales, iterations=15)
    assert fit.values[key] == pytest.approx(value, rel=0.05)
    assert fit.rmse < 1.2 * problem.floor
    alone = [problem.fit(base, (effect,), [start], scales, iterations=15).rmse for start in starts]
    assert fit.rmse <= 1.001 * min(alone), "the best start wins"


def test_the_error_of_the_first_reading_is_forgiven_where_friction_holds_a_joint() -> None:
    """Of a joint that is to hold and is predicted to; of one that is shaken, as far as it is free to move."""
    recording = recorded({})
    held = replace(recording.trajectories[0], command=np.zeros_like(recording.trajectories[0].command))
    recording = replace(recording, trajectories=(held, *recording.trajectories[1:]))
    holding = Holding(recording, 0, [0, 1])
    count = len(held.time)
    predicted = np.zeros((2, 2 * count))
    predicted[1, :count] = np.linspace(0.0, COUNT, count)
    residual = np.full((2, 2 * count), 0.5 * COUNT)
    residual[0, 0] += COUNT
    before = residual.copy()
    holding.forgive(residual, predicted, [0, 1], np.zeros(2))
    assert residual[0, :count].mean() == pytest.approx(0.0, abs=1e-12)
    assert np.ptp(residual[0, :count]) == pytest.approx(COUNT), "noise stays"
    assert np.array_equal(residual[1], before[1]) and np.array_equal(residual[:, count:], before[:, count:])
    holding.forgive(residual, predicted, [0, 1], np.full(2, 0.2 * COUNT))
    assert residual[1, :count] == pytest.approx(0.3 * COUNT), "no more than the play"
    assert np.array_equal(residual[:, count:], before[:, count:]), "not where it is commanded"


def test_refits_near_the_floor_keep_the_slopes_of_the_whole_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer simulations, and the same errors on motions that they have not seen."""
    problem = problem_of(recorded({servo.COULOMB_TORQUE: 0.06}))
    base = problem.rollouts.chain.start_row
    scales = problem.scales(base[0], problem.floor)
    fits, simulated = [], []
    for near in (vd.gap.fit.NEAR, 0.0):
        monkeypatch.setattr(vd.gap.fit, "NEAR", near)
        problem.simulated = 0
        start = {"coulomb_friction.tau_c_nm": 0.1}
        fits.append(problem.fit(base, ("coulomb_friction",), [start], scales, iterations=15, refits=3))
        simulated.append(problem.simulated)
    assert fits[0].rmse < 1.2 * problem.floor
    assert simulated[0] < 0.8 * simulated[1]
    assert fits[0].held_out == pytest.approx(fits[1].held_out, rel=1e-2)


def test_a_refined_fit_depends_less_on_the_step() -> None:
    """Values at a coarse step come near those at a fine one, and say how near."""
    problem = problem_of(recorded({servo.COULOMB_TORQUE: 0.1}))
    (chain,) = chains(problem.rollouts.recording)
    scales = problem.scales(chain.start_row[0], 1e-2)
    start = {"kp": 3.0, "kd": 0.25, "velocity_limit": 7.0, "inertia": 2.5e-3}
    start["coulomb_friction.tau_c_nm"] = 0.1
    coarse_dt = 1 / 60
    problem.rollouts = problem.rollouts.at(coarse_dt)
    coarse = problem.fit(chain.start_row, ("coulomb_friction",), [start], scales)
    refined = problem.refine(coarse, scales)
    assert problem.rollouts.dt == coarse_dt, "the problem's own step is back"
    off = [abs(fit.values["inertia"] / 2.5e-3 - 1.0) for fit in (coarse, refined)]
    assert off[0] > 0.05 and off[1] < 0.4 * off[0]
    assert (refined.step_error > 0.0).all()
    np.testing.assert_array_equal(refined.held_out, coarse.held_out)
    products, count = refined.structure
    assert count.sum() > 200 and abs(products.sum() / count.sum()) < 0.15 * problem.floor**2


def test_a_wrong_model_leaves_structure() -> None:
    problem = problem_of(recorded({servo.LOAD_FRICTION: 0.3}))
    (chain,) = chains(problem.rollouts.recording)
    scales = problem.scales(chain.start_row[0], 1e-2)
    start = {"kp": 3.0, "kd": 0.25, "velocity_limit": 7.0, "inertia": 2.5e-3}
    fit = problem.fit(chain.start_row, ("dead_zone",), [start], scales)
    products, count = problem.refine(fit, scales).structure
    assert products.sum() / count.sum() > 0.15 * problem.floor**2


def test_another_search_finds_the_same() -> None:
    problem = problem_of(recorded({servo.COULOMB_TORQUE: 0.1}))
    (chain,) = chains(problem.rollouts.recording)
    scales = problem.scales(chain.start_row[0], 1e-2)
    start = {"kp": 3.0, "kd": 0.25, "velocity_limit": 7.0, "inertia": 2.5e-3}
    start["coulomb_friction.tau_c_nm"] = 0.08
    fit = problem.fit(chain.start_row, ("coulomb_friction",), [start], scales)
    again = problem.again(fit, scales, seed=1)
    assert again.rmse == pytest.approx(fit.rmse, rel=0.02)
    other = problem.again(fit, scales, seed=2)
    assert other.values != again.values, "another seed is another search"


def test_promise_ranks_the_hidden_effect_first() -> None:
    problem = problem_of(recorded({servo.COULOMB_TORQUE: 0.06}))
    base = problem.rollouts.chain.start_row.copy()
    for own, true in TRUE.items():
        base[0, own] = true
    scales = problem.scales(base[0], 0.01)
    fit = problem.fit(base, (), [{}], scales)
    scales = problem.scales(fit.rows[0], fit.rmse)
    starts = [
        {"coulomb_friction.tau_c_nm": 0.05},
        {"thermal_drift.rate_per_s": 0.05},
        {"encoder_bias.bias_rad": 0.01},
    ]
    gains = problem.promise(fit, starts, scales)
    assert np.argmax(gains) == 0
    assert 0.5 < gains[0] <= 1.0


def test_held_out_errors_see_no_fold_that_they_predict() -> None:
    """A trajectory that contradicts the rest is fitted badly when held out, better when not."""
    recording = recorded({})
    odd = recording.trajectories[0]
    parts = (replace(odd, position=odd.position + 0.05), *recording.trajectories[1:])
    problem = problem_of(replace(recording, trajectories=parts))
    base = problem.rollouts.chain.start_row.copy()
    for own, true in TRUE.items():
        base[0, own] = true
    scales = problem.scales(base[0], 0.01)
    bias = {"encoder_bias.bias_rad": 0.01}
    fit = problem.fit(base, ("encoder_bias",), [bias], scales)
    assert fit.held_out[0] > fit.sse[0]
    assert fit.held_out.sum() > fit.sse.sum()


def test_a_refit_that_finds_no_way_down_is_not_taken_for_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded({})
    odd = recording.trajectories[0]
    parts = (replace(odd, position=odd.position + 0.05), *recording.trajectories[1:])
    problem = problem_of(replace(recording, trajectories=parts))
    base = problem.rollouts.chain.start_row.copy()
    scales = problem.scales(base[0], 0.01)
    bias = {"encoder_bias.bias_rad": 0.01}
    one_step = problem.fit(base, ("encoder_bias",), [bias], scales)
    descend = LeastSquares.descend

    def stays(self: LeastSquares, x: np.ndarray, iterations: int, **given: Any) -> Descent:
        known = given.get("known")
        return descend(self, x, iterations, **given) if known is None else replace(known, x=x.copy())

    monkeypatch.setattr(LeastSquares, "descend", stays)
    stuck = problem.fit(base, ("encoder_bias",), [bias], scales, refits=3)
    assert stuck.held_out == pytest.approx(one_step.held_out)
    assert stuck.held_out[0] > stuck.sse[0]


def test_noise_floor_is_the_larger_of_quantum_and_noise() -> None:
    quiet, loud = recorded({}, noise=0.0), recorded({}, noise=4e-3)
    assert noise_floor(quiet, 0) == pytest.approx(COUNT / np.sqrt(12.0), rel=0.25)
    assert noise_floor(loud, 0) == pytest.approx(4e-3, rel=0.2)


def test_conditions_are_held_out_before_motions() -> None:
    recording = blank(gains=(100.0, 400.0, 800.0))
    (chain,) = chains(recording)
    trajectories, folds = design(recording, chain, 0)
    gains = [recording.trajectories[t].conditions["p_gain"] for t in trajectories]
    assert len(set(folds)) == 3
    assert all(len({g for g, f in zip(gains, folds, strict=True) if f == fold}) == 1 for fold in set(folds))
    recording = blank()
    (chain,) = chains(recording)
    assert len(set(design(recording, chain, 0)[1])) == 5


def test_intervals_widen_with_disagreement_between_trajectories() -> None:
    rng = np.random.default_rng(0)
    basis = rng.normal(size=(6, 200, 2))
    gram = np.einsum("snp,snq->spq", basis, basis)
    ridge = np.zeros(2)
    noise = 1e-3 * rng.normal(size=(6, 200))
    white = covariance(gram, np.einsum("snp,sn->sp", basis, noise), ridge, 1e-3)
    offsets = np.array([1, -1, 1, -1, 1, -1])[:, None] * 0.1 * basis[:, :, 0]
    split = covariance(gram, np.einsum("snp,sn->sp", basis, noise + offsets), ridge, 1e-3)
    assert split[0, 0] > 100.0 * white[0, 0]
    assert np.all(np.diag(white) >= 0.99 * 1e-6 * np.diag(np.linalg.inv(gram.sum(0))))


def test_bootstrap_draws_whole_trajectories() -> None:
    weights = resamples(7, np.random.default_rng(0), 500)
    assert weights.shape == (500, 7)
    assert np.all(weights.sum(1) == 7)
    sse, count = np.arange(1.0, 8.0), np.full(7, 10.0)
    spread = rmse(sse, count, weights)
    assert spread.min() < rmse(sse, count) < spread.max()


def test_what_the_baseline_fits_is_no_candidate() -> None:
    from vd.kernels.servo.effects import EFFECTS

    (bare,) = chains(blank())
    (pendulum,) = chains(blank("pendulum"))
    assert "gravity_load" in candidates(bare, tuple(EFFECTS))
    assert "gravity_load" not in candidates(pendulum, tuple(EFFECTS))
    assert "payload_inertia" not in candidates(bare, tuple(EFFECTS))
    assert "joint_coupling" not in candidates(bare, tuple(EFFECTS))


@pytest.mark.parametrize(
    "key", ["kp", "command_delay.delay_s", "gravity_load.phase_rad", "torque_limit.tau_max_nm"]
)
def test_coordinates_invert_within_bounds(key: str) -> None:
    problem = problem_of(blank())
    scales = problem.scales(problem.rollouts.chain.start_row[0], 0.01)
    c = coordinate(key, scales)
    for value in (0.011, 0.2):
        assert float(c.value(c.inverse(value))) == pytest.approx(value)
    assert c.lower <= c.inverse(1e9) == c.upper
    x = np.array([c.lower, c.upper])
    moved = x + c.step(x, np.ones(2))
    assert np.all((moved >= c.lower) & (moved <= c.upper) & (moved != x))


def test_findings_say_where_friction_shows() -> None:
    recording = recorded({servo.COULOMB_TORQUE: 0.1})
    rollouts = Rollouts(chains(recording)[0], recording)
    row = rollouts.chain.start_row.copy()
    for own, true in TRUE.items():
        row[0, own] = true
    found = findings(
        recording, rollouts.predict(row[None])[0].astype(float), {"j": noise_floor(recording, 0)}
    )
    assert found and all(f.joint == "j" and f.where.startswith("j: ") for f in found)
    assert all(f.signature["rms_rad"] > f.signature["noise_floor_rad"] for f in found)
    same = findings(recording, np.concatenate([t.position for t in recording.trajectories]), {"j": 1e-3})
    assert same == []


def test_phases_of_a_step() -> None:
    recording = recorded({})
    step = recording.trajectories[0]
    found = phases(step, 0, COUNT, 7.0)
    assert found["onset"][(step.time > 0.32) & (step.time < 0.42)].all()
    assert not found["onset"][step.time < 0.29].any()
    assert found["hold"][(step.time > 1.3) & (step.time < 1.5)].all()
    assert not found["hold"][(step.time > 0.32) & (step.time < 0.4)].any()
