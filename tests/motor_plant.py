"""What the twin's motors move: anything that follows drives and tells where it is.

SI units, radians; one axis per motor.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vd.assets_usd.objects.model import ObjectModel
from vd.deploy.hardware.joints import JointMotors
from vd.deploy.twin.newton_hand import NewtonHand
from vd.sim.cfg import SimCfg

P_GAIN_UNIT = 200.0
"""The paper's position gain, at which the simple plant has :data:`LAG_S`."""
LAG_S = 0.1
"""Time constant of a D'Claw joint at that gain [s]: its identified damping over stiffness."""
SHORTEST_LAG_S = 0.01
STIFFNESS_NM = 3.0
"""Torque per radian of error at that gain [N m/rad], about what was identified for the D'Claw."""


@dataclass(frozen=True)
class Drive:
    """What one motor does with its axis."""

    goal_rad: float | None
    """Where it drives to; None with its torque off."""
    p_gain: float
    """Position gain in the motor's units."""
    velocity_limit: float
    """Largest speed [rad/s]."""
    torque_limit: float
    """Largest torque [N m]."""


class Plant(Protocol):
    """A mechanism behind the motors."""

    def advance(self, seconds: float, drives: Sequence[Drive]) -> None:
        """Go on by ``seconds`` with one drive for each axis."""

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [rad], velocities [rad/s] and motor torques [N m] of the axes, each of shape [D]."""


class FirstOrderPlant:
    """Axes without mass that approach their goals exponentially, within the limits of torque and speed."""

    def __init__(self, axes: int, position: np.ndarray | None = None):
        """Free, at zero by default."""
        self.position = np.zeros(axes) if position is None else position
        self.blocked = np.zeros(axes, dtype=bool)
        """Axes that something holds, shape [D]."""
        self._velocity, self._torque = np.zeros(axes), np.zeros(axes)

    def advance(self, seconds: float, drives: Sequence[Drive]) -> None:
        """Go on by ``seconds``."""
        for axis, drive in enumerate(drives):
            if drive.goal_rad is None or drive.p_gain <= 0.0:
                self._velocity[axis] = self._torque[axis] = 0.0
                continue
            error = drive.goal_rad - self.position[axis]
            stiffness = STIFFNESS_NM * drive.p_gain / P_GAIN_UNIT
            self._torque[axis] = np.clip(stiffness * error, -drive.torque_limit, drive.torque_limit)
            lag = max(SHORTEST_LAG_S, LAG_S * P_GAIN_UNIT / drive.p_gain)
            pull = self._torque[axis] / stiffness
            step = 0.0 if self.blocked[axis] else pull * -np.expm1(-seconds / lag)
            furthest = drive.velocity_limit * seconds
            step = float(np.clip(step, -furthest, furthest))
            self._velocity[axis] = step / seconds if seconds > 0.0 else 0.0
            self.position[axis] += step

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities and torques, each of shape [D]."""
        return self.position.copy(), self._velocity.copy(), self._torque.copy()


class NewtonPlant(NewtonHand):
    """The hand in Newton behind motors: its axes are theirs, in the joints' order.

    A motor at the position gain of the hand's USD has the hand's stiffness, which grows with the
    gain. In current-based mode its current limits the torque.
    """

    def __init__(
        self, joints: JointMotors, cfg: SimCfg | None = None, item: ObjectModel | None = None
    ):
        self.joints = joints
        super().__init__(joints.hand, cfg, item)

    def advance(self, seconds: float, drives: Sequence[Drive] | None = None) -> None:
        """Go on by ``seconds`` with one drive for each axis."""
        if drives is not None:
            motors = self.joints.motors
            goals = [0.0 if drive.goal_rad is None else drive.goal_rad for drive in drives]
            on = np.array([drive.goal_rad is not None for drive in drives])
            pairs = zip(drives, motors, strict=True)
            shares = np.array([drive.p_gain / motor.p_gain for drive, motor in pairs])
            torques = np.array([drive.torque_limit for drive in drives]) * self.joints.gear
            limited = np.minimum(self.hand.effort, torques)
            effort = np.where(self.joints.capped, limited, self.hand.effort)
            self.drive(self.joints.to_joint(np.array(goals)), on * shares, effort)
        super().advance(seconds)

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [rad], velocities [rad/s] and torques [N m] of the motors."""
        q, qd, torque = super().read()
        sign, gear = self.joints.sign, self.joints.gear
        return self.joints.to_motor(q), sign * gear * qd, sign * torque / gear
