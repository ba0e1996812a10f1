"""Limits and stops between a policy and the motors, on the twin over its pseudo-terminal."""

import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from vd.assets_usd.hands import load_hand
from vd.deploy.bus import MotorBus
from vd.deploy.control_table import MODELS, to_angle
from vd.deploy.joints import Joints, uncalibrated
from vd.deploy.motion import move, reset_pose
from vd.deploy.motor import Motor
from vd.deploy.safety import PERIOD_S, SafeHand, SafetyCfg, StoppedError
from vd.deploy.twin import Twin

MODEL = "XH430-V210"
BUSY_S = 3.0 * PERIOD_S
"""A hold takes one period at most where the machine has time: docs/results/deploy.md has it measured."""
QUICK = SafetyCfg(hold_s=0.05)
PATIENT = SafetyCfg(hold_s=0.05, misses=60, lost_s=2.0, watchdog_s=2.0)
"""Where it is not about times: on a busy machine the twin may not run for longer than a hand may wait."""


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture
def joints(hand) -> Joints:
    """Some motors turn the other way and are mounted elsewhere."""
    plain = uncalibrated(hand)
    rng = np.random.default_rng(1)
    return Joints(plain.names, plain.ids, rng.choice([-1.0, 1.0], 9), rng.uniform(-0.3, 0.3, 9))


@pytest.fixture
def twin(joints):
    with Twin([Motor(MODELS[MODEL], id) for id in joints.ids]) as served:
        served.plant.position[:] = joints.to_motor(reset_pose(3))
        yield served


@pytest.fixture
def bus(twin, hand, joints):
    # The SDK waits 34 ms for an answer; on a busy machine the twin may not run for longer.
    with MotorBus(twin.path, joints.ids, MODEL, retries=10) as opened:
        opened.configure(joints.settings(hand, MODEL))
        yield opened


def energised(twin) -> list[int]:
    return [motor.id for motor in twin.motors if motor.get("torque_enable")]


def push(twin) -> np.ndarray:
    """How far each motor's goal is from where it is [rad]; none if its torque is off."""
    error = [to_angle(m.get("goal_position")) - to_angle(m.get("present_position")) for m in twin.motors]
    return np.abs(error) * [motor.get("torque_enable") for motor in twin.motors]


def test_it_moves_in_the_joints_frame_and_ends_with_torque_off(bus, twin, hand, joints):
    said = []
    goal = reset_pose(3) + 0.2
    with SafeHand(bus, joints, hand, PATIENT, said.append) as safe:
        assert energised(twin) == []
        start = safe.arm()
        np.testing.assert_allclose(start.position, reset_pose(3), atol=0.002)
        assert len(energised(twin)) == 9 and push(twin).max() < 0.002
        worst = move(safe, goal, 1.0)
        assert worst.max() < 0.25
        end = time.monotonic() + 3.0  # the twin may have fallen behind
        while np.abs(safe.read().position - goal).max() > 0.01 and time.monotonic() < end:
            safe.beat()
        np.testing.assert_allclose(safe.read().position, goal, atol=0.01)
    assert energised(twin) == [] and said == ["torque off"]
    assert {motor.get("bus_watchdog") for motor in twin.motors} == {0}


def test_goals_keep_the_limits(bus, twin, hand, joints):
    cfg = replace(PATIENT, step_rad=0.3, margin_rad=0.1)
    with SafeHand(bus, joints, hand, cfg) as safe:
        here = safe.arm().position
        far = np.where(np.arange(9) % 2, 9.0, -9.0)
        sent = safe.command(far)
        np.testing.assert_allclose(np.abs(sent - here)[1:3], 0.3, atol=1e-9)
        assert sent[0] == pytest.approx(-0.3, abs=0.002)  # by the step; the limit is at -0.35
        for _ in range(100):
            safe.read()
            sent = safe.command(far)
            safe.beat()
            time.sleep(0.01)
        np.testing.assert_allclose(sent[::2], hand.lower[::2] + 0.1)
        assert safe.limited == 101
        with pytest.raises(StoppedError, match="9 finite angles"):
            safe.command(np.full(9, np.nan))
        with pytest.raises(StoppedError, match="9 finite angles"):
            safe.command(here)  # a stop stays


def run_until_stopped(safe: SafeHand, target: np.ndarray, seconds: float = 5.0) -> str:
    """A loop at 12 Hz that drives to ``target`` until something stops it; the reason."""
    end = time.monotonic() + seconds
    try:
        while time.monotonic() < end:
            safe.read()
            safe.command(target)
            safe.beat()
            time.sleep(PERIOD_S)
    except StoppedError as error:
        return str(error)
    return "nothing stopped it"


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (lambda twin: twin.faults.cut_off.add(11), "lost the bus: motor 11"),
        (lambda twin: setattr(twin.motors[4], "heat_c_per_s", 400.0), "motor 21"),
        (lambda twin: twin.motors[8].reboot(), "motor 32: its clock differs"),
        (lambda twin: os.kill(os.getpid(), signal.SIGINT), "Ctrl-C"),
        (lambda twin: os.kill(os.getpid(), signal.SIGHUP), "the terminal is gone"),
    ],
    ids=["cable", "heat", "restart", "ctrl-c", "hangup"],
)
def test_faults_stop_the_hand_and_are_named(bus, twin, hand, joints, fault, reason):
    bus.retries = 2
    target = reset_pose(3) + 0.3
    with SafeHand(bus, joints, hand, replace(PATIENT, lost_s=0.25, watchdog_s=0.3)) as safe:
        safe.arm()
        assert run_until_stopped(safe, target, 0.3) == "nothing stopped it"
        fault(twin)
        assert reason in run_until_stopped(safe, target)
        assert safe.report.held_s is not None
        time.sleep(0.1)
        # One motor cannot hear; its own watchdog has it hold a little later.
        assert np.sort(push(twin))[:8].max() < 0.02
    time.sleep(0.4)
    cut = sorted(twin.faults.cut_off)
    assert energised(twin) == cut and sorted(safe.report.unreleased) == cut
    assert push(twin).max() < 0.02


def test_a_blocked_joint_is_let_go(bus, twin, hand, joints):
    cfg = replace(PATIENT, step_rad=4.0, current_s=0.3)
    with SafeHand(bus, joints, hand, cfg) as safe:
        here = safe.arm().position
        twin.plant.blocked[2] = True
        target = here + np.eye(9)[2] * 1.5
        assert "f0_j3, motor 12" in run_until_stopped(safe, target)
        time.sleep(0.1)  # the packet is on its way
        assert push(twin)[2] < 0.02  # it does not press on
    assert energised(twin) == []


def test_deadlines_and_images_stop_the_hand(bus, twin, hand, joints):
    with SafeHand(bus, joints, hand, QUICK) as safe:
        safe.arm()
        for missed in (True, True, False, True, True):
            safe.beat(missed=missed)
        with pytest.raises(StoppedError, match="3 deadlines missed"):
            safe.beat(missed=True)
        assert safe.missed == 5
    with SafeHand(bus, joints, hand, QUICK) as safe:
        safe.arm()
        safe.image_at(time.monotonic())
        assert "image is" in run_until_stopped(safe, reset_pose(3))


def test_a_loop_that_stands_is_stopped_by_the_watchdog(bus, twin, hand, joints):
    with SafeHand(bus, joints, hand, QUICK) as safe:
        safe.arm()
        safe.read()
        safe.command(reset_pose(3) + 0.3)
        begin = time.monotonic()
        safe.beat()
        while (safe.report is None or safe.report.held_s is None) and time.monotonic() < begin + 5.0:
            time.sleep(0.005)
        assert 3 * PERIOD_S <= safe.report.detected_s - begin < 3 * PERIOD_S + BUSY_S
        assert safe.report.held_s - safe.report.detected_s < BUSY_S
        with pytest.raises(StoppedError, match="the loop stands"):
            safe.read()


def test_motors_stop_by_themselves_if_the_driver_dies(bus, twin, hand, joints):
    safe = SafeHand(bus, joints, hand, SafetyCfg())  # no block: nothing of ours stops it
    safe.arm()
    safe.command(reset_pose(3) + 0.3)
    time.sleep(0.6)
    assert {motor.get("bus_watchdog") for motor in twin.motors} == {-1}
    assert push(twin).max() < 0.02
    with SafeHand(bus, joints, hand, PATIENT) as again:  # and can be used again
        again.arm()
        here = again.read().position
        again.command(here + 0.2)
        time.sleep(0.2)
        assert (again.read().position - here).min() > 0.05


def test_an_exception_stops_the_hand(bus, twin, hand, joints):
    said = []
    with pytest.raises(ZeroDivisionError):
        with SafeHand(bus, joints, hand, QUICK, said.append) as safe:
            safe.arm()
            safe.command(reset_pose(3) + 0.3)
            _ = 1 / 0
    assert safe.report.held_s - safe.report.detected_s < BUSY_S
    assert energised(twin) == [] and said == ["stopped: ZeroDivisionError: division by zero; torque off"]


def test_the_hand_can_be_left_holding(bus, twin, hand, joints):
    with SafeHand(bus, joints, hand, SafetyCfg(then="hold")) as safe:
        safe.arm()
        safe.command(reset_pose(3) + 0.3)
    assert len(energised(twin)) == 9
    time.sleep(0.3)
    assert push(twin).max() < 0.02


def test_settings_that_switch_a_limit_off_are_refused(bus, hand, joints):
    with pytest.raises(ValueError, match=r"safety\.step_rad is 0"):
        SafetyCfg(step_rad=0.0)
    with pytest.raises(ValueError, match=r"safety\.margin_rad is 2"):
        SafeHand(bus, joints, hand, SafetyCfg(margin_rad=2.0))
