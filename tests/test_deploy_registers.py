"""What the preflight reads of the motors: a wrong register is named, and set or refused.

Remedies do mend.
"""

import re
from dataclasses import replace

import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from simulated_hand import simulated_bus

from vd.assets_usd.hands import load_hand
from vd.deploy.hardware import check
from vd.deploy.hardware.connect import Connection
from vd.deploy.hardware.control_table import MODELS, table
from vd.deploy.hardware.joints import read_joints
from vd.deploy.hardware.registers import REGISTERS

MOTOR = "XH430-V210"
FACTORY = {name: item.initial for name, item in table(MODELS[MOTOR]).items()}


class Rig:
    """A hand's motors on a simulated line, with nothing between a test and them."""

    def __init__(self, hand, joints, line, bus):
        self.connection, self.line, self.bus = Connection(joints, bus), line, bus
        self.motor = line.motors[0]

    def findings(self):
        """What the preflight finds, by name."""
        self.bus.states.forget()
        return {one.what: one for one in check.preflight(self.connection)}

    def wrong(self) -> list[str]:
        """What the preflight finds wrong."""
        return [one.words for one in self.findings().values() if not one.ok]


@pytest.fixture
def rig(monkeypatch):
    """Motor 12 is under a largest current, as no D'Claw's is."""
    hand = load_hand("dclaw3")
    motors = tuple(replace(motor, current=0.3 * (motor.id == 12)) for motor in hand.motors)
    hand = replace(hand, motors=motors)
    joints = read_joints(hand)
    monkeypatch.setattr(check, "CYCLES", 1)
    with simulated_bus(hand, joints) as (line, bus):
        line.plant.position[:] = hand.start + 0.1
        bus.clock.sleep(0.02)
        yield Rig(hand, joints, line, bus)


def test_every_register_of_the_table_is_compared(rig):
    rig.bus.configure(rig.connection.joints.settings())
    tables = {id: rig.bus.read_table(id) for id in rig.bus.ids}
    assert [one.what for one in check.register_findings(rig.connection.joints, tables)] == [
        "registers"
    ]
    for register in REGISTERS:
        right = tables[12][register.name]
        other = 0 if register.bits else right - 1 if register.least else right + 1
        spoilt = {**tables, 12: {**tables[12], register.name: other}}
        (only,) = check.register_findings(rig.connection.joints, spoilt)
        assert only.what == register.name and f"motor 12: {other};" in only.words
        assert only.ok != bool(register.remedy)
    more = {**tables, 12: {**tables[12], "shutdown": FACTORY["shutdown"] | 1}}
    assert [one.what for one in check.register_findings(rig.connection.joints, more)] == [
        "registers"
    ]


def test_a_motor_whose_firmware_has_no_watchdog_is_refused_and_a_newer_one_is_not(rig):
    rig.motor.put("firmware_version", 52)
    assert rig.wrong() == []
    rig.motor.put("firmware_version", 37)
    (wrong,) = rig.wrong()
    assert re.search("bus watchdog.*motor 10: 37; update it to 38 or later with", wrong)


def test_another_operating_mode_is_set_before_the_gains_that_it_resets(rig):
    accept = rig.motor.accept
    order = []
    rig.motor.accept = lambda name, value: (order.append(name), accept(name, value))
    rig.motor.put("operating_mode", 4)
    rig.bus.configure(rig.connection.joints.settings())
    assert order.index("operating_mode") < order.index("position_p_gain")
    assert (rig.motor.get("operating_mode"), rig.motor.get("position_p_gain")) == (3, 200)


def test_what_is_mended_by_a_restart_is_named_with_it(rig):
    rig.motor.put("status_return_level", 0)
    (wrong,) = rig.wrong()
    assert re.search("motor 10 answers pings, but no reads.*switch its power off and on", wrong)
    for motor in rig.line.motors:
        motor.reboot()
    assert rig.wrong() == []


@pytest.mark.parametrize(("latency", "right"), [("16\n", False), ("1\n", True), (None, None)])
def test_an_adapter_that_keeps_answers_is_refused(tmp_path, monkeypatch, latency, right):
    """Found behind a link, as udev makes them."""
    monkeypatch.setattr(check, "USB_SERIAL", tmp_path)
    (tmp_path / "usb-FTDI_U2D2").symlink_to("ttyUSB7")
    if latency is not None:
        (tmp_path / "ttyUSB7").mkdir()
        (tmp_path / "ttyUSB7" / "latency_timer").write_text(latency)
    found = list(check.adapter_findings(str(tmp_path / "usb-FTDI_U2D2")))
    assert [one.ok for one in found] == ([] if right is None else [right])
    if right is False:
        assert f"echo 1 | sudo tee {tmp_path}/ttyUSB7/latency_timer" in found[0].words
