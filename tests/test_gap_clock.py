"""Gaps so large that small things grow: errors of the clock, and what the joints beside one do."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_gap_fit import problem_of
from test_gap_judge import FLOOR, made_up

from vd.gap.clock import GROWN, swayed, weighted
from vd.gap.coordinates import Scales
from vd.gap.fit import JointProblem
from vd.gap.hide import Hiding, simulate_hidden
from vd.gap.jitter import sway
from vd.gap.joint_fit import JointFit
from vd.gap.select import Selection
from vd.gap.sketch import outline, sketched
from vd.gap.statistics import resamples
from vd.gap.veil import Veil
from vd.gap.workflow import explain

LIMIT = "acceleration_limit.a_max_rad_s2"


@functools.cache
def fitted(limit: float) -> tuple[JointProblem, JointFit, Scales]:
    """A servo whose profile accelerates with up to ``limit`` [rad/s^2], and the fit of the right model."""
    effects = {"acceleration_limit": {"a_max_rad_s2": limit}}
    (made,) = simulate_hidden([Hiding("servo", effects=effects, seed=11)])
    problem = problem_of(made.recording)
    base = problem.rollouts.chain.start_row
    scales = problem.scales(base[0], problem.floor)
    start = {"velocity_limit": 1.05 * scales.speed, LIMIT: 0.97 * limit}
    return problem, problem.fit(base, tuple(effects), [start], scales), scales


def spread(problem: JointProblem, veil: Veil) -> list[float]:
    return [float(np.sqrt(np.mean(part**2))) for part in problem.split(veil.growth)]


def selection(run: object = None, **options: object) -> Selection:
    chosen = {"candidates": (), "floor": FLOOR, **options}
    return Selection(
        weights=resamples(10, np.random.default_rng(0)),
        run=run,  # type: ignore[arg-type]
        joint=0,
        others=(),
        scales=Scales(3.0, 0.5, 2.0, 6.0, 70.0, 1e-3, 1e-3, 12.0),
        **chosen,  # type: ignore[arg-type]
    )


def test_a_profile_that_follows_its_command_lets_no_error_of_the_clock_grow() -> None:
    problem, fit, scales = fitted(150.0)
    veil = sway(problem, fit, scales)
    assert max(spread(problem, veil)) < 1.05 and not veil.shift.any()
    assert fit.rmse < 1.05 * problem.floor


def test_where_a_profile_cannot_follow_the_right_model_leaves_noise_on_weighted_samples_only() -> None:
    problem, fit, scales = fitted(10.0)
    veil = sway(problem, fit, scales)
    grown = spread(problem, veil)
    assert max(grown) > 2.0 * GROWN and sorted(grown)[len(grown) // 2] < 1.05, "not where it can follow"
    seen = problem.through(veil).fit(fit.rows, fit.effects, [fit.values], scales)
    assert fit.rmse > 2.0 * problem.floor > 2.0 * seen.rmse
    assert seen.values[LIMIT] == pytest.approx(10.0, rel=1e-3)


@pytest.mark.parametrize("grown", [False, True])
def test_a_search_asks_once_whether_errors_grow_and_weighs_all_but_chance(grown: bool) -> None:
    fit, asked = made_up(("acceleration_limit",), 3.0 * FLOOR), []
    growth = np.ones(int(fit.count.sum()))
    growth[: int(fit.count[0])] = 2.0 * GROWN if grown else 1.0
    veil = Veil(np.zeros_like(growth), growth)

    def run(calls: list) -> list:
        asked.extend(calls)
        return [veil for _ in calls]

    search = selection(run)
    assert (swayed(search, fit) is veil) == grown
    assert swayed(search, made_up(("acceleration_limit",), FLOOR)) is None, "noise"
    assert swayed(search, made_up(("acceleration_limit", "command_jitter"), 3.0 * FLOOR)) is None, "chance"
    assert [name for name, _ in asked] == ["sway"]
    seen = weighted(search, veil)
    assert swayed(seen, fit) is None, "asked already"
    seen.run([("fit", {}), ("fit", {"veil": "of chance"}), ("look", {})])
    assert [options.get("veil") for _, options in asked[1:]] == [veil, "of chance", None]


@pytest.mark.slow
def test_an_acceleration_limit_that_cannot_follow_is_named_with_the_samples_weighted(tmp_path: Path) -> None:
    hiding = Hiding("servo", effects={"acceleration_limit": {"a_max_rad_s2": 10.0}}, seed=11)
    (made,) = simulate_hidden([hiding])
    said: list[str] = []
    tried = ("acceleration_limit", "command_delay", "coulomb_friction", "torque_saturation")
    report = explain(made.recording, None, tmp_path, effects=tried, workers=1, progress=said.append)
    assert report.verdict == "effects" and [one.name for one in report.effects] == ["acceleration_limit"]
    (estimate,) = report.effects[0].parameters.values()
    assert estimate.value == pytest.approx(10.0, rel=0.01)
    assert sum("errors of the clock grow" in line for line in said) == 1


def test_with_the_limit_in_the_model_nothing_is_left_to_explain(tmp_path: Path) -> None:
    problem, fit, _ = fitted(10.0)
    assert fit.held_out_rmse > 2.0 * problem.floor
    recording, tried = problem.rollouts.recording, ("command_delay", "coulomb_friction")
    start = {recording.joints[0]: fit.rows[0]}
    report = explain(recording, None, tmp_path, effects=tried, workers=1, start=start)
    assert report.verdict == "no_gap" and "errors of the recording's clock" in report.joints[0].reason


@pytest.mark.parametrize(
    ("gap", "left", "rough"),
    [(300.0, 3.0, True), (30.0, 3.0, False), (300.0, 1.0, False), (300.0, 60.0, False)],
    ids=["nearly all", "too small a gap", "all", "too little"],
)
def test_a_joint_is_outlined_where_one_effect_explains_nearly_all_of_a_large_gap(
    gap: float, left: float, rough: bool
) -> None:
    best = made_up(("acceleration_limit",), left * FLOOR)
    search = selection()
    search.fit_candidates = lambda _: {"acceleration_limit": best}  # type: ignore[assignment,method-assign,misc]
    baseline = made_up((), gap * FLOOR)
    assert outline(search, baseline) is (best if rough else None)
    few = replace(baseline, **{key: getattr(baseline, key)[:2] for key in ("sse", "held_out", "count")})
    assert outline(search, few) is None, "none to hold out"


def test_the_other_joints_are_sketched_with_what_explains_them_as_well() -> None:
    rough = made_up(("acceleration_limit",), 3.0 * FLOOR)
    plain = {name: made_up((), 200.0 * FLOOR) for name in ("same", "other")}
    asked = {}

    def fit(name: str, left: float) -> JointFit:
        def made(effects: tuple[str, ...], values: dict[str, float]) -> JointFit:
            asked[name] = effects, values
            return made_up(effects, left * FLOOR)

        return made  # type: ignore[return-value]

    found = sketched(rough, plain, {"same": fit("same", 90.0), "other": fit("other", 110.0)})  # type: ignore[dict-item]
    assert list(found) == ["same"] and found["same"].rmse == pytest.approx(90.0 * FLOOR)
    kept = {key: value for key, value in rough.values.items() if "." in key}
    assert asked["same"] == asked["other"] == (("acceleration_limit",), kept)
