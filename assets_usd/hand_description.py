"""What a hand's USD says of it beside its bodies.

Mount, palm, workspace, start, mimic joints and motors.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Usd

from vd.assets_usd.hand_data import HandError, MotorModel, Workspace

GAINS: dict[str, type] = {"p_gain": int, "d_gain": int, "current": float}
"""What a file need not say of a motor."""
ROUNDING_RAD = 1e-5
"""How far a start may be beyond a limit: limits are degrees in single precision."""


class Described:
    """The prims of one hand's file, and their attributes.

    Every method raises :class:`HandError`.
    """

    def __init__(self, path: Path, stage: Usd.Stage, layer: Path | None):
        self.path, self.stage, self.layer = path, stage, layer
        self.root = stage.GetDefaultPrim()

    def fail(self, where: Any, what: str, remedy: str) -> HandError:
        """The error to raise for a prim or a path."""
        prim = where.GetPath() if isinstance(where, Usd.Prim) else where
        file = f"{self.path} with the layer {self.layer}" if self.layer else str(self.path)
        return HandError(f"{file}: {prim}: {what}; {remedy}")

    def prim(self, relative: str) -> Usd.Prim:
        """The prim at a path below the root."""
        path = self.root.GetPath().AppendPath(relative)
        prim = self.stage.GetPrimAtPath(path)
        if not prim:
            raise self.fail(path, "the prim is missing", "add it, or export the hand again")
        return prim

    def value(self, prim: Usd.Prim, attribute: str) -> Any:
        """The value of an attribute, which must have been authored."""
        found = prim.GetAttribute(attribute)
        if not found or not found.HasAuthoredValue():
            raise self.fail(prim, f"'{attribute}' is not authored", "give it a value")
        return found.Get()

    def number(self, prim: Usd.Prim, attribute: str, *, positive: bool = False) -> float:
        """The value of a scalar attribute: finite, and above zero where that is asked for."""
        number = float(self.value(prim, attribute))
        if not math.isfinite(number) or (positive and number <= 0.0):
            wanted = "positive" if positive else "finite"
            raise self.fail(prim, f"'{attribute}' is {number}", f"it must be {wanted}")
        return number

    def mount(self) -> np.ndarray:
        """Pose of the base in the world [7]."""
        place = self._vector("vd:mount:position")
        return np.concatenate([place, xyzw(self.value(self.root, "vd:mount:orientation"))])

    def _vector(self, attribute: str, size: int = 3) -> np.ndarray:
        """A vector of the root [size], finite."""
        vector = np.array(self.value(self.root, attribute), dtype=float)
        if vector.shape != (size,) or not np.isfinite(vector).all():
            raise self.fail(self.root, f"'{attribute}' is {vector}", f"{size} finite numbers")
        return vector

    def direction(self, attribute: str) -> np.ndarray:
        """A unit vector of the root [3]."""
        vector = self._vector(attribute)
        if not np.linalg.norm(vector) > 0.0:
            raise self.fail(self.root, f"'{attribute}' is {vector}", "give it a direction")
        return np.asarray(vector / np.linalg.norm(vector))

    def workspace(self) -> Workspace:
        """Where objects are handled."""
        low, high = self._vector("vd:workspace:size", 2)
        if not 0.0 < low <= high:
            raise self.fail(
                self.root, f"'vd:workspace:size' is ({low}, {high})", "smallest first, above 0"
            )
        return Workspace(
            drop_m=tuple(self._vector("vd:workspace:drop").tolist()),
            goal_m=tuple(self._vector("vd:workspace:goal").tolist()),
            fall_m=self.number(self.root, "vd:workspace:fall", positive=True),
            size_m=(float(low), float(high)),
        )

    def start(self, joints: list[Usd.Prim], drives: np.ndarray) -> np.ndarray:
        """Angles at the start [D] [rad]; they are within the limits."""
        start = np.array([self.number(joint, "vd:start") for joint in joints])
        for joint, angle, (low, high) in zip(joints, start, drives[:, :2], strict=True):
            if not low - ROUNDING_RAD <= angle <= high + ROUNDING_RAD:
                raise self.fail(
                    joint,
                    f"'vd:start' is {angle:g} rad",
                    f"choose one within its limits, {low:.3f} and {high:.3f} rad",
                )
        return start

    def mimic(self, joint: Usd.Prim, joints: list[Usd.Prim]) -> tuple[int, float, float]:
        """The joint that a joint follows, or -1, with factor and offset [rad]."""
        targets = joint.GetRelationship("newton:mimicJoint").GetTargets()
        if not targets:
            return -1, 1.0, 0.0
        paths = [other.GetPath() for other in joints]
        if len(targets) != 1 or targets[0] not in paths:
            named = [str(target) for target in targets]
            raise self.fail(
                joint, f"'newton:mimicJoint' is {named}", "point it at one joint of the hand"
            )
        factor = self.number(joint, "newton:mimicCoef1")
        return (
            paths.index(targets[0]),
            factor,
            math.radians(self.number(joint, "newton:mimicCoef0")),
        )

    def check_mimic(self, joints: list[Usd.Prim], leaders: list[int]) -> None:
        """Refuse a joint that follows one which follows another."""
        for joint, leader in zip(joints, leaders, strict=True):
            if leader >= 0 and leaders[leader] >= 0:
                name = joints[leader].GetName()
                raise self.fail(joint, f"follows {name}, which follows another", "follow that one")

    def motors(self, joints: list[Usd.Prim]) -> tuple[MotorModel | None, ...]:
        """The motor of each joint that says which it has; no two have one ID."""
        motors: list[MotorModel | None] = []
        for joint in joints:
            if not joint.GetAuthoredPropertiesInNamespace("vd:motor"):
                motors.append(None)
                continue
            said = {
                n: k
                for n, k in GAINS.items()
                if joint.GetAttribute(f"vd:motor:{n}").HasAuthoredValue()
            }
            motor = MotorModel(
                model=str(self.value(joint, "vd:motor:model")),
                id=int(self.value(joint, "vd:motor:id")),
                sign=self.number(joint, "vd:motor:sign"),
                offset_rad=self.number(joint, "vd:motor:offset"),
                gear=self.number(joint, "vd:motor:gear", positive=True),
                **{
                    name: kind(self.number(joint, f"vd:motor:{name}"))
                    for name, kind in said.items()
                },
            )
            if abs(motor.sign) != 1.0:
                raise self.fail(joint, f"'vd:motor:sign' is {motor.sign:g}", "it is 1, or -1")
            if motor.id in [other.id for other in motors if other]:
                raise self.fail(
                    joint, f"'vd:motor:id' {motor.id} is another joint's too", "change one"
                )
            motors.append(motor)
        return tuple(motors)


def xyzw(quaternion: Gf.Quatf) -> np.ndarray:
    """A USD quaternion as a unit quaternion xyzw [4], in double precision."""
    components = np.array([*quaternion.GetImaginary(), quaternion.GetReal()], dtype=float)
    return np.asarray(components / np.linalg.norm(components))
