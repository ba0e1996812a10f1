"""Control tables of DYNAMIXEL X motors (ROBOTIS e-manual, one page a model), and their units.

The models share addresses and differ in units and limits. Angles in radians with zero in the middle
of the range, velocities in rad/s, currents in A.
"""

import math
from dataclasses import dataclass
from enum import IntFlag
from typing import TypeVar

import numpy as np

Counts = TypeVar("Counts", float, np.ndarray)

COUNTS_PER_TURN = 4096
CENTRE = 2048
"""Count of the middle of the range, the zero of all angles here."""
FARTHEST_COUNTS = 256 * COUNTS_PER_TURN
"""Range of the extended position mode, 256 turns either way: no sound position lies beyond."""
RAD_PER_COUNT = 2.0 * math.pi / COUNTS_PER_TURN
RAD_S_PER_COUNT = 0.229 * 2.0 * math.pi / 60.0
MAX_ID = 252
"""Largest ID of a motor."""
SIZE = 148
"""Bytes of the table: all but the indirect addresses behind."""
EEPROM_END = 64
"""Items below are kept without power, and cannot be written while torque is on."""
POSITION_MODE = 3
CURRENT_POSITION_MODE = 5
"""Position control under a largest current, over 256 turns either way: position limits do not
act.
"""
FULL_PWM = 885
"""Counts of the whole supply voltage."""
WATCHDOG_UNIT_S = 0.02
"""Unit of the bus watchdog."""
WATCHDOG_TRIPPED = -1
"""Value of the bus watchdog of a motor that it has stopped: goals are refused until 0 is
written."""
WATCHDOG_FIRMWARE = 38
"""First firmware that has a bus watchdog; the XL330 and XC330 had it from their first one on."""
TICK_MODULUS = 32768
"""Milliseconds after which a motor's clock begins anew."""


@dataclass(frozen=True)
class Item:
    """One entry of the control table."""

    address: int
    size: int
    """Bytes, little-endian."""
    initial: int = 0
    """The factory's value."""
    signed: bool = False
    """Whether negative numbers are two's complement."""

    def to_bytes(self, value: int) -> bytes:
        """Little-endian bytes of a value."""
        return (value & ((1 << (8 * self.size)) - 1)).to_bytes(self.size, "little")

    def from_bytes(self, data: bytes) -> int:
        """The value of ``size`` bytes."""
        return int.from_bytes(data, "little", signed=self.signed)

    def within(self, data: bytes, first: int = 0) -> int:
        """Its value in bytes of the control table from the address ``first`` on."""
        start = self.address - first
        return self.from_bytes(data[start : start + self.size])


@dataclass(frozen=True)
class Model:
    """What tells one motor of the series from another."""

    name: str
    number: int
    current_unit_a: float
    current_limit: int
    """Largest and initial limit, counts of ``current_unit_a``."""
    velocity_limit: int
    """Initial limit, counts of 0.229 rev/min."""
    volts: tuple[int, int]
    """Least and largest voltage limit [0.1 V]."""
    supply_v: float
    torque_nm_per_a: float
    """Stall torque over stall current, at the supply's voltage. XL330 and XC330 measure the
    supply's current, so their torque is a guess."""
    temperature_limit: int = 80
    """Initial limit [deg C]."""
    velocity_most: int = 1023
    """Largest limit, counts of 0.229 rev/min."""
    senses_current: bool = True
    """Whether it measures and limits its current. Others tell a load, in 0.1 % of the largest, by
    which the current is guessed, and have no current-based mode."""

    def current_of(self, torque_nm: float) -> float:
        """Current for a torque [A], no larger than the motor's largest."""
        return min(torque_nm / self.torque_nm_per_a, self.current_limit * self.current_unit_a)


_MODELS = (
    Model("XL330-M077", 1190, 1e-3, 1750, 1620, (35, 70), 5.0, 0.215 / 1.47, 70, 2047),
    Model("XL330-M288", 1200, 1e-3, 1750, 445, (35, 70), 5.0, 0.52 / 1.47, 70, 2047),
    Model("XC330-T181", 1210, 1e-3, 910, 510, (55, 140), 12.0, 0.80 / 0.88, 70, 2047),
    Model("XC330-T288", 1220, 1e-3, 910, 320, (55, 140), 12.0, 1.00 / 0.88, 70, 2047),
    Model("XC330-M181", 1230, 1e-3, 2352, 545, (35, 70), 5.0, 0.60 / 1.80, 70, 2047),
    Model("XC330-M288", 1240, 1e-3, 2352, 350, (35, 70), 5.0, 0.93 / 1.80, 70, 2047),
    Model("XL430-W250", 1060, 1.4e-3, 1000, 265, (60, 140), 12.0, 1.5 / 1.4, 72, 1023, False),
    Model("XC430-W150", 1070, 1.4e-3, 1000, 460, (60, 160), 12.0, 1.6 / 1.4, 80, 1023, False),
    Model("XC430-W240", 1080, 1.4e-3, 1000, 306, (60, 160), 12.0, 1.9 / 1.4, 80, 1023, False),
    Model("XM430-W210", 1030, 2.69e-3, 1193, 330, (95, 160), 12.0, 3.0 / 2.3),
    Model("XM430-W350", 1020, 2.69e-3, 1193, 200, (95, 160), 12.0, 4.1 / 2.3),
    Model("XM540-W150", 1130, 2.69e-3, 2047, 230, (95, 160), 12.0, 7.3 / 4.4),
    Model("XM540-W270", 1120, 2.69e-3, 2047, 128, (95, 160), 12.0, 10.6 / 4.4),
    Model("XH430-W350", 1000, 2.69e-3, 648, 280, (95, 160), 12.0, 3.4 / 1.3),
    Model("XH430-V210", 1050, 1.34e-3, 689, 380, (110, 300), 24.0, 2.6 / 0.7),
)
MODELS = {model.name: model for model in _MODELS}
"""The motors, by name."""


def motor_model(name: str) -> Model:
    """A motor by the name of its model, with or without what its plug is called (``XC330-M288-T``).

    Raises:
        ValueError: There is none of this name.
    """
    short = "-".join(name.upper().split("-")[:2])
    if short not in MODELS:
        raise ValueError(f"no motor is called {name}; choose of {', '.join(MODELS)}")
    return MODELS[short]


def model_name(number: int) -> str:
    """The name of a motor's model; its number where it is none of ours."""
    names = {model.number: name for name, model in MODELS.items()}
    return names.get(number, f"model {number}")


class HardwareError(IntFlag):
    """Bits of the hardware error status and of the shutdown mask."""

    VOLTAGE = 1 << 0
    OVERHEATING = 1 << 2
    ENCODER = 1 << 3
    SHOCK = 1 << 4
    OVERLOAD = 1 << 5


def describe_hardware_error(bits: int) -> str:
    """The bits of a hardware error status in words."""
    names = [str(bit.name).lower() for bit in HardwareError if bits & bit]
    return ", ".join(names) or "none"


def table(model: Model) -> dict[str, Item]:
    """The entries of a motor's control table that a hand needs, by name."""
    low_v, high_v = model.volts
    items = {
        "firmware_version": Item(6, 1, WATCHDOG_FIRMWARE),
        "return_delay_time": Item(9, 1, 250),
        "drive_mode": Item(10, 1),
        "operating_mode": Item(11, 1, POSITION_MODE),
        "secondary_id": Item(12, 1, 255),
        "homing_offset": Item(20, 4, signed=True),
        "temperature_limit": Item(31, 1, model.temperature_limit),
        "max_voltage_limit": Item(32, 2, high_v),
        "min_voltage_limit": Item(34, 2, low_v),
        "pwm_limit": Item(36, 2, FULL_PWM),
        "current_limit": Item(38, 2, model.current_limit),
        "velocity_limit": Item(44, 4, model.velocity_limit),
        "max_position_limit": Item(48, 4, 4095),
        "min_position_limit": Item(52, 4),
        "startup_configuration": Item(60, 1),
        "shutdown": Item(63, 1, 0b110100),
        "torque_enable": Item(64, 1),
        "status_return_level": Item(68, 1, 2),
        "hardware_error_status": Item(70, 1),
        "position_d_gain": Item(80, 2),
        "position_i_gain": Item(82, 2),
        "position_p_gain": Item(84, 2, 800),
        "feedforward_2nd_gain": Item(88, 2),
        "feedforward_1st_gain": Item(90, 2),
        "bus_watchdog": Item(98, 1, signed=True),
        "goal_pwm": Item(100, 2, FULL_PWM, signed=True),
        "goal_current": Item(102, 2, model.current_limit, signed=True),
        "profile_acceleration": Item(108, 4),
        "profile_velocity": Item(112, 4),
        "goal_position": Item(116, 4, signed=True),
        "realtime_tick": Item(120, 2),
        "present_pwm": Item(124, 2, signed=True),
        "present_current": Item(126, 2, signed=True),
        "present_velocity": Item(128, 4, signed=True),
        "present_position": Item(132, 4, signed=True),
        "present_input_voltage": Item(144, 2),
        "present_temperature": Item(146, 1),
    }
    if not model.senses_current:
        del items["current_limit"]
        del items["goal_current"]
    return items


def to_counts(angle_rad: float) -> int:
    """The nearest count of an angle."""
    return CENTRE + round(angle_rad / RAD_PER_COUNT)


def to_angle(counts: Counts) -> Counts:
    """The angle of a count, or of several [rad]."""
    return (counts - CENTRE) * RAD_PER_COUNT
