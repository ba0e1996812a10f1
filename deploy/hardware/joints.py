"""Which motor turns which joint, which way round, and from where.

A hand's USD, and a calibration over it.

A motor's angle is ``sign * gear * q + offset`` of its joint's angle q [rad].
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vd.assets_usd.hand_data import HandModel, MotorModel
from vd.command.config import from_dict
from vd.deploy.hardware.answers import HandState
from vd.deploy.hardware.control_table import MAX_ID, RAD_S_PER_COUNT, Model, motor_model, to_angle
from vd.deploy.hardware.registers import MotorSettings

FORMAT = "vd-motors/1"


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
    hand: str
    motors: tuple[_Motor, ...]


class CalibrationError(ValueError):
    """Motors that cannot be used; names file or hand, joint and remedy."""


class JointMotors:
    """The motors of a hand's joints, in the joints' order.

    Raises:
        CalibrationError: A motor is of no known model, or cannot be driven as it is to be.
    """

    def __init__(self, hand: HandModel, motors: tuple[MotorModel, ...]):
        self.hand = hand
        self.names = hand.joint_names
        self.motors = motors
        self.ids = tuple(motor.id for motor in motors)
        """Motor of each joint [D]."""
        self.sign = np.array([motor.sign for motor in motors])
        """1 or -1: which way the motor turns [D]."""
        self.gear = np.array([motor.gear for motor in motors])
        """Turns of the motor for one of the joint [D]."""
        self.offset = np.array([motor.offset_rad for motor in motors])
        """Angle of the motor where the joint is at zero [rad], shape [D]."""
        self.capped = np.array([motor.current > 0.0 for motor in motors])
        """Whether its mode keeps the motor below its largest current [D]."""
        self.models: list[Model] = []
        """Model of each motor [D]."""
        for name, motor in zip(self.names, motors, strict=True):
            try:
                model = motor_model(motor.model)
            except ValueError as error:
                raise CalibrationError(f"{hand.name}: {error}") from error
            if motor.current > 0.0 and not model.senses_current:
                raise CalibrationError(
                    f"{hand.name}: {name} has a largest current, which {model.name} does not "
                    "measure; take vd:motor:current away"
                )
            self.models.append(model)

    def to_motor(self, joint: np.ndarray) -> np.ndarray:
        """Angles of the motors [rad] from those of the joints, shape [..., D]."""
        return self.sign * self.gear * joint + self.offset

    def to_joint(self, motor: np.ndarray) -> np.ndarray:
        """Angles of the joints [rad] from those of the motors, shape [..., D]."""
        return self.sign * (motor - self.offset) / self.gear

    def state(self, motors: HandState) -> HandState:
        """A state of the motors, in the joints' frame; currents stay the motors' own."""
        return replace(
            motors,
            position=self.to_joint(motors.position),
            velocity=self.sign * motors.velocity / self.gear,
            current=self.sign * motors.current,
            pwm=self.sign * motors.pwm,
        )

    def currents(self) -> np.ndarray:
        """Largest current of each motor [A] [D].

        What it is said to have, or needs for its joint's torque.
        """
        currents = np.zeros(len(self.motors))
        for axis, (motor, model) in enumerate(zip(self.motors, self.models, strict=True)):
            needed = model.current_of(self.hand.effort[axis] / motor.gear)
            currents[axis] = motor.current if motor.current > 0.0 else needed
        return currents

    @property
    def p_gain(self) -> int:
        """Position gain of a recording: the largest of the motors."""
        return max(motor.p_gain for motor in self.motors)

    def servo(self) -> dict[str, str | int]:
        """What a log says of the motors."""
        models = ", ".join(dict.fromkeys(model.name for model in self.models))
        return {
            "model": models,
            "p_gain": self.p_gain,
            "d_gain": max(motor.d_gain for motor in self.motors),
        }

    def settings(self) -> dict[int, MotorSettings]:
        """Limits and gains of every motor, by ID: the hand's, as far as the motor has them.

        Raises:
            CalibrationError: A joint's range leaves the motor's one turn.
        """
        ends = np.sort(
            np.stack([self.to_motor(self.hand.lower), self.to_motor(self.hand.upper)]), axis=0
        )
        first = to_angle(0)
        last = to_angle(4095)
        currents = self.currents()
        result = {}
        for axis, (motor, model) in enumerate(zip(self.motors, self.models, strict=True)):
            low = float(ends[0, axis])
            high = float(ends[1, axis])
            if low < first or high > last:
                raise CalibrationError(
                    f"{self.names[axis]}, motor {motor.id}: its range is {low:.2f} to {high:.2f} "
                    f"rad of the motor, which turns from {first:.2f} to {last:.2f}; mount it "
                    "nearer its middle, or mend its offset"
                )
            fastest = float(self.hand.velocity_limit[axis]) * motor.gear
            result[motor.id] = MotorSettings(
                current_limit_a=float(currents[axis]),
                velocity_limit_rad_s=min(fastest, model.velocity_most * RAD_S_PER_COUNT),
                lower_rad=low,
                upper_rad=high,
                p_gain=motor.p_gain,
                d_gain=motor.d_gain,
                current_based=motor.current > 0.0,
            )
        return result


def read_joints(hand: HandModel, calibration: Path | None = None) -> JointMotors:
    """The motors of a hand.

    Args:
        hand: The hand, whose USD says which motors it has.
        calibration: File with their IDs, directions and zeros, which count before the USD's.

    Raises:
        CalibrationError: A joint has no motor, or the calibration is none, or not one of this hand.
    """
    entries: dict[str, _Motor] = {}
    if calibration is not None:
        entries = _read_calibration(Path(calibration), hand)
    motors = []
    for name, leader, described in zip(hand.joint_names, hand.mimic, hand.motors, strict=True):
        entry = entries.get(name)
        if leader >= 0:
            raise CalibrationError(
                f"{hand.name}: {name} follows another joint; each needs a motor here"
            )
        if described is None:
            raise CalibrationError(
                f"{hand.path} does not say which motor turns {name}: describe motors when it is "
                "imported (vd:motor)"
            )
        motor = described
        if entry is not None:
            motor = replace(motor, id=entry.id, sign=entry.sign, offset_rad=entry.offset_rad)
        motors.append(motor)
    return JointMotors(hand, tuple(motors))


def _read_calibration(path: Path, hand: HandModel) -> dict[str, _Motor]:
    """The entries of a calibration file, by joint."""
    try:
        return _by_joint(from_dict(_File, json.loads(path.read_text()), where="the file"), hand)
    except OSError as error:
        raise CalibrationError(
            f"--calibration {path}: {error.strerror}; give a file with an entry for each joint of "
            f"{hand.name}, or leave it out where IDs, zeros and directions are those of the hand's "
            f"USD"
        ) from error
    except (TypeError, ValueError) as error:  # of JSON, text and fields too
        raise CalibrationError(f"{path} is not a calibration of {hand.name}: {error}") from error


def _by_joint(file: _File, hand: HandModel) -> dict[str, _Motor]:
    """The entries of a file by joint.

    Raises:
        ValueError: Its format or hand is another, or its entries are not one for each joint.
    """
    if file.format != FORMAT:
        raise ValueError(f"its format is {file.format!r}, not {FORMAT!r}")
    if file.hand != hand.name:
        raise ValueError(
            f"its field hand names {file.hand!r}: zeros and directions of another hand's motors "
            f"are not this one's; calibrate {hand.name}"
        )
    named = [motor.joint for motor in file.motors]
    ids = [motor.id for motor in file.motors]
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
            raise ValueError(
                f"motors.offset_rad of {motor.joint} is {motor.offset_rad}; give an angle [rad]"
            )
    return {motor.joint: motor for motor in file.motors}
