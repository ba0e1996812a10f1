"""The registers of a motor that matter.

What is wanted of each, whether we set it or refuse, and why.

One table for the preflight, which compares, and for
:meth:`vd.deploy.hardware.bus.MotorBus.configure`, which writes. What is wanted is the hand's own
value, and else the factory's. The other registers tell, or act in other operating modes alone:
velocity gains, goal velocity.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from vd.deploy.hardware.control_table import (
    CURRENT_POSITION_MODE,
    EEPROM_END,
    MODELS,
    POSITION_MODE,
    RAD_S_PER_COUNT,
    Model,
    table,
    to_counts,
)

RESTART = "switch its power off and on"
"""Clears a motor's error, and has it count angles within one turn."""
WIZARD = "set it to {wanted} with ROBOTIS' DYNAMIXEL Wizard 2.0"


@dataclass(frozen=True)
class Register:
    """One register that has to be right before a hand moves."""

    name: str
    """Item of the control table."""
    why: str
    """What another value does."""
    remedy: str = ""
    """What a person has to do where it is not ours to set; empty where we set it."""
    bits: bool = False
    """Whether its bits are protections, of which more may be on than are wanted."""
    least: bool = False
    """Whether a larger value will do, too."""

    def right(self, value: int, wanted: int) -> bool:
        """Whether a value will do."""
        if self.least:
            return value >= wanted
        return value & wanted == wanted if self.bits else value == wanted


REGISTERS = (
    Register(
        "firmware_version",
        "it has no bus watchdog, so it drives on when this program dies",
        "update it to {wanted} or later with ROBOTIS' DYNAMIXEL Wizard 2.0",
        least=True,
    ),
    Register(
        "drive_mode",
        "angles, profiles or the torque follow other rules",
        f"{WIZARD}, and calibrate again",
    ),
    Register("homing_offset", "angles begin elsewhere", f"{WIZARD}, and calibrate again"),
    Register("status_return_level", "writes or reads stay unanswered", RESTART),
    # In the order to write them: the mode resets gains and profiles, a watchdog that acted locks
    # the goals.
    Register("operating_mode", "goals are no positions"),
    Register("bus_watchdog", "goals are refused, or it stops too early"),
    Register("secondary_id", "it obeys what is sent to another motor, too"),
    Register("return_delay_time", "its answers come late"),
    Register(
        "startup_configuration", "it switches itself on, or restores other settings, at a start"
    ),
    Register("temperature_limit", "it shuts down too hot, or too early"),
    Register("max_voltage_limit", "it takes another supply for right"),
    Register("min_voltage_limit", "it takes another supply for right"),
    Register("shutdown", "it does not protect itself", bits=True),
    Register("pwm_limit", "its torque and speed are cut"),
    Register("current_limit", "its limit is not the joint's"),
    Register("velocity_limit", "its limit is not the joint's"),
    Register("min_position_limit", "its limit is not the joint's"),
    Register("max_position_limit", "its limit is not the joint's"),
    Register("position_p_gain", "it is not as stiff as in training"),
    Register("position_i_gain", "it overshoots, and pushes ever harder"),
    Register("position_d_gain", "it is not damped as in training"),
    Register("feedforward_1st_gain", "it is pushed beyond its goals"),
    Register("feedforward_2nd_gain", "it is pushed beyond its goals"),
    Register("goal_pwm", "its torque and speed are cut"),
    Register("goal_current", "its grip is not the hand's"),
    Register("profile_acceleration", "it comes slowly to its goals"),
    Register("profile_velocity", "it comes slowly to its goals"),
)
"""The table."""
ROUNDING = 1e-6
"""Of a count: 0.35 A are 350 counts of 1 mA, not 349."""
OPTIONAL = ("current_limit", "goal_current")
"""Registers that not every motor and mode has: they are compared where the settings name them."""


@dataclass(frozen=True)
class MotorSettings:
    """What is written to a motor at start, and read back."""

    current_limit_a: float
    """Largest current [A]."""
    velocity_limit_rad_s: float
    """Largest speed [rad/s]."""
    lower_rad: float
    """Least angle [rad]."""
    upper_rad: float
    """Largest angle [rad]."""
    p_gain: int = 200
    d_gain: int = 10
    current_based: bool = False
    """Whether ``current_limit_a`` bounds what a joint may pull (current-based position control)."""

    def values(self, model: Model) -> dict[str, int]:
        """Values of the control table that are the joint's own, by item."""
        current = int(self.current_limit_a / model.current_unit_a + ROUNDING)
        return {
            "operating_mode": CURRENT_POSITION_MODE if self.current_based else POSITION_MODE,
            "return_delay_time": 0,
            **({"current_limit": current} if model.senses_current else {}),
            **({"goal_current": current} if self.current_based else {}),
            "velocity_limit": int(self.velocity_limit_rad_s / RAD_S_PER_COUNT),
            "min_position_limit": to_counts(self.lower_rad),
            "max_position_limit": to_counts(self.upper_rad),
            "position_p_gain": self.p_gain,
            "position_i_gain": 0,
            "position_d_gain": self.d_gain,
        }


def different(
    values_found: Mapping[str, int], model: Model, settings: MotorSettings
) -> dict[Register, tuple[int, int]]:
    """Registers that are not as they should be: the value of each, and the wanted one.

    Args:
        values_found: Control table of a motor.
        model: Its model.
        settings: What its joint wants; the factory's values otherwise.
    """
    items = table(model)
    values = settings.values(model)
    differences = {}
    for register in REGISTERS:
        name = register.name
        if name in OPTIONAL and name not in values:
            continue
        wanted = values.get(name, items[name].initial)
        if not register.right(values_found[name], wanted):
            differences[register] = (values_found[name], wanted)
    return differences


def kept(register: Register) -> bool:
    """Whether a register is kept without power (EEPROM)."""
    return table(next(iter(MODELS.values())))[register.name].address < EEPROM_END
