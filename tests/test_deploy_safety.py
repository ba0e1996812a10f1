"""Limits and stops between a policy and the motors, on a simulated clock.

Times are exact, on any machine.
"""

import os
import re
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from simulated_hand import energised, push, simulated_bus

from vd.assets_usd.hands import load_hand
from vd.deploy.hardware.answers import BusError
from vd.deploy.hardware.joints import JointMotors
from vd.deploy.safety.limits import PERIOD_S, SafetyCfg
from vd.deploy.safety.safety import WATCH_S, SafeHand, StoppedError
from vd.deploy.timely import undisturbed

EXCHANGE_S = 0.008
"""Asking nine motors for their state, torque and watchdog: 5.8 ms on the line, and what the program
waits for."""
STEP_S = PERIOD_S + EXCHANGE_S
"""A step of the loop below."""
HOLD_S = 0.05
"""What a hold may take: two units of the motors' own watchdog, and an exchange. A control period is
83 ms.
"""
QUICK = SafetyCfg(hold_s=0.05)
START = load_hand("dclaw3").start


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture
def joints(hand) -> JointMotors:
    """Some motors turn the other way and are mounted elsewhere."""
    rng = np.random.default_rng(1)
    signs, angles = rng.choice([-1.0, 1.0], 9), rng.uniform(-0.3, 0.3, 9)
    turned = zip(hand.motors, signs, angles, strict=True)
    return JointMotors(hand, tuple(replace(motor, sign=s, offset_rad=o) for motor, s, o in turned))


@pytest.fixture
def both(hand, joints):
    with simulated_bus(hand, joints) as (line, bus):
        line.plant.position[:] = joints.to_motor(START)
        bus.clock.sleep(0.01)
        yield line, bus


@pytest.fixture
def line(both):
    return both[0]


@pytest.fixture
def bus(both):
    return both[1]


def test_it_moves_in_the_joints_frame_and_ends_with_torque_off(bus, line, hand, joints):
    said = []
    goal = START + 0.2
    with SafeHand(bus, joints, QUICK, said.append) as safe:
        assert energised(line) == []
        start = safe.arm()
        np.testing.assert_allclose(start.position, START, atol=0.001)
        assert len(energised(line)) == 9 and push(line).max() < 0.002
        safe.move(goal, 1.0)
        np.testing.assert_allclose(safe.read().position, goal, atol=0.005)
    assert energised(line) == [] and said == ["torque off"]
    assert {motor.get("bus_watchdog") for motor in line.motors} == {0}


def test_goals_keep_the_limits(bus, hand, joints):
    with SafeHand(bus, joints, replace(QUICK, step_rad=0.3, margin_rad=0.1)) as safe:
        here = safe.arm().position
        far = np.where(np.arange(9) % 2, 9.0, -9.0)
        sent = safe.command(far)
        np.testing.assert_allclose(np.abs(sent - here)[1:3], 0.3, atol=1e-9)
        assert sent[0] == pytest.approx(-0.3, abs=0.002)  # by the step; the limit is at -0.35
        for _ in range(100):
            safe.read()
            sent = safe.command(far)
            safe.beat()
            bus.clock.sleep(0.01)
        np.testing.assert_allclose(sent[::2], hand.lower[::2] + 0.1)
        with pytest.raises(StoppedError, match="9 finite angles"):
            safe.command(np.full(9, np.nan))
        with pytest.raises(StoppedError, match="9 finite angles"):
            safe.command(here)  # a stop stays


def fastest(bus, line) -> list[float]:
    """Keeps the largest speed of any joint from now on [rad/s]."""
    seen = [0.0]
    bus.clock.every(0.005, lambda: seen.append(float(np.abs(line.plant.read()[1]).max())))
    return seen


@pytest.mark.parametrize(("axis", "moved"), [(1, 1.6), (0, -0.8), (5, 2 * np.pi)])
@pytest.mark.parametrize("current", [0.0, 0.3])
def test_a_joint_that_was_moved_since_the_preflight_is_not_snapped_back(hand, axis, moved, current):
    """By hand, while the question waits: beyond its range, or by a whole turn as LEAP's motors count."""
    joints = JointMotors(hand, tuple(replace(motor, current=current) for motor in hand.motors))
    with simulated_bus(hand, joints) as (line, bus):
        line.plant.position[:] = START
        line.plant.position[axis] += moved
        bus.clock.sleep(0.01)
        before, speeds = line.plant.position.copy(), fastest(bus, line)
        with SafeHand(bus, joints, QUICK) as safe:
            with pytest.raises(StoppedError, match=f"nothing moves: {joints.names[axis]}"):
                safe.arm()
        bus.clock.sleep(0.5)
        assert energised(line) == [] and max(speeds) == 0.0
        np.testing.assert_array_equal(line.plant.position, before)


@pytest.mark.parametrize("current", [0.0, 0.3])
def test_a_joint_that_hangs_a_little_out_of_its_range_is_brought_back_slowly(hand, current):
    joints = JointMotors(hand, tuple(replace(motor, current=current) for motor in hand.motors))
    with simulated_bus(hand, joints) as (line, bus):
        line.plant.position[:] = START
        line.plant.position[0] = hand.upper[0] + 0.09
        bus.clock.sleep(0.01)
        speeds = fastest(bus, line)
        with SafeHand(bus, joints, QUICK) as safe:
            safe.arm()
            assert line.plant.position[0] < hand.upper[0] + 0.02
            assert {motor.get("position_p_gain") for motor in line.motors} == {200}
        assert 0.1 < max(speeds) < 0.5  # of the way to the start


def test_a_joint_that_is_pushed_far_out_of_its_range_is_not_sent_back_at_once(hand):
    """Motors that limit their current have no limits of position, and take goals out of the range."""
    joints = JointMotors(hand, tuple(replace(motor, current=0.3) for motor in hand.motors))
    with simulated_bus(hand, joints) as (line, bus):
        line.plant.position[:] = START
        bus.clock.sleep(0.01)
        with SafeHand(bus, joints, QUICK) as safe:
            safe.arm()
            line.plant.blocked[0] = True
            while line.plant.position[0] < hand.upper[0] + 1.0:
                line.plant.position[0] += 0.05
                bus.clock.sleep(0.02)
                safe.read()
                safe.command(START)
                safe.beat()
                assert push(line)[0] < QUICK.step_rad + 0.06


def test_the_step_limit_comes_last(joints):
    """After the clip to the range."""
    limits = SafeHand(None, joints, replace(QUICK, step_rad=0.3)).limits
    here = joints.hand.upper + 1.0
    np.testing.assert_allclose(limits.goal(START, here), here - 0.3)
    np.testing.assert_allclose(limits.goal(here, joints.hand.upper), joints.hand.upper)


def run_until_stopped(safe: SafeHand, target: np.ndarray, seconds: float = 5.0) -> str:
    """A loop at 12 Hz that drives to ``target`` until something stops it; the reason."""
    clock = safe.bus.clock
    end = clock.now() + seconds
    try:
        while clock.now() < end:
            safe.read()
            safe.command(target)
            safe.beat()
            clock.sleep(PERIOD_S)
    except StoppedError as error:
        return str(error)
    return "nothing stopped it"


@pytest.mark.parametrize(
    ("fault", "reason", "found_s"),
    [
        # The last sound state is older than 0.25 s: three steps, and asking twice at 34 ms each.
        (lambda line: line.faults.cut_off.add(11), "lost the bus: motor 11", 0.25 + STEP_S),
        # 40 degrees to go at 400 a second, and a step.
        (lambda line: setattr(line.motors[4], "heat_c_per_s", 400.0), "motor 21", 0.102 + STEP_S),
        (
            lambda line: line.motors[8].reboot(),
            "f2_j3, motor 32: another program on the line",
            STEP_S,
        ),
        (
            lambda line: line.motors[3].put("torque_enable", 0),
            "torque went off: f1_j1, motor 20",
            STEP_S,
        ),
        (
            lambda line: line.motors[3].put("bus_watchdog", -1),
            "f1_j1, motor 20: its bus watchdog stopped it, and it refuses goals",
            STEP_S,
        ),
        # A fifth of 24 V is lost in the wires, for half a second, found with the next state.
        (
            lambda line: line.motors[5].put("present_input_voltage", 190),
            "f1_j3, motor 22: 19.0 V for 0.5 s, not 24: check the supply",
            0.5 + 2 * STEP_S,
        ),
        # No cable: nobody listens for 50 ms. The last sound state is older than 0.25 s, as above.
        (
            lambda line: setattr(line.put.__self__, "starved_s", 0.05),
            "heard no motor: the st",
            0.25 + 2 * STEP_S,
        ),
        (lambda line: os.kill(os.getpid(), signal.SIGINT), "Ctrl-C", 2 * WATCH_S),
        (lambda line: os.kill(os.getpid(), signal.SIGHUP), "the terminal is gone", 2 * WATCH_S),
    ],
    ids=[
        "cable",
        "heat",
        "restart",
        "torque",
        "watchdog",
        "voltage",
        "starved",
        "ctrl-c",
        "hangup",
    ],
)
def test_faults_stop_the_hand_in_time_and_are_named(
    bus, line, hand, joints, fault, reason, found_s
):
    target = START + 0.3
    with SafeHand(bus, joints, QUICK) as safe:
        safe.arm()
        assert run_until_stopped(safe, target, 0.3) == "nothing stopped it"
        injected = bus.clock.now()
        fault(line)
        assert reason in run_until_stopped(safe, target)
        assert 0.0 <= safe.report.detected_s - injected < found_s
        assert 0.0 < safe.report.held_s - safe.report.detected_s < HOLD_S
        # One motor cannot hear; its own watchdog has it hold a little later.
        assert np.sort(push(line))[:8].max() < 0.02
    bus.clock.sleep(0.4)
    cut = sorted(line.faults.cut_off)
    assert energised(line) == cut and sorted(safe.report.unreleased) == cut
    assert push(line).max() < 0.02


def test_on_a_lost_bus_what_presses_on_an_obstacle_is_let_go(bus, line, hand, joints):
    """No state tells of the obstacle; the motors themselves know where they are."""
    with SafeHand(bus, joints, QUICK) as safe:
        safe.arm()
        safe.read()
        safe.command(START + 0.3)
        line.plant.blocked[:] = True
        line.faults.lose = 1.0
        assert "lost the bus" in run_until_stopped(safe, START + 0.3)
        assert safe.report.held_s - safe.report.detected_s < HOLD_S
        assert push(line).max() < 0.002


def test_where_the_adapter_is_gone_every_motor_is_named(bus, line, joints):
    def gone(_):
        raise OSError("no adapter")

    with SafeHand(bus, joints, QUICK) as safe:
        safe.arm()
        line.port.writePort = gone
        assert "no adapter" in run_until_stopped(safe, START)
    assert sorted(safe.report.unreleased) == sorted(bus.ids)


def test_a_blocked_joint_is_let_go(bus, line, hand, joints):
    with SafeHand(bus, joints, replace(QUICK, step_rad=4.0, current_s=0.3)) as safe:
        here = safe.arm().position
        line.plant.blocked[2] = True
        target = here + np.eye(9)[2] * 1.5
        begin = bus.clock.now()
        assert "f0_j3, motor 12" in run_until_stopped(safe, target)
        assert 0.3 < safe.report.detected_s - begin < 0.3 + 3 * PERIOD_S
        bus.clock.sleep(0.01)
        assert push(line)[2] < 0.002  # it does not press on
    assert energised(line) == []


@pytest.mark.parametrize(("p_gain", "push_rad"), [(200, 0.35), (200, 0.29), (50, 0.29)])
def test_a_joint_that_is_blocked_is_let_go_whatever_its_current(
    bus, line, hand, joints, p_gain, push_rad
):
    """At most 0.34 A, 0.56 A being the current of the largest torque, or a fourth of that."""
    with SafeHand(bus, joints, QUICK) as safe:
        here = safe.arm().position
        line.motors[2].put("position_p_gain", p_gain)
        line.plant.blocked[2] = True
        begin = bus.clock.now()
        said = run_until_stopped(safe, here + push_rad * np.eye(9)[2], 20.0)
        assert re.match(rf"f0_j3, motor 12: it stands {push_rad:.2f} rad from its goal for", said)
        assert 0.0 < safe.report.detected_s - begin - QUICK.blocked_s < 3 * STEP_S
        bus.clock.sleep(0.01)
        assert push(line)[2] < 0.002
    assert energised(line) == []


def test_joints_that_press_for_a_while_or_hold_still_go_on(bus, line, hand, joints):
    """A grip is released before its time, comes again, and ends; less than half is no matter."""
    with SafeHand(bus, joints, replace(QUICK, blocked_s=3.0)) as safe:
        here = safe.arm().position
        line.plant.blocked[:] = True
        for _ in range(2):
            assert run_until_stopped(safe, here + 0.3, 2.8) == "nothing stopped it"
            assert run_until_stopped(safe, here + 0.1, 4.0) == "nothing stopped it"


def test_deadlines_and_images_stop_the_hand(bus, hand, joints):
    with SafeHand(bus, joints, QUICK) as safe:
        safe.arm()
        for missed in (True, True, False, True, True):
            safe.beat(missed=missed)
        with pytest.raises(StoppedError, match="3 deadlines missed"):
            safe.beat(missed=True)
    with SafeHand(bus, joints, QUICK) as safe:
        safe.arm()
        shown = bus.clock.now()
        safe.image_at(shown)
        assert "image is" in run_until_stopped(safe, START)
        assert 0.0 < safe.report.detected_s - shown - QUICK.stale_s < 2 * WATCH_S
    with SafeHand(bus, joints, QUICK) as safe:
        safe.arm()
        with pytest.raises(StoppedError, match=r"3\.00 s from the future: .*plug"):
            safe.image_at(bus.clock.now() + 3.0)


def test_a_loop_that_stands_is_stopped_by_the_watchdog(bus, hand, joints):
    with SafeHand(bus, joints, QUICK) as safe:
        safe.arm()
        safe.read()
        safe.command(START + 0.3)
        begin = bus.clock.now()
        safe.beat()
        bus.clock.sleep(1.0)
        assert 0.0 < safe.report.detected_s - begin - 3 * PERIOD_S < 2 * WATCH_S
        assert safe.report.held_s - safe.report.detected_s < EXCHANGE_S
        with pytest.raises(StoppedError, match="the loop stands"):
            safe.read()


def test_a_loop_that_stands_is_switched_off_and_it_is_said_before_it_comes_back(bus, line, joints):
    said, ended = [], []
    with SafeHand(bus, joints, QUICK, said.append, ended.append) as safe:
        safe.arm()
        safe.beat()
        bus.clock.sleep(0.3)
        assert len(energised(line)) == 9 and "the loop stands" in said[0]
        bus.clock.sleep(0.3)
        assert energised(line) == [] and "torque off" in said[1] and len(ended) == 1
        with pytest.raises(StoppedError, match="the loop stands"):
            safe.switch(np.ones(9, dtype=bool))
    assert energised(line) == [] and len(said) == 2


def test_words_that_cannot_be_said_keep_no_torque_on(bus, line, joints, monkeypatch):
    """The terminal is gone, and the hold cannot be sent: the hand is let go all the same."""

    def gone(*_):
        raise OSError("Input/output error")

    def full(*_, **__):
        raise BusError("the port did not take what was to be sent")

    with SafeHand(bus, joints, QUICK, gone) as safe:
        safe.arm()
        monkeypatch.setattr(bus, "write_goals", full)
        monkeypatch.setattr(bus, "freeze", full)
        os.kill(os.getpid(), signal.SIGHUP)
        bus.clock.sleep(0.1)
    assert energised(line) == []
    assert safe.report.reason == "the terminal is gone" and safe.report.unreleased == {}


def test_motors_stop_by_themselves_if_the_driver_dies(bus, line, hand, joints):
    safe = SafeHand(bus, joints, SafetyCfg())  # no block: nothing of ours stops it
    safe.arm()
    safe.command(START + 0.3)
    bus.clock.sleep(0.29)
    assert {motor.get("bus_watchdog") for motor in line.motors} == {15}
    bus.clock.sleep(0.03)
    assert {motor.get("bus_watchdog") for motor in line.motors} == {-1}
    assert push(line).max() < 0.002
    with SafeHand(bus, joints, QUICK) as again:  # and can be used again
        again.arm()
        here = again.read().position
        again.command(here + 0.2)
        bus.clock.sleep(0.2)
        assert (again.read().position - here).min() > 0.15


def test_an_exception_stops_the_hand(bus, line, hand, joints):
    said = []
    with pytest.raises(ZeroDivisionError):
        with SafeHand(bus, joints, QUICK, said.append) as safe:
            safe.arm()
            safe.command(START + 0.3)
            _ = 1 / 0
    assert safe.report.held_s - safe.report.detected_s < EXCHANGE_S
    assert energised(line) == [] and said == [
        "stopped: ZeroDivisionError: division by zero; torque off"
    ]


def test_the_hand_can_be_left_holding(bus, line, hand, joints):
    with SafeHand(bus, joints, SafetyCfg(then="hold")) as safe:
        safe.arm()
        safe.command(START + 0.3)
    assert len(energised(line)) == 9
    bus.clock.sleep(0.3)
    assert push(line).max() < 0.002


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="needs Linux")
def test_all_threads_run_before_other_programs_and_not_after():
    """For the loop is watched by others than its own."""
    end = threading.Event()
    thread = threading.Thread(target=end.wait, daemon=True)
    thread.start()
    with undisturbed(True) as permitted:
        if not permitted:
            pytest.skip("this system permits no real-time priority")
        assert [os.sched_getscheduler(one) for one in (0, thread.native_id)] == [os.SCHED_RR] * 2
    assert [os.sched_getscheduler(one) for one in (0, thread.native_id)] == [os.SCHED_OTHER] * 2
    end.set()


def test_settings_that_switch_a_limit_off_are_refused(bus, hand, joints):
    with pytest.raises(ValueError, match=r"step_rad is 0"):
        SafetyCfg(step_rad=0.0)
    with pytest.raises(ValueError, match=r"margin_rad is 2"):
        SafeHand(bus, joints, SafetyCfg(margin_rad=2.0))
