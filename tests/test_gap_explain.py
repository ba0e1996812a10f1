"""Whole analyses of small recordings: what is missing is named, or left open."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gap_recordings import recorded, true_row

import vd.kernels.servo.actuators as servo
from vd.gap.bench.hidden_plant import COGGING, OUTSIDE
from vd.gap.bench.hide import Hiding, simulate_hidden
from vd.gap.chain import chains
from vd.gap.result import Predictions, Report
from vd.gap.words import verdict_sentence, without_one
from vd.gap.workflow import explain
from vd.kernels.servo.effects import EFFECTS
from vd.logs.recording import Recording

SMALL = (
    "command_delay",
    "coulomb_friction",
    "torque_saturation",
    "thermal_drift",
    "command_filter",
)
STRIBECK = {servo.STRIBECK_STATIC: 0.13, servo.STRIBECK_SLIDING: 0.07, servo.STRIBECK_SPEED: 0.4}


def hidden(**effects: dict[str, float]) -> Recording:
    """A recording of the independent plant."""
    made = simulate_hidden(Hiding("servo", effects=effects, seed=11))
    return made.recording


def analysed(recording: Recording, out: Path, **options: object) -> Report:
    return explain(recording, None, out, workers=1, **{"effects": SMALL, **options})  # type: ignore[arg-type]


def named(report: Report) -> set[str]:
    return {effect.name for effect in report.effects}


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
    (effect,) = report.effects
    estimate = effect.parameters[parameter]
    assert effect.name == name and effect.confidence >= 0.9
    assert estimate.value == pytest.approx(value, rel=0.1)
    assert report.held_out.identified_rmse_rad < 1.3 * report.noise_floor_rad


def test_two_causes_are_found_together(tmp_path: Path) -> None:
    causes = {servo.GRAVITY_TORQUE: 0.3, servo.GRAVITY_PHASE: -1.0, servo.COULOMB_TORQUE: 0.08}
    effects = ("coulomb_friction", "asymmetric_friction", "gravity_load", "encoder_bias")
    report = analysed(recorded(causes), tmp_path, effects=effects)
    assert named(report) == {"coulomb_friction", "gravity_load"}
    # Each has its own credit, and neither that of both.
    credits = {effect: model.rmse_rad for _, effect, model in without_one(report)}
    assert {*credits} == named(report)
    assert all(error > 2.0 * report.identified.rmse_rad for error in credits.values())
    assert sum(model.effects == () for model in report.compared) == 1


def test_an_offset_beside_stribeck_friction_is_found_behind_friction_with_a_direction(
    tmp_path: Path,
) -> None:
    """What is best alone has neither of them."""
    effects = ("stribeck_friction", "asymmetric_friction", "coulomb_friction", "encoder_bias")
    report = analysed(recorded({**STRIBECK, servo.FRICTION_PLUS: 0.05}), tmp_path, effects=effects)
    assert named(report) == {"stribeck_friction", "encoder_bias"}


ALIKE = {
    "a load off the arm of a pendulum": (
        {servo.GRAVITY_TORQUE: 0.5, servo.GRAVITY_PHASE: 0.15},
        ("encoder_bias", "gravity_load", "coulomb_friction", "command_delay"),
        {"encoder_bias"},
        ("encoder_bias", "gravity_load"),
    ),
    "a late reading": (
        {servo.READ_DELAY: 0.025},
        ("command_delay", "read_delay", "coulomb_friction"),
        {"command_delay"},
        ("command_delay", "read_delay"),
    ),
    "friction with a direction": (
        {servo.FRICTION_PLUS: 0.09, servo.FRICTION_MINUS: 0.04},
        ("coulomb_friction", "asymmetric_friction", "encoder_bias", "gravity_load"),
        {"asymmetric_friction"},
        ("asymmetric_friction", "coulomb_friction", "encoder_bias"),
    ),
}


@pytest.mark.parametrize("cause", ALIKE)
def test_a_name_says_for_what_it_stands(cause: str, tmp_path: Path) -> None:
    """Causes that leave the same positions whatever the motion.

    One is named, and nothing is left open.
    """
    columns, effects, names, stands = ALIKE[cause]
    recording = recorded(columns, model="pendulum" if "pendulum" in cause else "servo")
    report = analysed(recording, tmp_path, effects=effects)
    assert named(report) == names
    assert report.ambiguous == (stands,)
    assert report.open_sets == () and report.next_experiment == ""
    assert "tands for" in verdict_sentence(report)


def test_nothing_hidden_is_no_gap(tmp_path: Path) -> None:
    report = analysed(recorded({}), tmp_path)
    assert report.verdict == "no_gap" and not report.effects and not report.ambiguous
    assert np.isfinite(Predictions.read(tmp_path / "predictions.npz").identified).all()


def test_progress_counts_what_is_done_and_shows_no_share_of_what_nobody_knows(
    tmp_path: Path,
) -> None:
    lines: list[str] = []
    recording = recorded({servo.COULOMB_TORQUE: 0.05})
    analysed(recording, tmp_path, effects=("coulomb_friction",), progress=lines.append)
    assert lines[0].startswith("find: j (1 of 1): baseline") and "%" not in "".join(lines)
    done = re.findall(r"explain: j \(1 of 1\): fits done: (\d+)", "\n".join(lines))
    assert len(done) > 2 and sorted({*map(int, done)}) == [*map(int, done)]


def test_from_the_identified_model_on_there_is_no_gap(tmp_path: Path) -> None:
    recording = recorded({servo.COULOMB_TORQUE: 0.05})
    (chain,) = chains(recording)
    start = {"j": true_row(chain.start_row, {servo.COULOMB_TORQUE: 0.05})[0]}
    report = analysed(recording, tmp_path, start=start)
    assert report.verdict == "no_gap" and not report.effects


def test_a_cause_among_no_candidates_is_unknown(tmp_path: Path) -> None:
    report = analysed(recorded({servo.BACKLASH_WIDTH: 0.08}), tmp_path, effects=("thermal_drift",))
    assert report.verdict == "unknown" and not report.effects


@pytest.mark.slow
def test_a_cause_outside_the_table_is_unknown(tmp_path: Path) -> None:
    effects = ("coulomb_friction", "gravity_load", "encoder_bias", "backlash", "command_delay")
    report = analysed(hidden(**{COGGING: OUTSIDE[COGGING]}), tmp_path, effects=effects)
    assert report.verdict == "unknown" and not report.effects


def test_few_trajectories_are_under_excited(tmp_path: Path) -> None:
    recording = recorded({servo.COULOMB_TORQUE: 0.05})
    report = analysed(replace(recording, trajectories=recording.trajectories[:4:3]), tmp_path)
    assert report.verdict == "under_excited" and not report.effects


def test_what_was_not_tried_has_its_reason_and_every_model_both_errors(tmp_path: Path) -> None:
    report = analysed(recorded({servo.COMMAND_DELAY: 0.03}), tmp_path, effects=tuple(EFFECTS))
    assert "stands for both" in report.not_tried["j"]["read_delay"]
    assert [model.effects for model in report.models] == [("command_delay",)]
    assert all(bool(model.why) == (model not in report.models) for model in report.compared)
    errors = [(model.rmse_rad, model.held_out_rmse_rad) for model in report.compared]
    assert np.isfinite(errors).all() and np.min(errors) > 0.0


@pytest.mark.slow
def test_an_acceleration_limit_that_cannot_follow_is_named(tmp_path: Path) -> None:
    """It lets small errors grow, so that the right model leaves more than noise."""
    recording = hidden(acceleration_limit={"a_max_rad_s2": 10.0})
    tried = ("acceleration_limit", "command_delay", "coulomb_friction", "torque_saturation")
    report = analysed(recording, tmp_path / "gap", effects=tried)
    assert report.verdict == "effects" and named(report) == {"acceleration_limit"}
    (estimate,) = report.effects[0].parameters.values()
    low, high = estimate.ci95
    assert low < 10.0 < high
    assert estimate.value == pytest.approx(10.0, rel=0.02)  # seven seeds: 0.02 to 1.05 % off


def test_delays_that_vary_are_unknown(tmp_path: Path) -> None:
    """No single prediction shows them, and their mean is no more than a part."""
    effects = ("command_delay", "command_filter", "coulomb_friction")
    recording = hidden(command_jitter={"sigma_s": 0.015, "p_drop": 0.2})
    report = analysed(recording, tmp_path, effects=effects)
    assert report.verdict == "unknown" and not report.effects
