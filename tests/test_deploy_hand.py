"""The simulated hand behind the motors, and which motor turns which joint."""

import json
from dataclasses import replace

import numpy as np
import pytest
from motor_plant import Drive, NewtonPlant

from vd.assets_usd.hands import load_hand
from vd.deploy.hardware.control_table import MODELS
from vd.deploy.hardware.joints import CalibrationError, JointMotors, read_joints
from vd.kernels.servo.actuators import COULOMB_TORQUE
from vd.sim.cfg import SimCfg

MODEL = "XM430-W210"


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture
def turned(hand) -> JointMotors:
    """Motors mounted every which way."""
    rng = np.random.default_rng(0)
    signs, angles = rng.choice([-1.0, 1.0], 9), rng.uniform(-0.5, 0.5, 9)
    turned = zip(hand.motors, signs, angles, strict=True)
    return JointMotors(hand, tuple(replace(motor, sign=s, offset_rad=o) for motor, s, o in turned))


def save(joints: JointMotors, path, hand: str) -> dict:
    """Write a calibration file."""
    rows = zip(joints.names, joints.ids, joints.sign, joints.offset, strict=True)
    motors = [{"joint": n, "id": i, "sign": int(s), "offset_rad": float(o)} for n, i, s, o in rows]
    record = {"format": "vd-motors/1", "hand": hand, "motors": motors}
    path.write_text(json.dumps(record))
    return record


def drives(joints: JointMotors, goal: np.ndarray | None) -> list[Drive]:
    angles = [None] * len(joints.ids) if goal is None else list(joints.to_motor(goal))
    return [Drive(angle, 200.0, 6.0, 2.6) for angle in angles]


def test_the_hand_goes_where_its_motors_drive_and_falls_without_them(hand, turned):
    plant = NewtonPlant(turned)
    reset = hand.start
    np.testing.assert_allclose(turned.to_joint(plant.read()[0]), reset, atol=1e-6)
    goal = reset + np.tile([0.1, 0.2, 0.3], 3)
    for _ in range(60):
        plant.advance(0.02, drives(turned, goal))
    position, velocity, torque = plant.read()
    # Gravity bends the joints by torque over stiffness, and the motors' torque says so.
    np.testing.assert_allclose(turned.to_joint(position), goal, atol=0.05)
    np.testing.assert_allclose(
        turned.sign * torque / hand.kp, goal - turned.to_joint(position), atol=0.01
    )
    assert np.abs(velocity).max() < 0.05
    for _ in range(60):
        plant.advance(0.02, drives(turned, None))
    assert np.abs(turned.to_joint(plant.read()[0]) - goal).max() > 0.3
    assert np.abs(plant.read()[2]).max() == 0.0


def test_limits_are_the_hands_in_the_motors_frame(hand, turned):
    turned = JointMotors(hand, tuple(replace(motor, model=MODEL) for motor in turned.motors))
    settings = turned.settings()
    for axis, id in enumerate(turned.ids):
        ends = turned.to_motor(np.stack([hand.lower, hand.upper]))[:, axis]
        assert settings[id].lower_rad == min(ends) and settings[id].upper_rad == max(ends)
        torque = settings[id].current_limit_a * MODELS[MODEL].torque_nm_per_a
        assert torque == pytest.approx(hand.effort[axis], rel=1e-6)
    far = JointMotors(
        hand, tuple(replace(motor, offset_rad=motor.offset_rad + 3.0) for motor in turned.motors)
    )
    with pytest.raises(CalibrationError, match=r"f0_j1, motor 10: its range"):
        far.settings()


def test_a_calibration_is_read_back_and_a_wrong_one_refused(hand, turned, tmp_path):
    path = tmp_path / "motors.json"
    save(turned, path, hand.name)
    again = read_joints(hand, path)
    assert again.ids == turned.ids
    np.testing.assert_array_equal(again.offset, turned.offset)
    for name in ("dclaw4", ""):  # another hand may have joints of the same names
        save(turned, path, name)
        with pytest.raises(CalibrationError, match=rf"motors\.json .*names '{name}'.*dclaw3"):
            read_joints(hand, path)
    with pytest.raises(CalibrationError, match=r"^--calibration \S+none\.json: .*leave"):
        read_joints(hand, tmp_path / "none.json")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"sign": 2}, r"motors\.sign of f0_j2 is 2; it is 1, or -1"),
        ({"id": 10}, r"motors\.id are \[10, 10, 12.*give each motor its own"),
        ({"id": "11"}, r"motors\[1\]\.id: expected int, got '11'"),
        ({"offset_rad": float("nan")}, r"motors\.offset_rad of f0_j2 is nan"),
        (
            {"offset": 0.1},
            r"motors\[1\] has no field offset; is it offset_rad\? it has id, joint, offset_rad, "
            r"sign",
        ),
        ({"sign": None}, r"motors\[1\] has no sign; name it"),
        ({"joint": "f0_j1"}, "motors has 2 entries of f0_j1"),
        ({"joint": "thumb"}, "motors has no entries of f0_j2"),
    ],
)
def test_what_is_no_calibration_is_refused_with_file_and_field(
    hand, turned, tmp_path, change, reason
):
    path = tmp_path / "motors.json"
    record = save(turned, path, hand.name)
    record["motors"][1] |= change
    record["motors"][1] = {
        name: value for name, value in record["motors"][1].items() if value is not None
    }
    path.write_text(json.dumps(record))
    with pytest.raises(CalibrationError, match=rf"motors\.json.*{reason}"):
        read_joints(hand, path)


@pytest.mark.parametrize("effect", [None, COULOMB_TORQUE])
def test_goals_and_readings_do_not_wait_for_steps(hand, effect):
    """Asked in between, a hand in steps of 2 ms is where one in steps of a quarter millisecond is."""
    joints = read_joints(hand)
    if effect is not None:
        servo = hand.servo.copy()
        servo[:, effect] = 0.1
        hand = replace(hand, servo=servo)
    coarse, fine = (NewtonPlant(joints, SimCfg(physics_hz=hz)) for hz in (480.0, 3840.0))
    rng = np.random.default_rng(0)
    reset = hand.start
    errors, speeds = [], []
    for step in range(60):
        goal = reset + 0.3 * np.sin(0.4 * step) * np.tile([1.0, 1.0, -1.0], 3)
        for seconds in rng.uniform(0.001, 0.02, 2):
            told = []
            for plant in (coarse, fine):
                plant.advance(seconds, drives(joints, goal))
                told.append(plant.read())
            errors.append(np.abs(told[0][0] - told[1][0]).max())
            speeds.append(np.abs(told[1][1]).max())
    # Late by as much as a pair of steps, 4 ms, they would be off by 4 mrad for each rad/s.
    assert max(speeds) > 2.0 and max(errors) < 0.001 * max(speeds)


def test_the_recorded_steps_are_the_solvers(hand):
    """Fingers that press on each other.

    Contacts come and go, and the solver's iterations differ.
    """
    joints = read_joints(hand)
    recorded, stepped = NewtonPlant(joints), NewtonPlant(joints)
    goal = np.tile([0.3, hand.lower[1], hand.lower[2]], 3)
    contacts = []
    for _ in range(40):
        recorded.advance(2.0 * recorded.cfg.physics_dt + 1e-9, drives(joints, goal))
        stepped.advance(0.0, drives(joints, goal))
        stepped._hold(goal)
        stepped._two_steps()
        contacts.append(int(stepped.sim.solver.mjw_data.nacon.numpy()[0]))
        np.testing.assert_array_equal(recorded.joint_q, stepped.joint_q)
    assert contacts[0] == 0 < max(contacts)
