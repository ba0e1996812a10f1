"""Whole analyses of small recordings: what is missing is named, or left open."""

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
from vd.gap.words import verdict_sentence
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
JITTER, BIAS = {"sigma_s": 0.008, "p_drop": 0.05}, {"bias_rad": 0.005}


def hidden(**effects: dict[str, float]) -> Recording:
    """A recording of the independent plant."""
    (made,) = simulate_hidden([Hiding("servo", effects=effects, seed=11)])
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
    # Friction was not the best alone: the evidence says with what it was accepted.
    accepted = {row.name: row.given for row in report.evidence if row.decision == "named"}
    assert {*accepted} == named(report) and accepted["coulomb_friction"] == ("gravity_load",)


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
        ("asymmetric_friction", "coulomb_friction", "dead_zone", "encoder_bias"),
    ),
    "a direction beside Stribeck friction": (
        {**STRIBECK, servo.FRICTION_PLUS: 0.05},
        (
            "stribeck_friction",
            "asymmetric_friction",
            "coulomb_friction",
            "encoder_bias",
            "command_delay",
        ),
        {"stribeck_friction", "encoder_bias"},
        ("encoder_bias", "asymmetric_friction"),
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


def test_the_evidence_has_every_effect_also_what_was_not_fitted(tmp_path: Path) -> None:
    report = analysed(recorded({servo.COMMAND_DELAY: 0.03}), tmp_path, effects=tuple(EFFECTS))
    out = [row for row in report.evidence if row.reason.startswith("screened out: promised")]
    first = {row.name for row in report.evidence if row.round == 1}
    assert out and all(
        np.isnan(row.held_out_rmse_rad) and row.decision == "rejected" for row in out
    )
    assert {"load_friction", "encoder_bias", "command_delay"} <= first


@pytest.mark.slow
def test_an_acceleration_limit_that_cannot_follow_is_named(tmp_path: Path) -> None:
    """It lets small errors grow, so that the right model leaves more than noise."""
    recording = hidden(acceleration_limit={"a_max_rad_s2": 10.0})
    tried = ("acceleration_limit", "command_delay", "coulomb_friction", "torque_saturation")
    report = analysed(recording, tmp_path / "gap", effects=tried)
    assert report.verdict == "effects" and named(report) == {"acceleration_limit"}
    (estimate,) = report.effects[0].parameters.values()
    assert estimate.value == pytest.approx(10.0, rel=0.01)


@pytest.mark.slow
def test_delays_that_vary_are_named_and_what_is_beside_them(tmp_path: Path) -> None:
    effects = ("command_jitter", "encoder_bias", "command_filter")
    true = {"command_jitter": JITTER, "encoder_bias": BIAS}
    report = analysed(hidden(**true), tmp_path, effects=effects)
    assert named(report) == set(true)
    for effect in report.effects:
        for key, found in effect.parameters.items():
            assert found.ci95[0] <= true[effect.name][key] <= found.ci95[1], key
