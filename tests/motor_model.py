"""One motor of the twin.

Its control table, what can be written when, how it drives and protects itself.
"""

import math
from dataclasses import dataclass

from motor_packets import ALERT, Failure
from motor_plant import Drive

from vd.deploy.hardware.control_table import (
    COUNTS_PER_TURN,
    CURRENT_POSITION_MODE,
    EEPROM_END,
    POSITION_MODE,
    RAD_S_PER_COUNT,
    SIZE,
    TICK_MODULUS,
    WATCHDOG_FIRMWARE,
    WATCHDOG_TRIPPED,
    WATCHDOG_UNIT_S,
    HardwareError,
    Model,
    to_angle,
    to_counts,
)
from vd.deploy.hardware.joints import JointMotors

FULL_PWM = 885

OVERLOAD_SHARE, OVERLOAD_S = 0.9, 1.0
"""A motor that gives this share of its largest torque for this long has an overload; the real rule
is not published."""
AMBIENT_C, HEATING_C_PER_S, COOLING_S = 30.0, 0.5, 120.0
"""Case temperature: rise at full torque, and time constant of cooling."""
TICK_S = 1e-3
"""What its clock counts."""
PHASE_S = 0.618e-3
"""Between the clocks of two motors whose IDs follow each other: none start at the same moment."""
MODE_ITEMS = (
    "position_p_gain",
    "position_i_gain",
    "position_d_gain",
    "feedforward_1st_gain",
    "feedforward_2nd_gain",
    "profile_velocity",
    "profile_acceleration",
    "goal_pwm",
)
"""What another operating mode brings back to its initial value."""
GOALS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")


@dataclass(frozen=True)
class Item:
    """One entry of the control table."""

    address: int
    size: int
    """Bytes, little-endian."""
    writable: bool = True
    initial: int = 0
    low: int | None = None
    """Least value that can be written; None asks nothing."""
    high: int | None = None

    @property
    def signed(self) -> bool:
        """Whether negative numbers are two's complement."""
        return self.low is None or self.low < 0

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


def table(model: Model) -> dict[str, Item]:
    """The control table of a motor, by item, as the e-manual has it: written anew, not the driver's."""
    low_v, high_v = model.volts
    gain = {"low": 0, "high": 16383}
    items = {
        "model_number": Item(0, 2, False, model.number, 0),
        "model_information": Item(2, 4, False, 0, 0),
        "firmware_version": Item(6, 1, False, WATCHDOG_FIRMWARE, 0),
        "id": Item(7, 1, True, 1, 0, 252),
        "baud_rate": Item(8, 1, True, 1, 0, 7),
        "return_delay_time": Item(9, 1, True, 250, 0, 254),
        "drive_mode": Item(10, 1, True, 0, 0, 5),
        "operating_mode": Item(11, 1, True, POSITION_MODE, 0, 16),
        "secondary_id": Item(12, 1, True, 255, 0, 255),
        "protocol_type": Item(13, 1, True, 2, 1, 2),
        "homing_offset": Item(20, 4, True, 0, -1_044_479, 1_044_479),
        "moving_threshold": Item(24, 4, True, 10, 0, 1023),
        "temperature_limit": Item(31, 1, True, model.temperature_limit, 0, 100),
        "max_voltage_limit": Item(32, 2, True, high_v, low_v, high_v),
        "min_voltage_limit": Item(34, 2, True, low_v, low_v, high_v),
        "pwm_limit": Item(36, 2, True, FULL_PWM, 0, FULL_PWM),
        "current_limit": Item(38, 2, True, model.current_limit, 0, model.current_limit),
        "velocity_limit": Item(44, 4, True, model.velocity_limit, 0, model.velocity_most),
        "max_position_limit": Item(48, 4, True, 4095, 0, 4095),
        "min_position_limit": Item(52, 4, True, 0, 0, 4095),
        "startup_configuration": Item(60, 1, True, 0, 0, 3),
        "shutdown": Item(63, 1, True, 0b110100, 0, 255),
        "torque_enable": Item(64, 1, True, 0, 0, 1),
        "led": Item(65, 1, True, 0, 0, 1),
        "status_return_level": Item(68, 1, True, 2, 0, 2),
        "registered_instruction": Item(69, 1, False, 0, 0),
        "hardware_error_status": Item(70, 1, False, 0, 0),
        "velocity_i_gain": Item(76, 2, True, 1920, **gain),
        "velocity_p_gain": Item(78, 2, True, 100, **gain),
        "position_d_gain": Item(80, 2, True, 0, **gain),
        "position_i_gain": Item(82, 2, True, 0, **gain),
        "position_p_gain": Item(84, 2, True, 800, **gain),
        "feedforward_2nd_gain": Item(88, 2, True, 0, **gain),
        "feedforward_1st_gain": Item(90, 2, True, 0, **gain),
        "bus_watchdog": Item(98, 1, True, 0, WATCHDOG_TRIPPED, 127),
        "goal_pwm": Item(100, 2, True, FULL_PWM),
        "goal_current": Item(102, 2, True, model.current_limit),
        "goal_velocity": Item(104, 4, True, model.velocity_limit),
        "profile_acceleration": Item(108, 4, True, 0, 0, 32767),
        "profile_velocity": Item(112, 4, True, 0, 0, 32767),
        "goal_position": Item(116, 4),
        "realtime_tick": Item(120, 2, False, 0, 0),
        "moving": Item(122, 1, False, 0, 0),
        "moving_status": Item(123, 1, False, 0, 0),
        "present_pwm": Item(124, 2, False),
        "present_current": Item(126, 2, False),
        "present_velocity": Item(128, 4, False),
        "present_position": Item(132, 4, False),
        "velocity_trajectory": Item(136, 4, False),
        "position_trajectory": Item(140, 4, False),
        "present_input_voltage": Item(144, 2, False, round(10 * model.supply_v), 0),
        "present_temperature": Item(146, 1, False, 30, 0),
        "backup_ready": Item(147, 1, False, 0, 0),
    }
    lacking = () if model.senses_current else ("current_limit", "goal_current")
    return {name: item for name, item in items.items() if name not in lacking}


class Motor:
    """A motor on the bus."""

    def __init__(self, model: Model, id: int):
        """Power on with factory settings."""
        self.model = model
        self.heat_c_per_s = 0.0
        """Injected heating, whatever the torque [deg C/s]."""
        self.items = table(model)
        self._at = {item.address: (name, item) for name, item in self.items.items()}
        self.memory = bytearray(SIZE)
        for name, item in self.items.items():
            self.put(name, item.initial)
        self.put("id", id)
        self.temperature, self._where = AMBIENT_C, 0.0
        self.reboot()

    def reboot(self) -> None:
        """Start anew: torque off, errors cleared, RAM at its initial values.

        What is kept in EEPROM stays.
        """
        for name, item in self.items.items():
            if item.address >= EEPROM_END and item.writable:
                self.put(name, item.initial)
        self._let_pull()
        self.put("hardware_error_status", 0)
        self._clock = self.id * PHASE_S % TICK_S
        self._strained = self._silence = 0.0
        self._turns = 0
        self._count_one_turn()

    def get(self, name: str) -> int:
        """Value of an item."""
        item = self.items[name]
        return item.from_bytes(bytes(self.memory[item.address : item.address + item.size]))

    def put(self, name: str, value: int) -> None:
        """Set an item, as the motor itself does, without any rule."""
        item = self.items[name]
        self.memory[item.address : item.address + item.size] = item.to_bytes(value)
        if name == "id":
            self.id = value

    @property
    def alert(self) -> int:
        """The alert bit of status packets."""
        return ALERT if self.get("hardware_error_status") else 0

    @property
    def shut_down(self) -> bool:
        """Whether an error has taken the torque away; only a reboot gives it back."""
        return bool(self.get("hardware_error_status") & self.get("shutdown"))

    def _let_pull(self) -> None:
        """Goal current at its limit, as when switched on, or in another operating mode."""
        if self.model.senses_current:
            self.put("goal_current", self.get("current_limit"))

    def _count_one_turn(self) -> None:
        """Count angles anew within one turn, as when switched on.

        Turned by hand it has counted on.
        """
        self._turns = to_counts(self._where) // COUNTS_PER_TURN
        self.put("present_position", to_counts(self._where) % COUNTS_PER_TURN)

    def read(self, address: int, length: int) -> tuple[Failure, bytes]:
        """Bytes of the control table."""
        if length < 1 or address + length > SIZE:
            return Failure.LENGTH, b""
        return Failure.NONE, bytes(self.memory[address : address + length])

    def write(self, address: int, data: bytes) -> Failure:
        """Write whole items; all or, with an error, none."""
        changes: list[tuple[str, int]] = []
        if not data:
            return Failure.LENGTH
        while data:
            if address not in self._at:
                return Failure.ACCESS
            name, item = self._at[address]
            if len(data) < item.size:
                return Failure.LENGTH
            value = item.from_bytes(data[: item.size])
            failure = self._refusal(name, value)
            if failure:
                return failure
            changes.append((name, value))
            address, data = address + item.size, data[item.size :]
        for name, value in changes:
            self.accept(name, value)
        return Failure.NONE

    def _refusal(self, name: str, value: int) -> Failure:
        item = self.items[name]
        torque = self.get("torque_enable")
        if not item.writable or (item.address < EEPROM_END and torque):
            return Failure.ACCESS
        if (item.low is not None and value < item.low) or (
            item.high is not None and value > item.high
        ):
            return Failure.RANGE
        if name == "torque_enable" and value and self.shut_down:
            return Failure.ACCESS
        if name in GOALS and self.get("bus_watchdog") == WATCHDOG_TRIPPED:
            return Failure.RANGE
        if name == "goal_position" and self.get("operating_mode") == POSITION_MODE:
            low, high = self.get("min_position_limit"), self.get("max_position_limit")
            return Failure.NONE if low <= value <= high else Failure.LIMIT
        limits = {
            "goal_pwm": "pwm_limit",
            "goal_current": "current_limit",
            "goal_velocity": "velocity_limit",
        }
        if name in limits and abs(value) > self.get(limits[name]):
            return Failure.LIMIT
        return Failure.NONE

    def accept(self, name: str, value: int) -> None:
        """Do what a value that may be written asks for."""
        if name == "torque_enable" and value and not self.get("torque_enable"):
            if self.get("operating_mode") == POSITION_MODE:
                self._count_one_turn()
            # A motor does not jump when switched on.
            self.put("goal_position", self.get("present_position"))
        if name == "operating_mode" and value != self.get(name):
            for item in MODE_ITEMS:
                self.put(item, self.items[item].initial)
            self._let_pull()
            if value == POSITION_MODE:
                self._count_one_turn()
        self.put(name, value)

    def heard(self) -> None:
        """An instruction came for this motor."""
        self._silence = 0.0

    def drive(self) -> Drive:
        """What the motor does with its axis.

        Profiles, I gain and feed-forward are not simulated.
        """
        counts = (
            self.get("current_limit") if self.model.senses_current else self.model.current_limit
        )
        if self.get("operating_mode") == CURRENT_POSITION_MODE:
            counts = min(counts, self.get("goal_current"))
        goal: float | None = None
        if self.get("torque_enable"):
            turns = 2.0 * math.pi * self._turns
            goal = to_angle(self.get("goal_position")) + turns
        return Drive(
            goal_rad=goal,
            p_gain=float(self.get("position_p_gain")),
            velocity_limit=self.get("velocity_limit") * RAD_S_PER_COUNT,
            torque_limit=counts * self.model.current_unit_a * self.model.torque_nm_per_a,
        )

    def sense(self, seconds: float, position: float, velocity: float, torque: float) -> None:
        """Take in angle [rad], speed [rad/s] and torque [N m] ``seconds`` later, and protect the motor."""
        self._clock += seconds
        self.put("realtime_tick", int(self._clock / TICK_S) % TICK_MODULUS)
        self._where = position
        counts = to_counts(position) - self._turns * COUNTS_PER_TURN
        speed = round(velocity / RAD_S_PER_COUNT)
        self.put("present_position", counts)
        self.put("present_velocity", speed)
        self.put(
            "present_current",
            round(torque / self.model.torque_nm_per_a / self.model.current_unit_a),
        )
        self.put("moving", int(abs(speed) > self.get("moving_threshold")))
        self._protect(seconds, torque)
        self._watch(seconds)

    def _protect(self, seconds: float, torque: float) -> None:
        full = self.model.current_limit * self.model.current_unit_a * self.model.torque_nm_per_a
        load = abs(torque) / full
        warming = (
            HEATING_C_PER_S * load**2
            - (self.temperature - AMBIENT_C) / COOLING_S
            + self.heat_c_per_s
        )
        self.temperature += seconds * warming
        self.put("present_temperature", min(255, round(self.temperature)))
        self._strained = self._strained + seconds if load >= OVERLOAD_SHARE else 0.0
        bits = self.get("hardware_error_status")
        if self.temperature > self.get("temperature_limit"):
            bits |= HardwareError.OVERHEATING
        if self._strained >= OVERLOAD_S:
            bits |= HardwareError.OVERLOAD
        self.put("hardware_error_status", bits)
        if self.shut_down:
            self.put("torque_enable", 0)

    def _watch(self, seconds: float) -> None:
        self._silence = self._silence + seconds if self.get("torque_enable") else 0.0
        limit = self.get("bus_watchdog")
        if limit > 0 and self._silence > limit * WATCHDOG_UNIT_S:
            self.put("bus_watchdog", WATCHDOG_TRIPPED)
            self.put("goal_position", self.get("present_position"))


def make_motors(joints: JointMotors) -> list[Motor]:
    """A hand's motors, as they come from the factory but for their IDs."""
    return [Motor(model, id) for model, id in zip(joints.models, joints.ids, strict=True)]
