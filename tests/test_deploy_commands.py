"""The commands of vd-deploy on the twin: check, home, record; nothing moves unasked."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from motor_plant import Drive, NewtonPlant
from simulated_clock import SimulatedClock
from simulated_hand import simulated_bus

from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hands import load_hand
from vd.deploy import cli
from vd.deploy.camera.realsense import RealSenseCfg
from vd.deploy.hardware import check, home, record
from vd.deploy.hardware.connect import Connection
from vd.deploy.hardware.control_table import WATCHDOG_FIRMWARE, HardwareError
from vd.deploy.hardware.joints import JointMotors, read_joints
from vd.deploy.safety.limits import SafetyCfg
from vd.deploy.safety.safety import SafeHand
from vd.deploy.twin.twin import Twin
from vd.logs.recording import read_recording
from vd.sim.cfg import SimCfg

PORT = "/dev/simulated"
QUICK = SafetyCfg(step_rad=4.0, hold_s=0.05)
PRESENT = 120
"""Where in a motor's memory what it measures begins; what is before is written by others."""


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture
def line(hand, monkeypatch):
    """What commands connect to.

    Motors on a simulated line, where nothing is late on a busy machine.
    """
    joints = read_joints(hand)
    with simulated_bus(hand, joints) as (motors, bus):
        motors.plant.position[:] = hand.start + 0.1

        @contextlib.contextmanager
        def connect(options, **twin_options):
            yield Connection(joints, bus)

        for module in (check, home, record):
            monkeypatch.setattr(module, "connect", connect)
        yield motors


def test_check_finds_nothing_wrong_and_leaves_the_torque_off(line, capsys):
    assert check.check(check.CheckCfg(port=PORT, no_camera=True)) == 0
    said = capsys.readouterr().out
    assert "WRONG" not in said and re.search("ok +registers.*ok +torque.*ok +loop rate", said, re.S)
    assert not any(motor.get("torque_enable") for motor in line.motors)
    assert line.motors[0].get("position_p_gain") == 200


def test_check_misses_the_camera(line, capsys):
    assert check.check(check.CheckCfg(port=PORT, camera=RealSenseCfg(serial="none"))) == 1
    assert re.search(
        "WRONG  camera .*(no RealSense|SDK cannot be imported)", capsys.readouterr().out
    )


def same_id(line):
    """Two motors with one ID, at different angles as any two are."""
    line.motors[2].put("id", line.motors[1].id)
    line.plant.position[2] = 0.4


def stubborn(line):
    """A motor that does not keep a limit."""
    motor, item = line.motors[4], "max_position_limit"
    motor.put(item, 4000)
    accept = motor.accept
    motor.accept = lambda name, value: accept(name, 4000 if name == item else value)


def low(line):
    """A fourth of the supply's voltage is lost in the wires."""
    for motor in line.motors:
        motor.put("present_input_voltage", round(7.5 * motor.model.supply_v))


SPOILT = {
    "a wrong ID": (lambda line: line.motors[1].put("id", 90), "ID 90 answers, and is none of"),
    "one ID twice": (same_id, "motors answer: .*two motors have the ID 11"),
    "a limit not kept": (stubborn, "settings: motor 21: max_position_limit is 4000"),
    "reversed": (lambda line: line.motors[3].put("drive_mode", 1), "drive_mode: .*motor 20: 1"),
    "old firmware": (
        lambda line: line.motors[2].put("firmware_version", WATCHDOG_FIRMWARE - 1),
        "firmware_version: .*motor 12: 37",
    ),
    "overload": (
        lambda line: line.motors[5].put("hardware_error_status", HardwareError.OVERLOAD),
        "no hardware error: motor 22: overload",
    ),
    "hot": (lambda line: setattr(line.motors[0], "temperature", 66.0), "motor 10: 66 deg C"),
    "low supply": (low, r"voltage: motor 10: 18\.0 V, not 24"),
    "out of range": (
        lambda line: line.plant.position.__setitem__(5, 2.6),
        "pose within limits: f1_j3: 2.60 rad.*move it by hand",
    ),
    "turned round": (
        lambda line: line.plant.position.__setitem__(5, 2.0 * np.pi),
        "pose within limits: f1_j3: 6.28 rad.*turned round",
    ),
    "loose cable": (
        lambda line: line.faults.cut_off.add(32),
        "motors answer: motor 32 does not answer: check its cable",
    ),
}
"""What is wrong before the start, and what is said of it."""


@pytest.mark.parametrize("name", SPOILT)
def test_the_preflight_finds(name, line, monkeypatch):
    monkeypatch.setattr(check, "CYCLES", 1)
    spoil, said = SPOILT[name]
    spoil(line)
    line.clock.sleep(0.05)
    with record.connect(None) as connection, pytest.raises(RuntimeError, match=said):
        connection.bus.states.forget()
        check.ready(connection, "It moves.", yes=True)
    assert not any(motor.get("torque_enable") for motor in line.motors)


def test_nothing_moves_unasked(line, monkeypatch):
    before = line.plant.position.copy()
    with pytest.raises(RuntimeError, match="Nobody is there"):
        home.home(home.HomeCfg(port=PORT))
    line.motors[3].put("hardware_error_status", 32)
    with pytest.raises(RuntimeError, match="motor 20: overload"):
        home.home(home.HomeCfg(port=PORT, yes=True))
    np.testing.assert_array_equal(line.plant.position, before)


@pytest.mark.parametrize("torque", [True, False])
def test_nothing_is_written_before_the_person_agreed(line, torque, capsys):
    """A hand that holds an object goes on to, and the person is told before the question."""
    for motor in line.motors:  # as another program left them
        motor.put("position_p_gain", 900)
    if torque:
        line.plant.blocked[:2] = True
        for motor in line.motors[:2]:
            motor.put("torque_enable", 1)
            motor.put("goal_position", motor.get("present_position") + 100)
    settings = [bytes(motor.memory[:PRESENT]) for motor in line.motors]
    assert check.check(check.CheckCfg(port=PORT, no_camera=True)) == 0
    said = capsys.readouterr().out
    assert ("motors 10, 11 hold" in said) == torque and "10: 900; will be set to 200" in said
    with pytest.raises(RuntimeError, match="Nobody is there"):
        home.home(home.HomeCfg(port=PORT))
    assert ("motors 10, 11 hold" in capsys.readouterr().out) == torque
    assert [bytes(motor.memory[:PRESENT]) for motor in line.motors] == settings


@pytest.fixture
def on_the_way(line):
    """Have something done while the hand moves: the preflight takes two seconds."""
    clock, stops = line.clock, []

    def schedule(do):
        def once():
            stops.pop()()
            do()

        stops.append(clock.every(4.0, once))

    return schedule


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_hand_stopped_by_a_signal_ends_its_command_so(line, on_the_way, number, status, capsys):
    on_the_way(lambda: os.kill(os.getpid(), number))
    flags = ["--port", PORT, "--yes", "--speed", "0.02", "--safety.hold-s", "0.05"]
    assert cli.main(["home", *flags]) == status
    assert "stopped: " in capsys.readouterr().err
    assert not any(motor.get("torque_enable") for motor in line.motors)


def test_home_comes_to_the_start_pose(line, hand, capsys):
    assert home.home(home.HomeCfg(port=PORT, yes=True, speed=1.0, safety=QUICK)) == 0
    np.testing.assert_allclose(line.plant.position, hand.start, atol=0.01)
    assert "farthest from" in capsys.readouterr().out


def test_a_wiggle_takes_fingertips_away_from_what_they_lean_on(hand):
    def out_m(pose: np.ndarray, finger: int) -> float:
        return np.linalg.norm(hand.tip_poses(pose)[finger, :3] - hand.goal_in_base)

    leaning = np.tile([0.0, 0.28, -1.43], 3)  # of a twin without torque, on a cube
    highest = np.array(hand.upper)
    for axis in range(hand.num_joints):
        finger = hand.joint_finger[axis]
        turned = check.free_turn(hand, leaning, axis)
        assert out_m(turned, finger) >= out_m(leaning, finger)
        assert check.free_turn(hand, highest, axis)[axis] < highest[axis]


def test_each_joint_wiggles_in_turn_as_it_is_told_and_only_after_a_yes(
    line, hand, monkeypatch, capsys
):
    """What is told is what a person compares with what turns; one joint is blocked."""
    monkeypatch.setattr(check, "CYCLES", 1)
    monkeypatch.setattr(check, "WIGGLE_RAD_S", 1.0)
    asked = check.CheckCfg(port=PORT, wiggle=True, no_camera=True)
    with pytest.raises(RuntimeError, match=r"by 5 degrees.*Nobody is there"):
        check.check(asked)
    assert not any(motor.get("torque_enable") for motor in line.motors)
    advance, turns, home = line.plant.advance, [], line.plant.position.copy()

    def watched(*drives):
        advance(*drives)
        turns.append(line.plant.position - home)

    monkeypatch.setattr(line.plant, "advance", watched)
    line.plant.blocked[3] = True
    capsys.readouterr()
    assert check.check(replace(asked, yes=True)) == 1
    out, told = capsys.readouterr()
    turned = np.array(turns)
    free = np.delete(np.arange(9), 3)
    when = np.abs(turned[:, free]).argmax(axis=0)
    assert (np.diff(when) > 0).all()  # palm to tip, finger by finger
    np.testing.assert_allclose(np.degrees(np.abs(turned).max(axis=0))[free], 5.0, atol=0.6)
    assert (np.abs(turned) > np.radians(2.0)).sum(axis=1).max() == 1  # one at a time
    np.testing.assert_allclose(turned[-1], 0.0, atol=0.01)
    way = "inwards" if turned[when[1], 1] < 0.0 else "outwards"
    assert re.search(f"watch f0_j2, motor 11: the tip of finger 0 goes 1. mm {way}\n", told)
    assert re.search(r"WRONG  wiggle of f1_j1 .*turned by .0\.0 of .5 deg: blocked", out)
    assert out.count("ok     wiggle of") == 8


def test_nothing_wiggles_and_nobody_is_asked_while_something_is_wrong(line, monkeypatch, capsys):
    monkeypatch.setattr(check, "CYCLES", 1)
    low(line)
    line.clock.sleep(0.05)
    assert check.check(check.CheckCfg(port=PORT, wiggle=True, no_camera=True)) == 1
    assert "WRONG" in capsys.readouterr().out
    assert not any(motor.get("torque_enable") for motor in line.motors)


@pytest.fixture
def plan(tmp_path, hand):
    """A plan of two short motions, one with a torque release and a lower gain."""
    folder = tmp_path / "plan"
    (folder / "next_experiment").mkdir(parents=True)
    time = np.arange(0.0, 0.6, 0.01)
    entries = []
    for index, (joint, gain) in enumerate((("f0_j1", 200.0), ("f0_j2", 100.0))):
        rows = [f"t,command.{joint},enabled.{joint}"]
        rows += [f"{t:.6f},{0.3 * np.sin(12 * t):.6f},{int(gain > 150.0 or t < 0.3)}" for t in time]
        name = f"next_experiment/{index:03d}_{joint}_wave.csv"
        (folder / name).write_text("\n".join(rows) + "\n")
        conditions = {"p_gain": gain}
        entries.append(
            {"file": name, "excitation": "wave", "joints": [joint], "conditions": conditions}
        )
        path = folder / f"{joint}.json"
        path.write_text(json.dumps({"joints": [joint], "trajectories": [entries[-1]]}))
    return folder


def test_a_plan_is_recorded_and_gone_on_with(line, plan, hand, tmp_path, capsys, monkeypatch):
    out = tmp_path / "rec"
    first = record.RecordCfg(
        port=PORT,
        out=out,
        fingers=(0,),
        plan=plan / "f0_j1.json",
        yes=True,
        safety=QUICK,
        realtime=False,
    )
    assert record.record(first) == 0
    assert re.search(r"at (100|99) Hz\n", capsys.readouterr().err)
    before = (out / "plan_000_f0_j1_wave.csv").read_bytes()
    second = record.RecordCfg(
        port=PORT,
        out=out,
        fingers=(0,),
        plan=plan / "f0_j2.json",
        yes=True,
        safety=QUICK,
        realtime=False,
    )
    assert record.record(second) == 0 and record.record(second) == 0
    assert (out / "plan_000_f0_j1_wave.csv").read_bytes() == before
    found = read_recording(out)
    assert found.model == "dclaw3" and found.joints == ("f0_j1", "f0_j2", "f0_j3")
    wave, release = found.trajectories
    assert (wave.excitation, wave.joints, wave.conditions) == (
        "wave",
        ("f0_j1",),
        {"p_gain": 200.0},
    )
    np.testing.assert_allclose(wave.command[:, 0], 0.3 * np.sin(12 * wave.time), atol=0.15)
    assert np.ptp(wave.position[:, 0]) > 0.1 and np.ptp(wave.position[:, 2]) < 0.02
    assert wave.enabled.all() and not release.enabled[-1, 1] and release.enabled[0, 1]
    assert wave.temperature is not None and wave.pwm is None
    assert {motor.get("position_p_gain") for motor in line.motors} == {200}
    assert not any(motor.get("torque_enable") for motor in line.motors)
    monkeypatch.setattr(record, "connect", None)  # refused before a twin or a port is started
    with pytest.raises(record.RecordError, match="choose another"):
        record.record(replace(first, fingers=(1,)))


def test_nothing_but_the_fault_is_said_of_a_port_that_is_not_there():
    """Another process, since the tests' own keeps Warp quiet."""
    words = ["-m", "vd.deploy.cli", "record", "--port", "/dev/none", "--fingers", "0"]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert done.returncode == 1 and not done.stdout
    starting, fault = done.stderr.splitlines()
    assert "starting" in starting and "cannot open /dev/none: there is no such device" in fault


def test_a_misspelt_policy_is_told_those_that_are_there(capsys):
    assert cli.main(["dclaw44", "--twin"]) == 1
    said = capsys.readouterr().err
    assert "no command 'dclaw44'" in said and "calibrate" in said and "dclaw4-vision" in said


def test_a_recording_says_that_it_missed_its_rate(line, plan, tmp_path, capsys):
    """An adapter that keeps answers for 16 ms leaves about 50 of 100 samples a second."""
    motion = plan / "f0_j1.json"
    cfg = record.RecordCfg(
        port=PORT, out=tmp_path, fingers=(0,), plan=motion, yes=True, safety=QUICK, realtime=False
    )
    line.port.lag_s = 0.016
    assert record.record(cfg) == 0
    rate = re.search(
        r"at (\d+) Hz, not 100: .*latency timer.* --rate-hz \1", capsys.readouterr().err
    )
    assert rate and int(rate[1]) < 60


def test_motions_go_finger_by_finger_and_a_plan_of_another_hand_is_refused(hand, tmp_path):
    joints = read_joints(hand)
    motions = record.motions_of(joints, (), ("gain_ladder", "slow_triangle"))
    fingers = [motion.joints[0][:2] for motion in motions]
    assert fingers == sorted(fingers) and len({motion.file for motion in motions}) == len(motions)
    assert {motion.conditions["p_gain"] for motion in motions} == {200.0, 100.0, 50.0}
    with pytest.raises(ValueError, match="fingers 0 to 2"):
        record.motions_of(joints, (3,), ("chirp",))
    (tmp_path / "of_another.csv").write_text("t,command.f9_j1\n0.0,0.0\n")
    for file, fault in (("of_another.csv", "f9_j1"), ("gone.csv", "gone.csv")):
        plan = {"trajectories": [{"file": file}], "joints": ["f9_j1"]}
        (tmp_path / "next_experiment.json").write_text(json.dumps(plan))
        with pytest.raises(record.RecordError, match=f"plan for dclaw3: .*{fault}"):
            record.read_plan(tmp_path, joints)
    with pytest.raises(record.RecordError, match="plan for dclaw3"):
        record.read_plan(tmp_path / "nowhere.json", joints)


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4", "leap"])
def test_the_largest_motions_touch_nothing(name, request, tmp_path):
    if name == "leap":
        path = (
            request.getfixturevalue("shared_dir") / "hands" / "leap_hand" / "leap_hand_right.urdf"
        )
        if not path.is_file():
            pytest.skip(f"there is no {path}")
        hand = import_hand(path, tmp_path, "leap").hand
    else:
        hand = load_hand(name)
    joints = read_joints(hand)
    plant = NewtonPlant(joints, SimCfg(physics_hz=240.0))
    for motion in record.motions_of(joints, (0,), ("steps_and_sines",)):
        if motion.excitation != "step_large":
            continue
        commands = [*[motion.command[0]] * 200, *motion.command]
        for index, command in enumerate(commands):
            goals = zip(joints.to_motor(command), joints.motors, strict=True)
            plant.advance(
                0.01, [Drive(float(angle), motor.p_gain, 8.0, 2.6) for angle, motor in goals]
            )
            found = plant.sim.solver.mjw_data
            touching = np.count_nonzero(found.contact.dist.numpy()[: found.nacon.numpy()[0]] < 0.0)
            assert index < 200 or touching == 0, f"{motion.file}: {touching} contacts"


def test_a_payload_needs_somebody_to_hang_it(line, hand, tmp_path):
    cfg = record.RecordCfg(
        port=PORT, out=tmp_path, fingers=(0,), excitations=("second_payload",), yes=True
    )
    every = record.motions_of(read_joints(hand), (0,), cfg.excitations)
    motions = [motion for motion in every if record.payload_of(motion)[0]]
    with (
        record.connect(cfg) as connection,
        pytest.raises(record.RecordError, match=r"hang 0\.05 kg"),
    ):
        record._session(cfg, connection, ("f0_j1",), motions, record.payload_of(motions[0]), print)


@pytest.fixture
def turned(hand):
    """Motors that turn the other way and are mounted elsewhere."""
    motors = [replace(motor, sign=-1.0, offset_rad=0.2) for motor in hand.motors]
    return JointMotors(hand, tuple(motors))


@pytest.fixture
def twin(turned):
    """A twin of them on a simulated clock."""
    return Twin(turned, clock=SimulatedClock())


def test_a_twin_does_what_motors_do(twin, turned, hand):
    """Soft at first, to the goal, held at less than its stiffness, and let go at the end."""
    goal = hand.start + np.tile([0.1, 0.2, 0.2], 3)
    with SafeHand(twin, turned, QUICK, lambda text: None) as safe:
        begin = safe.arm().position
        np.testing.assert_allclose(begin, hand.start, atol=0.003)
        safe.move(goal, 1.0)
        here = safe.read()
        np.testing.assert_allclose(here.position, goal, atol=0.05)
        # Gravity bends the joints by torque over stiffness, and the current says so.
        model = turned.models[0]
        torque = here.current * model.torque_nm_per_a
        np.testing.assert_allclose(torque / hand.kp, goal - here.position, atol=0.01)
        twin.stiffen(0.3, twin.ids[:3])
        for _ in range(20):
            safe.command(goal)
            safe.beat()
            twin.clock.sleep(0.05)
            softer = safe.read().position
        assert np.abs(softer - goal)[1] > 2.0 * np.abs(here.position - goal)[1]
        np.testing.assert_allclose((softer - goal)[4:6], (here.position - goal)[4:6], atol=0.01)
        assert twin.read_torque().all()
    assert not twin.read_torque().any() and safe.report.unreleased == {}
    for _ in range(20):
        twin.clock.sleep(0.05)
        fallen = turned.state(twin.read_state()).position
    assert np.abs(fallen - goal).max() > 0.3


def test_a_twin_that_is_told_to_freeze_stays_where_it_is(twin, turned, hand):
    with SafeHand(twin, turned, QUICK, lambda text: None) as safe:
        safe.arm()
        safe.command(hand.start + 0.3)
        twin.clock.sleep(0.03)
        twin.freeze()
        here = twin.read_state().position
        twin.clock.sleep(0.2)
        np.testing.assert_allclose(twin.read_state().position, here, atol=0.1)


def test_a_goal_sent_with_the_question_for_a_state_acts_from_its_answer_on(twin, turned, hand):
    """As of motors; else a recording has it late by as long as the twin simulates."""
    twin.torque(True)
    start = turned.state(twin.read_state()).position
    twin.write_goals(turned.to_motor(hand.start + 0.3), with_state=True)
    twin.clock.sleep(0.1)
    asked = turned.state(twin.read_state()).position
    np.testing.assert_allclose(asked, start, atol=0.05)
    twin.clock.sleep(0.1)
    assert (turned.state(twin.read_state()).position > asked + 0.1).all()


def test_check_of_a_twin_looks_at_its_camera(capsys):
    assert cli.main(["check", "--twin", "--wiggle", "--yes"]) == 0
    said = capsys.readouterr().out
    assert "camera depth" in said and said.count("ok     wiggle of") == 9


def test_a_twin_that_cannot_be_says_why(capsys):
    assert cli.main(["check", "--twin", "--hand", "nobody"]) == 1
    assert "no hand" in capsys.readouterr().err
