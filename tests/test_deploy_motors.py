"""Hands of other motors.

The map in the USD, models mixed on one bus, current-based control, and refusals.
"""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from motor_model import Motor
from motor_plant import NewtonPlant
from simulated_hand import simulated_bus

from vd.assets_usd.hand_data import HandModel, MotorModel
from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hands import load_hand
from vd.deploy.clock import Pacer
from vd.deploy.hardware import check
from vd.deploy.hardware.connect import Connection
from vd.deploy.hardware.control_table import MODELS
from vd.deploy.hardware.joints import CalibrationError, read_joints
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.log import LogWriter
from vd.deploy.loop.loop import ControlLoop
from vd.deploy.loop.policy_runner import PolicyDecision, PolicyRunner
from vd.deploy.safety.safety import SafeHand, StoppedError
from vd.envs.cfg import ReorientCfg
from vd.policy.stopping import StoppingRule

GOAL = np.array([0.0, 0.0, 0.0, 1.0])
MIXED = (
    MotorModel("XC330-M288-T", 3, sign=-1.0, offset_rad=0.3, p_gain=600, d_gain=200, current=0.55),
    MotorModel("XL430-W250", 7, gear=1.5),
    MotorModel("XM430-W210", 9, sign=-1.0, offset_rad=-0.2),
)
"""Motors of one finger: a LEAP's, one that measures no current, and one of the size of a
D'Claw's.
"""


def with_motors(motors: tuple[MotorModel, ...]) -> HandModel:
    """A D'Claw whose fingers have these motors, each finger its own IDs."""
    hand = load_hand("dclaw3")
    every = (replace(motor, id=motor.id + 10 * finger) for finger in range(3) for motor in motors)
    return replace(hand, motors=tuple(every))


class Bending(PolicyRunner):
    """A policy that bends the third joint of the first finger."""

    def decide(self, sensed):
        """One action of one joint."""
        action = np.zeros(len(sensed.joint_q))
        action[2] = 1.0
        return PolicyDecision(action, float("nan"))


def fly(hand: HandModel, folder) -> tuple[np.ndarray, list[Motor]]:
    """A second of the whole loop on the hand's twin.

    How the joints moved [rad] [D], and the motors.
    """
    joints = read_joints(hand)
    plant = NewtonPlant(joints)
    with simulated_bus(hand, joints, plant) as (line, bus):
        with SafeHand(bus, joints) as safe:
            safe.arm()
            safe.move(hand.start, 2.0)
            before = plant.joint_q.copy()
            log = LogWriter(
                folder, hand, {"goals": [list(GOAL)]}, servo=joints.servo(), clock=bus.clock
            )
            task = ReorientCfg()
            runner = Bending(task, StoppingRule())
            pacer, actions = Pacer(12.0, bus.clock), ActionFilter(hand, task)
            ControlLoop(safe, runner, actions, pacer, log, episode_s=1.0, hold_s=0.0).run([GOAL])
            moved = plant.joint_q - before
        log.finish("done")
        return moved, line.motors


def assert_bent(moved: np.ndarray) -> None:
    """The joint that was to move did, and the others stayed."""
    assert moved[2] > 0.3 and np.abs(np.delete(moved, 2)).max() < 0.15


def test_a_leap_hand_flies_with_the_motors_of_its_file(tmp_path, shared_dir):
    path = shared_dir / "hands" / "leap_hand" / "leap_hand_right.urdf"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    hand = import_hand(path, tmp_path, "leap").hand
    turned = [
        replace(motor, sign=-1.0, offset_rad=0.1) if motor.id == 2 else motor
        for motor in hand.motors
    ]
    moved, motors = fly(replace(hand, motors=tuple(turned)), tmp_path / "log")
    assert_bent(moved)
    assert [motor.id for motor in motors[:4]] == [1, 0, 2, 3]
    items = (
        "operating_mode",
        "goal_current",
        "position_p_gain",
        "position_i_gain",
        "position_d_gain",
    )
    told = [[motor.get(name) for name in items] for motor in motors]
    assert told[0] == [5, 550, 600, 0, 200] and told[1] == [5, 550, 450, 0, 150]


def test_models_mixed_on_one_bus_move_the_joints_they_are_said_to(tmp_path):
    moved, motors = fly(with_motors(MIXED), tmp_path / "log")
    assert_bent(moved)
    assert [motor.get("operating_mode") for motor in motors[:3]] == [5, 3, 3]


def test_states_are_in_the_units_of_each_model_and_a_wrong_model_is_named(monkeypatch):
    monkeypatch.setattr(check, "CYCLES", 1)
    hand = with_motors(MIXED)
    joints = read_joints(hand)
    with simulated_bus(hand, joints) as (line, bus):
        line.plant.position[:] = joints.to_motor(hand.start)
        bus.clock.sleep(0.02)
        connection = Connection(joints, bus)
        bus.states.forget()
        assert [one.words for one in check.preflight(connection) if not one.ok] == []
        position, velocity, torque = line.plant.read()
        torque[:3] = 0.93 / 2, 1.5 / 2, 3.0 / 2  # half of what they stall at
        monkeypatch.setattr(line.plant, "read", lambda: (position, velocity, torque))
        bus.clock.sleep(0.02)
        state = bus.read_state()
        np.testing.assert_allclose(state.current[:3], [1.80 / 2, 1.4 / 2, 2.3 / 2], atol=0.0014)
        told = joints.state(state)
        np.testing.assert_allclose(told.position, hand.start, atol=0.002)
        line.motors[0].temperature = 61.0
        bus.clock.sleep(0.02)
        with (
            SafeHand(bus, joints) as safe,
            pytest.raises(StoppedError, match="motor 3: 61 deg C, over 60"),
        ):
            safe.read()
        line.motors[0] = Motor(MODELS["XL330-M288"], 3)
        (wrong,) = (one.words for one in check.preflight(connection) if not one.ok)
        assert "motor 3 is XL330-M288, not XC330-M288" in wrong


@pytest.mark.parametrize("model", ["XL330-M288", "XC330-M288", "XM430-W350", "XM540-W270"])
def test_a_current_limit_bounds_the_torque_in_current_based_mode(model):
    motor = Motor(MODELS[model], 1)
    full = motor.drive().torque_limit
    motor.put("goal_current", 100)
    assert motor.drive().torque_limit == full
    motor.put("operating_mode", 5)
    assert motor.drive().torque_limit == pytest.approx(
        100 * MODELS[model].current_unit_a * MODELS[model].torque_nm_per_a
    )


@pytest.mark.parametrize(
    ("motors", "said"),
    [
        (
            (replace(MIXED[1], current=0.5), *MIXED[1:]),
            "f0_j1 has a largest current, which XL430-W250",
        ),
        (
            (replace(MIXED[0], model="AX-12A"), *MIXED[1:]),
            "no motor is called AX-12A; choose of XL330",
        ),
        (None, "does not say which motor turns f0_j1"),
    ],
)
def test_motors_that_cannot_be_driven_are_refused(motors, said):
    hand = (
        replace(load_hand("dclaw3"), motors=(None,) * 9) if motors is None else with_motors(motors)
    )
    with pytest.raises(CalibrationError, match=said):
        read_joints(hand)
