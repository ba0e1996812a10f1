"""Torques of a machine without known masses, in the unit that the recording tells."""

from dataclasses import replace

import numpy as np
import pytest
from gap_recordings import TRUE, problem_of, recorded

from vd.gap.chain import relative_torques
from vd.kernels.servo import actuators as servo

FRICTION = 0.06


def test_a_known_stiffness_makes_torques_absolute_and_nothing_else():
    recording = recorded({servo.COULOMB_TORQUE: FRICTION})
    fits = []
    for told in (None, 2.0 * TRUE[servo.KP]):
        problem = problem_of(
            replace(recording, servo={} if told is None else {"kp_nm_rad": {"j": told}})
        )
        start = problem.rollouts.chain.start_row
        scales = problem.scales(start[0], 0.02)
        starts = [{"coulomb_friction.tau_c_nm": 0.1 * scales.torque}]
        fits.append(problem.fit(start, ("coulomb_friction",), starts, scales, iterations=20))
    known, other = fits[1].values, fits[0].values
    assert known["coulomb_friction.tau_c_nm"] == pytest.approx(2.0 * FRICTION, rel=0.02)
    factors = {"velocity_limit": 1.0, "kd": 2.0, "inertia": 2.0, "coulomb_friction.tau_c_nm": 2.0}
    for key, factor in factors.items():
        assert known[key] == pytest.approx(factor * other[key], rel=0.01), key
    assert fits[1].rows[0, servo.KP] == pytest.approx(2.0 * TRUE[servo.KP])
    np.testing.assert_allclose(fits[1].rmse, fits[0].rmse, rtol=1e-3)


def test_where_masses_or_the_stiffness_are_known_torques_are_absolute():
    servos, pendulum = recorded({}), recorded({}, model="pendulum")
    assert relative_torques(servos) and relative_torques(pendulum)
    assert not relative_torques(replace(servos, servo={"kp_nm_rad": 2.3}))
    assert relative_torques(replace(servos, joints=("j", "k"), servo={"kp_nm_rad": {"j": 2.3}}))
    load = {"payload_kg": 0.4, "arm_length_m": 0.1}
    weighed = tuple(replace(t, conditions=load) for t in pendulum.trajectories)
    assert not relative_torques(replace(pendulum, trajectories=weighed))
    assert not relative_torques(replace(servos, model="dclaw3"))
