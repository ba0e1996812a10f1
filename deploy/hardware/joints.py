"""Which motor turns which joint, which way round, and from where: the hand's USD and a calibration file.

A motor's angle is ``sign * q + offset`` of its joint's angle q [rad].
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.config import from_dict
from vd.deploy.hardware.answers import HandState
from vd.deploy.hardware.control_table import MODELS, RAD_S_PER_COUNT, to_angle
from vd.deploy.hardware.packets import MAX_ID
from vd.deploy.hardware.registers import MotorSettings

FORMAT = "vd-motors/1"
LARGEST_VELOCITY_LIMIT = 1023
"""Counts that the velocity limit of a motor can hold."""


@dataclass(frozen=True)
class _Motor:
    """An entry of a calibration file."""

    joint: str
    id: int
    sign: float
    offset_rad: float


@dataclass(frozen=True)
class _File:
    """A calibration file."""

    format: str
    motors: tuple[_Motor, ...]
    hand: str = ""


class CalibrationError(ValueError):
    """A calibration that cannot be used; names file, joint and remedy."""


@dataclass(frozen=True)
class Joints:
    """The motors of a hand's joints, in the joints' order."""

    names: tuple[str, ...]
    """Names of the joints [D]."""
    ids: tuple[int, ...]
    """Motor of each joint [D]."""
    sign: np.ndarray
    """1 or -1: which way the motor turns [D]."""
    offset: np.ndarray
    """Angle of the motor where the joint is at zero [rad], shape [D]."""

    def to_motor(self, joint: np.ndarray) -> np.ndarray:
        """Angles of the motors [rad] from those of the joints, shape [..., D]."""
        return self.sign * joint + self.offset

    def to_joint(self, motor: np.ndarray) -> np.ndarray:
        """Angles of the joints [rad] from those of the motors, shape [..., D]."""
        return self.sign * (motor - self.offset)

    def state(self, motors: HandState) -> HandState:
        """A state of the motors, in the joints' frame."""
        return replace(
            motors,
            position=self.to_joint(motors.position),
            velocity=self.sign * motors.velocity,
            current=self.sign * motors.current,
            pwm=self.sign * motors.pwm,
        )

    def settings(self, hand: HandModel, model: str) -> dict[int, MotorSettings]:
        """Limits of every motor: the hand's, as far as the motor has them.

        Raises:
            CalibrationError: A joint's range leaves the motor's one turn.
        """
        motor = MODELS[model]
        ends = np.sort(np.stack([self.to_motor(hand.lower), self.to_motor(hand.upper)]), axis=0)
        first, last, current = to_angle(0), to_angle(4095), motor.current_of(hand.effort)
        result = {}
        for axis, id in enumerate(self.ids):
            low, high = float(ends[0, axis]), float(ends[1, axis])
            if low < first or high > last:
                raise CalibrationError(
                    f"{self.names[axis]}, motor {id}: its range is {low:.2f} to {high:.2f} rad of the motor, "
                    f"which turns from {first:.2f} to {last:.2f}; mount it nearer its middle, or mend offset"
                )
            result[id] = MotorSettings(
                current_limit_a=float(current[axis]),
                velocity_limit_rad_s=min(
                    float(hand.velocity_limit[axis]), LARGEST_VELOCITY_LIMIT * RAD_S_PER_COUNT
                ),
                lower_rad=low,
                upper_rad=high,
            )
        return result


def uncalibrated(hand: HandModel) -> Joints:
    """Motors as they are numbered on ROBEL's D'Claw (10, 11, 12, 20, ...), zero in their middle."""
    count = len(hand.joint_names)
    ids = tuple(10 * (axis // 3 + 1) + axis % 3 for axis in range(count))
    return Joints(tuple(hand.joint_names), ids, np.ones(count), np.zeros(count))


def read_joints(path: Path, hand: HandModel) -> Joints:
    """Read a calibration file.

    Raises:
        CalibrationError: It cannot be read, is no calibration, or not one of this hand.
    """
    try:
        motors = _by_joint(from_dict(_File, json.loads(Path(path).read_text()), where="the file"), hand)
    except OSError as error:
        raise CalibrationError(
            f"--calibration {path}: {error.strerror}; give a file with an entry for each joint of "
            f"{hand.name}, or leave it out where IDs, zeros and directions are the default"
        ) from error
    except (TypeError, ValueError) as error:  # of JSON, text and fields too
        raise CalibrationError(f"{path} is not a calibration of {hand.name}: {error}") from error
    ids = [motor.id for motor in motors]
    sign = np.array([motor.sign for motor in motors])
    return Joints(tuple(hand.joint_names), tuple(ids), sign, np.array([motor.offset_rad for motor in motors]))


def _by_joint(file: _File, hand: HandModel) -> list[_Motor]:
    """The entries of a file in the order of a hand's joints.

    Raises:
        ValueError: Its format is another, or its entries are not one for each joint.
    """
    if file.format != FORMAT:
        raise ValueError(f"its format is {file.format!r}, not {FORMAT!r}")
    named, ids = ([getattr(motor, name) for motor in file.motors] for name in ("joint", "id"))
    for name in hand.joint_names:
        if named.count(name) != 1:
            raise ValueError(f"motors has {named.count(name) or 'no'} entries of {name}; give one")
    if extra := sorted(set(named) - set(hand.joint_names)):
        raise ValueError(f"{extra[0]} is no joint of {hand.name}")
    if len(set(ids)) != len(ids) or not all(0 <= id <= MAX_ID for id in ids):
        raise ValueError(f"motors.id are {ids}; give each motor its own, within 0 and {MAX_ID}")
    for motor in file.motors:
        if motor.sign not in (-1.0, 1.0):
            raise ValueError(f"motors.sign of {motor.joint} is {motor.sign:g}; it is 1, or -1")
        if not np.isfinite(motor.offset_rad):
            raise ValueError(f"motors.offset_rad of {motor.joint} is {motor.offset_rad}; give an angle [rad]")
    return [file.motors[named.index(name)] for name in hand.joint_names]
