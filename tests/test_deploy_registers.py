"""What the preflight reads of the motors: a wrong register spoils a run, is named, and is set or refused."""

import dataclasses
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tyro

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from simulated_hand import simulated_bus

from vd.assets_usd.hands import load_hand
from vd.deploy import cli
from vd.deploy.finding import Finding
from vd.deploy.hardware import adapter, check, maintain
from vd.deploy.hardware.answers import BusError, GarbledError
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.check_registers import register_findings
from vd.deploy.hardware.connect import MOTOR, Connection
from vd.deploy.hardware.control_table import BAUD_RATES, CENTRE, MODELS, RAD_PER_COUNT, table
from vd.deploy.hardware.joints import uncalibrated
from vd.deploy.hardware.motion import reset_pose
from vd.deploy.hardware.registers import REGISTERS
from vd.deploy.twin.motor import Motor

FACTORY = {name: item.initial for name, item in table(MODELS[MOTOR]).items()}
PERIOD_S, STEP_RAD = 0.02, 0.3
PORT = "/dev/simulated"


class Rig:
    """A hand's motors on a simulated line, with nothing between a test and them."""

    def __init__(self, hand, joints, line, bus):
        self.connection, self.line, self.bus = Connection(hand, joints, bus), line, bus
        self.motor = line.motors[0]

    def step(self, axis: int = 0, seconds: float = 0.5) -> np.ndarray:
        """Positions of all axes after the goal of one has jumped [T, D], less where they were."""
        self.bus.torque(True)
        start = self.line.plant.position.copy()
        goal = start.copy()
        goal[axis] += STEP_RAD
        rows = []
        for _ in range(round(seconds / PERIOD_S)):
            self.bus.write_goals(goal)
            self.bus.clock.sleep(PERIOD_S)
            rows.append(self.line.plant.position - start)
        self.bus.torque(False)
        return np.array(rows)

    def findings(self) -> dict[str, Finding]:
        """What the preflight finds, by name."""
        return {one.what: one for one in check.preflight(self.connection)}

    def reopen(self) -> None:
        """Begin anew on the port, after a command that closed it."""
        self.bus._port.is_open, self.bus._port.baudrate = True, 1_000_000
        self.line.faults.cut_off = set()
        self.bus._states.forget()

    def wrong(self) -> list[str]:
        """What the preflight finds wrong."""
        return [one.found for one in self.findings().values() if not one.ok]


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture
def rig(hand, monkeypatch):
    monkeypatch.setattr(check, "CYCLES", 1)
    joints = uncalibrated(hand)
    with simulated_bus(hand, joints) as (line, bus):
        line.plant.position[:] = reset_pose(3) + 0.1
        for motor in line.motors:
            motor.put("baud_rate", BAUD_RATES.index(1_000_000))
        bus.clock.sleep(PERIOD_S)
        yield Rig(hand, joints, line, bus)


def slow(rig: Rig) -> bool:
    return rig.step(seconds=0.25)[-1, 0] < 0.6 * STEP_RAD


def overshoots(rig: Rig) -> bool:
    return rig.step()[:, 0].max() > 1.1 * STEP_RAD


def obeys_another(rig: Rig) -> bool:
    return rig.step(axis=1)[-1, 0] > 0.5 * STEP_RAD


def burns(rig: Rig) -> bool:
    """Whether it goes on at 90 deg C."""
    rig.bus.torque(True)
    rig.motor.temperature = 90.0
    rig.bus.clock.sleep(PERIOD_S)
    return bool(rig.motor.get("torque_enable"))


DAMAGE: list[tuple[dict[str, int], Callable[[Rig], bool]]] = [
    ({"profile_velocity": 5}, slow),
    ({"profile_acceleration": 1, "profile_velocity": 100}, slow),
    ({"goal_pwm": 20}, slow),
    ({"pwm_limit": 50}, slow),
    ({"position_i_gain": 2000}, overshoots),
    ({"feedforward_1st_gain": 500, "profile_velocity": 60}, overshoots),
    ({"secondary_id": 11}, obeys_another),
    ({"shutdown": 0}, burns),
    ({"temperature_limit": 100}, burns),
]


@pytest.mark.parametrize(("values", "harmed"), DAMAGE, ids=[next(iter(values)) for values, _ in DAMAGE])
def test_a_wrong_register_spoils_a_run_and_is_named_and_set(rig, values, harmed):
    rig.bus.configure(rig.connection.joints.settings(rig.connection.hand, MOTOR))
    for name, value in values.items():
        rig.motor.put(name, value)
    assert harmed(rig)
    rig.motor.reboot()  # errors are gone; what is wrong in RAM is not, or it would be right by itself
    rig.motor.temperature = 30.0
    rig.line.plant.position[:] = reset_pose(3) + 0.1
    for name, value in values.items():
        rig.motor.put(name, value)
    found = rig.findings()
    for name, value in values.items():
        assert f"motor 10: {value}; it will be set to {FACTORY[name]}" in found[name].found
        assert ("without power" in found[name].found) == (table(MODELS[MOTOR])[name].address < 64)
    rig.bus.configure(rig.connection.joints.settings(rig.connection.hand, MOTOR))
    assert {name: rig.motor.get(name) for name in values} == {name: FACTORY[name] for name in values}
    assert not harmed(rig)


def driven(seconds: float, **values: int) -> np.ndarray:
    """Where a blocked motor at zero drives to, every millisecond [rad], with a goal 100 counts away."""
    motor = Motor(MODELS[MOTOR], 1)
    for name, value in {"torque_enable": 1, "goal_position": CENTRE + 100, **values}.items():
        motor.put(name, value)
    return np.array([motor.drive(1e-3).goal_rad for _ in range(round(1e3 * seconds))])


def test_profiles_and_gains_have_the_units_of_the_manual():
    goal = 100 * RAD_PER_COUNT
    speed, acceleration = 5 * 0.229 * 2 * np.pi / 60, 4 * 214.577 * 2 * np.pi / 3600
    np.testing.assert_array_equal(driven(0.01, profile_acceleration=4), goal)  # no speed, no profile
    path = driven(2.0, profile_velocity=5)
    np.testing.assert_allclose(path, np.minimum(goal, speed * np.arange(0.001, 2.0005, 0.001)), atol=1e-9)
    path = driven(1.0, profile_velocity=1000, profile_acceleration=4)
    assert path[199] == pytest.approx(0.5 * acceleration * 0.2**2, rel=0.01)
    assert path.max() <= goal == path[-1]
    assert np.flatnonzero(path > 0.99 * goal)[0] * 1e-3 == pytest.approx(
        (2.0 - np.sqrt(0.02)) * np.sqrt(goal / acceleration), rel=0.01
    )
    # At a P gain of 128 / 128, counts of PWM are counts of error.
    path = driven(0.1, position_p_gain=128, position_i_gain=655)
    assert path[-1] - goal == pytest.approx(655 / 65536 * 100 * goal, rel=1e-6)
    pushed, plain = (
        driven(0.2, position_p_gain=128, profile_velocity=5, profile_acceleration=32767, **gains)
        for gains in ({"feedforward_1st_gain": 8}, {})
    )
    assert (pushed - plain)[100] == pytest.approx(8 / 4 * 5 * RAD_PER_COUNT, rel=1e-6)
    pushed, plain = (
        driven(0.1, position_p_gain=128, profile_velocity=1000, profile_acceleration=4, **gains)
        for gains in ({"feedforward_2nd_gain": 16}, {})
    )
    assert (pushed - plain)[50] == pytest.approx(16 / 4 * 4 * RAD_PER_COUNT, rel=1e-6)
    strong = driven(1.0, position_p_gain=128, position_i_gain=16383)
    assert strong[-1] - goal == pytest.approx(885 * RAD_PER_COUNT)  # the whole PWM, and no more


def test_every_register_of_the_table_is_compared(rig):
    hand, joints = rig.connection.hand, rig.connection.joints
    rig.bus.configure(joints.settings(hand, MOTOR))
    tables = {id: rig.bus.read_table(id) for id in rig.bus.ids}
    assert [one.what for one in register_findings(rig.connection, tables)] == ["registers"]
    for register in REGISTERS:
        right = tables[12][register.name]
        other = 0 if register.bits else right + 1
        spoilt = {**tables, 12: {**tables[12], register.name: other}}
        (only,) = register_findings(rig.connection, spoilt)
        assert only.what == register.name and f"motor 12: {other};" in only.found
        assert only.ok != bool(register.remedy)
    more = {**tables, 12: {**tables[12], "shutdown": FACTORY["shutdown"] | 1}}
    assert [one.what for one in register_findings(rig.connection, more)] == ["registers"]


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [("drive_mode", 1, "Wizard"), ("homing_offset", 100, "Wizard"), ("status_return_level", 1, "reboot 10")],
)
def test_what_is_not_ours_to_set_is_refused(rig, name, value, remedy):
    rig.motor.put(name, value)
    found = rig.findings()[name]
    assert not found.ok and f"motor 10: {value};" in found.found and remedy in found.found
    assert rig.motor.get(name) == value


def test_another_operating_mode_is_set_before_the_gains_that_it_resets(rig):
    accept = rig.motor._accept
    order = []
    rig.motor._accept = lambda name, value: (order.append(name), accept(name, value))
    rig.motor.put("operating_mode", 4)
    rig.bus.configure(rig.connection.joints.settings(rig.connection.hand, MOTOR))
    assert order.index("operating_mode") < order.index("position_p_gain")
    assert (rig.motor.get("operating_mode"), rig.motor.get("position_p_gain")) == (3, 200)


def test_a_secondary_id_answers_nothing_and_keeps_nothing(rig):
    rig.line.motors[1].put("secondary_id", 99)
    rig.bus.retries = 0
    assert rig.bus.ping(99) is None
    for name in ("led", "temperature_limit"):
        with pytest.raises(BusError, match="motor 99"):
            rig.bus.write(99, name, 1)
    assert (rig.line.motors[1].get("led"), rig.line.motors[1].get("temperature_limit")) == (1, 80)


# Remedies


@pytest.fixture
def port(rig, monkeypatch):
    """What the commands for single motors open: a line on which a motor hears its own baud rate alone."""

    def open_bus(cfg, baud_rate):
        rig.bus._port.is_open, rig.bus._port.baudrate = True, baud_rate
        rates = {motor.id: BAUD_RATES[motor.get("baud_rate")] for motor in rig.line.motors}
        rig.line.faults.cut_off = {id for id, rate in rates.items() if rate != baud_rate}
        return MotorBus(rig.bus._port, [cfg.id], MOTOR, clock=rig.bus.clock)

    monkeypatch.setattr(maintain, "open_bus", open_bus)
    yield PORT
    rig.bus._port.is_open, rig.bus._port.baudrate = True, 1_000_000


def commands(text: str) -> list[list[str]]:
    """The commands in backticks of a text, each as words."""
    return [shlex.split(found)[1:] for found in re.findall(r"`(vd-deploy [^`]*)`", text)]


def parse(words: list[str]) -> object:
    """The options of a command, as vd-deploy takes them."""
    entry = cli.COMMANDS[words[0]]
    module = __import__(entry.module, fromlist=["x"])
    return tyro.cli(getattr(module, entry.options), args=[word.replace("NEW", "40") for word in words[1:]])


def run(words: list[str], **changes: object) -> int:
    """Do what a command says, with a yes."""
    options = dataclasses.replace(parse(words), yes=True, **changes)
    return getattr(maintain, cli.COMMANDS[words[0]].function)(options)


def test_a_joint_that_was_turned_round_is_mended_by_the_command_that_is_named(rig, port, capsys):
    rig.line.plant.position[3] += 2 * np.pi
    rig.bus.clock.sleep(PERIOD_S)
    (wrong,) = rig.wrong()
    assert "f1_j1: 6." in wrong and "turned round" in wrong
    (mend,) = commands(wrong)
    assert mend[:2] == ["reboot", "20"] and run(mend) == 0
    assert "motor 20 has restarted" in capsys.readouterr().out
    rig.reopen()
    assert rig.wrong() == []


def test_a_motor_that_answers_pings_alone_is_named_with_its_remedy(rig, port):
    rig.line.motors[2].put("status_return_level", 0)
    (wrong,) = rig.wrong()
    assert "motor 12 answers pings, but no reads: its status_return_level is 0" in wrong
    (mend,) = commands(wrong)
    assert mend[:2] == ["reboot", "12"] and run(mend) == 0
    rig.reopen()
    assert rig.wrong() == []


def test_two_motors_with_one_id_are_thought_of(rig, port):
    """They answer a ping alike, and so soundly; what differs is garbled."""
    rig.line.motors[1].put("id", 10)
    assert rig.bus.ping(10) == MODELS[MOTOR].number
    (wrong,) = rig.wrong()
    assert "motor 11 does not answer" in wrong and "two motors have the ID 10" in wrong
    assert parse(commands(wrong)[-1]).id == 10
    for words in (["set-id", "10", "40"], ["reboot", "10"]):
        with pytest.raises(GarbledError, match="two motors"):
            run([*words, "--port", PORT])
    rig.line.faults.cut_off = set()
    assert [motor.id for motor in rig.line.motors[:2]] == [10, 10]


def test_the_commands_of_the_troubleshooting_parse():
    text = (Path(__file__).parents[1] / "docs" / "troubleshooting.md").read_text()
    rows = commands(text[text.index("## Motors") : text.index("## While a hand runs")])
    assert {"reboot", "set-id", "set-baud", "scan", "record"} == {words[0] for words in rows}
    assert all(parse(words).port == "/dev/ttyUSB0" for words in rows)


def test_an_error_comes_with_the_command_that_clears_it(rig, port):
    rig.line.motors[8].put("hardware_error_status", 32)
    (mend,) = commands(rig.wrong()[0])
    assert mend[:2] == ["reboot", "32"] and run(mend) == 0
    assert rig.line.motors[8].get("hardware_error_status") == 0


def test_ids_and_baud_rates_are_changed_and_looked_at_afterwards(rig, port, capsys):
    assert run(["set-id", "10", "13", "--port", PORT]) == 0 and rig.motor.id == 13
    assert run(["set-baud", "13", "57600", "--port", PORT]) == 0 and rig.motor.get("baud_rate") == 1
    assert "now at 57600 baud" in capsys.readouterr().out
    with pytest.raises(BusError, match="motor 13 does not answer at 1000000 baud: `vd-deploy scan"):
        run(["set-id", "13", "10", "--port", PORT])
    assert run(["set-id", "13", "10", "--port", PORT, "--baud-rate", "57600"]) == 0
    assert run(["set-baud", "10", "1000000", "--port", PORT, "--baud-rate", "57600"]) == 0
    rig.reopen()
    assert rig.bus.missing() == {}


@pytest.mark.parametrize(
    ("words", "spoil", "error"),
    [
        (["reboot", "10"], {"torque_enable": 1}, "torque on"),
        (["set-id", "10", "40"], {"torque_enable": 1}, "torque on"),
        (["set-baud", "10", "57600"], {"torque_enable": 1}, "torque on"),
        (["set-id", "10", "11"], {}, "ID 11 is taken"),
        (["set-id", "10", "40"], {"status_return_level": 0}, "reboot 10"),
        (["set-id", "10", "253"], {}, "within 0 and 252"),
        (["set-id", "10", "10"], {}, "that is its ID"),
        (["set-baud", "10", "1200"], {}, "motors have 9600"),
        (["reboot", "77"], {}, "does not answer"),
    ],
)
def test_a_motor_is_left_alone_where_it_must_be(rig, port, words, spoil, error):
    for name, value in spoil.items():
        rig.motor.put(name, value)
    before = [bytes(motor.memory[:70]) for motor in rig.line.motors]
    with pytest.raises((BusError, ValueError), match=error):
        run([*words, "--port", PORT])
    assert [bytes(motor.memory[:70]) for motor in rig.line.motors] == before


@pytest.mark.parametrize("words", [["reboot", "10"], ["set-id", "10", "40"], ["set-baud", "10", "57600"]])
def test_nothing_is_written_to_a_motor_unasked(rig, port, words):
    rig.motor.put("hardware_error_status", 4)
    before = bytes(rig.motor.memory[:71])
    with pytest.raises(RuntimeError, match="Motor 10, XH430-V210, will"):
        getattr(maintain, cli.COMMANDS[words[0]].function)(parse([*words, "--port", PORT]))
    assert bytes(rig.motor.memory[:71]) == before


@pytest.mark.parametrize("waited", [0.0, 29.5])  # its clock begins anew after 32.8 s by itself
def test_a_motor_that_does_not_restart_is_not_said_to_have(rig, port, monkeypatch, waited):
    monkeypatch.setattr(type(rig.motor), "reboot", lambda motor: None)
    rig.motor._clock = waited
    with pytest.raises(BusError, match="did not restart"):
        run(["reboot", "10", "--port", PORT])


@pytest.mark.parametrize(("latency", "right"), [("16\n", False), ("1\n", True), (None, None)])
def test_an_adapter_that_keeps_answers_is_refused(rig, tmp_path, monkeypatch, latency, right):
    monkeypatch.setattr(adapter, "USB_SERIAL", tmp_path)
    if latency is not None:
        (tmp_path / "simulated").mkdir()
        (tmp_path / "simulated" / "latency_timer").write_text(latency)
    found = rig.findings().get("USB latency timer")
    assert (found and found.ok) is right
    if right is False:
        assert f"echo 1 | sudo tee {tmp_path}/simulated/latency_timer" in found.found


def test_an_adapter_is_found_behind_its_link(tmp_path, monkeypatch):
    monkeypatch.setattr(adapter, "USB_SERIAL", tmp_path)
    (tmp_path / "ttyUSB7").mkdir()
    (tmp_path / "ttyUSB7" / "latency_timer").write_text("16")
    (tmp_path / "usb-FTDI_U2D2").symlink_to("ttyUSB7")
    assert [one.ok for one in adapter.adapter_findings(str(tmp_path / "usb-FTDI_U2D2"))] == [False]
