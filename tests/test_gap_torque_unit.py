"""Torques of a machine without known masses, in the unit that the recording tells."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gap_reports import BASE, rubbing_servo, servo_report

from vd.bench.hide import Hiding, simulate_hidden
from vd.gap.chain import chains
from vd.gap.result import Estimate, NamedEffect, parameter_columns
from vd.gap.rollout import Rollouts
from vd.gap.torque_unit import in_known_unit, known_stiffness, relative_torques
from vd.kernels.servo.effects import EFFECTS

JOINTS = ("a", "b")


def machine(model="servo", joints=JOINTS, **servo):
    (hidden,) = simulate_hidden([Hiding(model, joints=joints, base_spread=0.0)])
    return replace(hidden.recording, servo=servo)


def effect(name, joints=("a",), **values):
    units = {p.name: p.unit for p in EFFECTS[name].parameters}
    estimates = {key: Estimate(v, (0.9 * v, 1.1 * v), units[key]) for key, v in values.items()}
    return NamedEffect(name, joints, 1.0, estimates)


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """A report on a servo."""
    return servo_report(rubbing_servo(tmp_path_factory.mktemp("recordings") / "servo"))[0]


def report(told, *effects, joints=JOINTS):
    """It with other joints, all of the same base, and other effects."""
    fit = replace(told.baseline, parameters={joint: dict(BASE) for joint in joints})
    sag = replace(told.evidence[0], joints=("a",), name="supply_sag", parameters={"relative": 0.5})
    source = replace(told.recording, joints=joints)
    return replace(told, effects=effects, baseline=fit, identified=fit, evidence=(sag,), recording=source)


def test_a_known_stiffness_makes_torques_absolute_and_nothing_else(told):
    recording = machine(kp_nm_rad={"a": 6.0})
    found = report(told, effect("coulomb_friction", tau_c_nm=0.1), effect("command_delay", delay_s=0.04))
    known = in_known_unit(found, recording)
    friction, delay = known.effects
    torque = friction.parameters["tau_c_nm"]
    assert (torque.value, *torque.ci95) == pytest.approx((0.2, 0.18, 0.22)) and torque.unit == "N m"
    assert delay == found.effects[1]
    expected = {"kp": 6.0, "kd": 0.6, "velocity_limit": 7.0, "inertia": 4e-3}
    assert known.identified.parameters["a"] == known.baseline.parameters["a"] == pytest.approx(expected)
    assert known.identified.parameters["b"] == BASE
    assert known.evidence[0].parameters == {"relative": 0.25}
    assert known.recording.relative_torques, "joint b's are"
    whole = replace(recording, servo={"kp_nm_rad": {"a": 6.0, "b": 1.5}})
    assert not in_known_unit(found, whole).recording.relative_torques
    assert in_known_unit(known, recording) == known, "a second time changes nothing"


def test_what_moves_is_the_same_in_either_unit(told):
    recording = machine(joints=("a",), kp_nm_rad=2.3)
    effects = (
        effect("stribeck_friction", tau_s_nm=0.2, tau_c_nm=0.1, v_s_rad_s=0.5),
        effect("supply_sag", relative=0.4),
        effect("torque_limit", tau_max_nm=0.7),
        effect("integral_action", k_i=2.0),
        effect("payload_inertia", j_kgm2=2e-3),
        effect("elastic_transmission", k_nm_rad=5.0, c_nms_rad=5e-3, j_kgm2=1e-3),
        effect("thermal_drift", rate_per_s=0.01),
        effect("load_friction", k_load=0.1),
    )
    found = report(told, *effects, joints=("a",))
    (chain,) = chains(recording, None)
    rows = []
    for each in (found, in_known_unit(found, recording)):
        row = np.array(chain.start_row)
        for column, value in parameter_columns(each, "a").items():
            row[0, column] = value
        rows.append(row)
    first, second = Rollouts(chain, recording).predict(np.array(rows))
    assert np.ptp(first) > 1.0
    np.testing.assert_allclose(second, first, atol=2e-5)


def test_where_masses_are_known_torques_are_absolute_anyway(told):
    pendulum = machine("pendulum", ("a",))
    assert relative_torques(pendulum) and known_stiffness(pendulum, "a") is None
    load = {"payload_kg": 0.4, "arm_length_m": 0.1}
    weighed = replace(
        pendulum,
        trajectories=tuple(replace(t, conditions={**t.conditions, **load}) for t in pendulum.trajectories),
    )
    assert not relative_torques(weighed)
    found = report(told, effect("torque_limit", tau_max_nm=0.7), joints=("a",))
    assert in_known_unit(found, replace(weighed, servo={"kp_nm_rad": 6.0})) == found
    assert not relative_torques(replace(weighed, model="dclaw3", path=Path("r")))
