"""What motors answer, and which of their states are accepted.

A state counts only whole and fresh: right motor, right length, no error number, angles that a motor
can count, a clock that went on as ours did, and no farther from the last one than the motor can
turn. A checksum alone is not enough: its 16 bits pass one of 65536 broken packets.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vd.deploy.hardware.control_table import (
    FARTHEST_COUNTS,
    FULL_PWM,
    RAD_S_PER_COUNT,
    TICK_MODULUS,
    Model,
    table,
    to_angle,
)

ALERT = 0x80
"""Bit of a status packet's error byte: the motor's hardware error status is not zero."""
STATUS = 0x55
"""Instruction of a status packet."""
STATE_ADDRESS, STATE_BYTES = 120, 27
"""From the realtime tick to the temperature: one read for the whole state."""
OTHER_BYTES = STATE_BYTES + 1
"""Asked for after a question that was given up, whose answer is then known by its length when it
comes.
"""
CLOCK_TOLERANCE_S = 0.04
"""A state whose clock went on by so much more or less than ours is an old one, or from after a
restart; the packet's own time on the line and in the driver is within it."""
JUMP_RAD = 0.1
"""Beyond what the largest speed explains, a position that changed by more was not measured."""
SPEED_MARGIN = 1.5
"""Motors turn faster than their limit of speed when pushed."""


class BusError(RuntimeError):
    """The bus or a motor did not do what was asked; says which, and what to try."""


class SilentError(BusError):
    """A motor did not answer, though this program listened."""


class LateError(BusError):
    """This program did not run in time to hear the motors.

    No fault of theirs, or of their cables.
    """


class GarbledError(BusError):
    """Something answered, but no sound packet came, also not when asked again."""


@dataclass(frozen=True)
class HandState:
    """State at one reading of all motors, or by :meth:`JointMotors.state` of their joints.

    Arrays have shape [D].
    """

    time_s: float
    """When it was asked for [s]."""
    position: np.ndarray
    """Angles [rad]."""
    velocity: np.ndarray
    """Speeds [rad/s]."""
    current: np.ndarray
    """Currents [A], positive in the direction of the angles."""
    pwm: np.ndarray
    """Duty cycles in [-1, 1], positive in the direction of the angles."""
    voltage: np.ndarray
    """Voltages at the motors [V]."""
    temperature: np.ndarray
    """Temperatures of the motors [deg C]."""
    alert: np.ndarray
    """Whether a motor reports a hardware error."""
    tick: np.ndarray
    """Their own clocks [ms], which start again at 32768."""


@dataclass(frozen=True)
class Answer:
    """A status packet."""

    id: int
    error: int
    """Error number; 0 where the motor did what it was told."""
    alert: bool
    """Whether it reports a hardware error."""
    data: bytes


def read_answer(frame: bytes) -> Answer | None:
    """A status packet whose stuffing the SDK has removed; None if it is not whole.

    The SDK has checked the CRC of what came before it removed the stuffing; length and instruction
    it leaves to us.
    """
    length = int.from_bytes(frame[5:7], "little")
    if len(frame) < 7 + length or length < 4 or frame[7] != STATUS:
        return None
    error = frame[8]
    return Answer(frame[4], error & ~ALERT, bool(error & ALERT), frame[9 : 5 + length])


class StateCheck:
    """Makes states of motors' answers, and refuses those that cannot follow the last one."""

    def __init__(self, ids: Sequence[int], models: Sequence[Model]):
        self._ids = tuple(ids)
        self._items = table(models[0])
        self._current_unit_a = np.array([model.current_unit_a for model in models])
        self.fastest = np.full(len(self._ids), np.inf)
        """Limits of the motors' speeds, as far as they are known [rad/s] [D]."""
        self._last: HandState | None = None

    def forget(self) -> None:
        """The next state follows none: motors were configured, or restarted."""
        self._last = None

    def accept(self, time_s: float, answers: Sequence[Answer]) -> HandState:
        """The state in the motors' answers.

        Args:
            time_s: When it was read [s].
            answers: One of each motor, in their order, of STATE_BYTES or OTHER_BYTES.

        Raises:
            BusError: A state that cannot be.
        """

        def column(name: str) -> np.ndarray:
            item = self._items[name]
            return np.array([item.within(answer.data, STATE_ADDRESS) for answer in answers])

        counts = column("present_position")
        for answer, count in zip(answers, counts, strict=True):
            if abs(count) > FARTHEST_COUNTS:
                raise BusError(
                    f"motor {answer.id}: its position came as {count} counts, beyond reach"
                )
        state = HandState(
            time_s=time_s,
            position=to_angle(counts),
            velocity=column("present_velocity") * RAD_S_PER_COUNT,
            current=column("present_current") * self._current_unit_a,
            pwm=column("present_pwm") / FULL_PWM,
            voltage=0.1 * column("present_input_voltage"),
            temperature=column("present_temperature").astype(float),
            alert=np.array([answer.alert for answer in answers]),
            tick=column("realtime_tick"),
        )
        if self._last is not None:
            self._compare(self._last, state)
        self._last = state
        return state

    def _compare(self, last: HandState, state: HandState) -> None:
        """Refuse a state that cannot follow the last one."""
        elapsed = state.time_s - last.time_s
        span = TICK_MODULUS / 1000.0
        gone = (state.tick - last.tick) / 1000.0
        lateness = (gone - elapsed + 0.5 * span) % span - 0.5 * span
        moved = np.abs(state.position - last.position)
        possible = SPEED_MARGIN * self.fastest * elapsed + JUMP_RAD
        for axis, id in enumerate(self._ids):
            late = lateness[axis]
            if abs(late) > CLOCK_TOLERANCE_S:
                # A motor that restarted is not heard again before configure(): its gains and limits
                # are gone.
                raise BusError(
                    f"motor {id}: its clock differs from ours by {late:.3f} s since the last "
                    "state: that state was an old one; if this goes on, the motor restarted and "
                    "has to be configured"
                )
            if moved[axis] > possible[axis]:
                raise BusError(
                    f"motor {id}: moved {moved[axis]:.2f} rad in {elapsed:.3f} s, which it cannot"
                )
