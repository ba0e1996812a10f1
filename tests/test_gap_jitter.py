"""Delays that vary by chance: how much they vary, what that does to samples, what is found beside them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_gap_fit import problem_of

from vd.gap.assemble import _entry
from vd.gap.explanation import Accepted, intervals
from vd.gap.fit import JointProblem
from vd.gap.hide import Hidden, Hiding, simulate_hidden
from vd.gap.jitter import DRAWS, JitterFit, bound_jitter, fit_jitter, look
from vd.gap.joint_fit import JointFit
from vd.gap.rollout import Rollouts
from vd.gap.veil import Veil
from vd.gap.workflow import explain

JITTER = {"sigma_s": 0.008, "p_drop": 0.05}
BIAS = {"bias_rad": 0.005}


def hidden(**effects: dict[str, float]) -> Hidden:
    (found,) = simulate_hidden([Hiding("servo", effects={"command_jitter": JITTER, **effects}, seed=11)])
    return found


def fitted(problem: JointProblem, *effects: str, start: dict[str, float] | None = None) -> JointFit:
    base = problem.rollouts.chain.start_row
    scales = problem.scales(base[0], problem.floor)
    speed = {"velocity_limit": 1.05 * scales.speed}
    return problem.fit(base, effects, [{**speed, **(start or {})}], scales)


def test_a_veil_takes_the_mean_and_weighs_by_the_spread() -> None:
    seen = problem_of(hidden().recording)
    rows = seen.rollouts.chain.start_row[None]
    plain = seen.residuals(rows)[0]
    rng = np.random.default_rng(0)
    veil = Veil(rng.normal(0.0, 1e-3, plain.size), rng.uniform(1.0, 9.0, plain.size))
    through = seen.through(veil)
    assert through.residuals(rows)[0] == pytest.approx((plain - veil.shift) / veil.growth, rel=1e-9)
    last = [int(seen.trajectories[-1])]
    part = seen.split(veil.shift)[-1], seen.split(veil.growth)[-1]
    assert through.residuals(rows, last)[0] == pytest.approx((seen.split(plain)[-1] - part[0]) / part[1])
    assert seen.residuals(rows)[0] == pytest.approx(plain), "the problem itself has not changed"


def test_through_its_veil_a_right_model_leaves_the_noise_floor_and_chance_bends_no_parameter() -> None:
    made = hidden()
    seen = problem_of(made.recording)
    naive = fitted(seen)
    jitter, veil = look(seen, naive, seen.scales(naive.rows[0], seen.floor))
    for _ in range(2):
        behind = fitted(seen.through(veil))
        found, veil = fit_jitter(seen, behind, seen.scales(behind.rows[0], seen.floor), jitter)
        jitter = found.values["command_jitter.sigma_s"], found.values["command_jitter.p_drop"]
    behind = fitted(seen.through(veil))
    assert 0.5 < jitter[0] / JITTER["sigma_s"] < 1.5, "what is dropped is late as well"
    assert naive.rmse > 3.0 * seen.floor
    assert 0.7 * seen.floor < behind.rmse < 1.3 * seen.floor
    true = [made.truth["base"][key]["joint"] for key in ("inertia", "kp")]
    inertia = 3.0 * true[0] / true[1]  # torques are known up to one factor, which the nominal stiffness holds
    assert abs(behind.values["inertia"] - inertia) < 0.5 * abs(naive.values["inertia"] - inertia)
    calm = np.concatenate([np.abs(t.command[:, 0] - t.command[0, 0]) < 1e-9 for t in _motions(seen)])
    assert np.median(veil.growth[calm]) < 1.1 < np.median(veil.growth[~calm])


def test_a_motion_whose_command_stays_needs_one_draw() -> None:
    recording = hidden().recording
    held = recording.trajectories[2]
    calm = replace(held, command=np.full_like(held.command, held.command[0, 0]))
    parts = (*recording.trajectories[:2], calm, *recording.trajectories[3:])
    seen = problem_of(replace(recording, trajectories=parts))
    every = range(len(parts))
    seen = JointProblem(seen.rollouts, 0, every, every, seen.floor, seen.baseline)
    fit = fitted(seen)
    jitter = JitterFit(seen, fit, seen.scales(fit.rows[0], seen.floor))
    mean, variance = jitter.draws(0.008, 0.05)
    names = [replace(t, file=f"{t.file}#{draw}") for draw in range(DRAWS) for t in parts]
    drawing = Rollouts(seen.rollouts.chain, replace(recording, trajectories=tuple(names)))
    drawn = drawing.predict(jitter.row(0.008, 0.05)[None], joint=0)[0].reshape(DRAWS, -1).astype(float)
    assert mean == pytest.approx(drawn.mean(axis=0), abs=1e-9)
    spread = [part.sum() for part in np.split(drawn.var(axis=0, ddof=1), jitter.ends)]
    found = [part.sum() for part in np.split(variance, jitter.ends)]
    assert found == pytest.approx([(1.0 + 1.0 / DRAWS) * each for each in spread], rel=0.1, abs=1e-12)
    assert found[2] == 0.0 and len(jitter.needed) == DRAWS * (len(parts) - 1) + 1


def test_the_likelihood_finds_the_jitter_beside_an_effect() -> None:
    seen = problem_of(hidden(encoder_bias=BIAS).recording)
    fit = fitted(seen, "encoder_bias", start={"encoder_bias.bias_rad": 0.002})
    scales = seen.scales(fit.rows[0], seen.floor)
    both, _ = fit_jitter(seen, fit, scales, (0.003, 0.01))
    assert both.effects == ("encoder_bias", "command_jitter")
    both = bound_jitter(seen, both, scales)
    low, high = intervals(both, seen.floor)["command_jitter.sigma_s"]
    assert low < JITTER["sigma_s"] < high
    alone, _ = fit_jitter(seen, fitted(seen), scales, (0.003, 0.01))
    assert both.rmse < 0.8 * alone.rmse


@pytest.mark.slow
def test_an_effect_is_named_beside_chance(tmp_path: Path) -> None:
    effects = ("command_jitter", "encoder_bias", "dead_zone")
    report = explain(hidden(encoder_bias=BIAS).recording, None, tmp_path, workers=1, effects=effects)
    assert {effect.name for effect in report.effects} == {"command_jitter", "encoder_bias"}
    bias = next(e for e in report.effects if e.name == "encoder_bias").parameters["bias_rad"]
    assert bias.value == pytest.approx(BIAS["bias_rad"], rel=0.2) and bias.ci95[0] < bias.value < bias.ci95[1]


@pytest.mark.slow
def test_nothing_is_named_beside_chance_alone(tmp_path: Path) -> None:
    effects = ("command_jitter", "command_filter")
    report = explain(hidden().recording, None, tmp_path, workers=1, effects=effects)
    assert [effect.name for effect in report.effects] == ["command_jitter"]


def _motions(problem: JointProblem) -> list:
    recording = problem.rollouts.recording
    return [recording.trajectories[int(t)] for t in problem.trajectories]


def test_the_interval_of_all_joints_ends_where_a_parameter_does() -> None:
    def found(drop: float) -> Accepted:
        values = {"sigma_s": (0.002, 0.0015, 0.003), "p_drop": (drop, 0.0, 0.03)}
        return Accepted("command_jitter", 1.0, values, (), (), False)

    entry = _entry("command_jitter", [("f0_j1", found(0.02)), ("f0_j2", found(0.001))])
    low, high = entry.parameters["p_drop"].ci95
    assert low == 0.0 and 0.02 < high < 0.04, "no share of commands is less than none"
