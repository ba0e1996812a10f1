"""What a policy was made for, in words and numbers, and whether a hand is that.

A contract's ``interface`` follows from the policy's training and a hand's USD alone, so that a check derives
it again from the hand at hand and compares field by field. SI units, radians; quaternions are xyzw.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from vd.assets_usd.hand_data import BASE_IN_WORLD, HandModel
from vd.config import from_dict, to_dict
from vd.envs.cfg import ReorientCfg
from vd.kernels.task.observations import teacher_observation_slices
from vd.kernels.task.shapes import shape_observation_size
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.stopping import StoppingRule, StoppingRules

BUNDLE_FORMAT = "visual-dexterity bundle 1"
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-4, 1e-5
"""Differences of numbers that are no difference: a hand that was measured again differs by more."""

Kind = Literal["teacher", "tracking", "vision"]


class ContractError(ValueError):
    """A bundle that does not fit the hand or this version; names field, found, expected and remedy."""


@dataclass(frozen=True)
class Conventions:
    """How numbers are to be read."""

    units: str = "m, rad, s, kg, N"
    quaternion: str = "xyzw"
    pose: str = "position x y z, then quaternion"
    base_frame: str = "the hand's base link, +z in the direction of the fingers"
    world_frame: str = "z up, table top at z = 0"
    optical_frame: str = "x right, y down, z forward"


@dataclass(frozen=True)
class HandPart:
    """The hand it moves."""

    name: str
    """Root prim of its USD."""
    joint_names: tuple[str, ...]
    """Order of joint positions and actions, D names."""
    lower_rad: tuple[float, ...]
    """Lower joint limits [D]."""
    upper_rad: tuple[float, ...]
    """Upper joint limits [D]."""
    base_in_world: tuple[float, ...]
    """Pose of the base frame in the world frame [7]."""


@dataclass(frozen=True)
class ActionPart:
    """From the network's output to joint targets.

    smoothed = ema_alpha clip(action, -1, 1) + (1 - ema_alpha) smoothed, zero at the start;
    target = clamp(q + smoothed scale_rad_s / control_hz, lower, upper), q as measured.
    """

    control_hz: float
    ema_alpha: float
    scale_rad_s: float
    clip: tuple[float, float] = (-1.0, 1.0)


@dataclass(frozen=True)
class ObservationPart:
    """The vector that a teacher's layers see; tracking and vision policies make it of joints and camera."""

    parts: dict[str, tuple[int, int]]
    """First column and the one after the last of each part."""
    velocity_scale: float = PAPER.observation.velocity_scale
    """Factor on joint velocities and the object's angular velocity."""
    view: str = "world"
    """Frame of observation and action: the world's, or goal: the turn of the hand that the goal asks for."""
    file_axes: bool = True
    """Whether orientations of object and goal are shown in the axes of the object's file; else zeros are."""


@dataclass(frozen=True)
class CameraPart:
    """The depth camera behind a policy that sees by one."""

    source: str
    """hand: the camera of the hand's USD; policy: one that the training placed elsewhere."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    """Intrinsics [pixel]."""
    pose_in_base: tuple[float, ...]
    """Optical frame in the base frame [7]."""
    points: int
    """Points of a cloud at most."""
    crop_m: tuple[float, float]
    """World heights that are kept [m]."""


@dataclass(frozen=True)
class Interface:
    """All that hand and policy have to agree on."""

    RETIRED: ClassVar[dict[str, Any]] = {"cloud": None}
    conventions: Conventions
    hand: HandPart
    action: ActionPart
    observation: ObservationPart
    camera: CameraPart | None = None


@dataclass(frozen=True)
class StoppingPart:
    """When a policy that sees clouds stops: predicted distance and norm of the smoothed action are below."""

    distance_rad: float
    action_norm: float
    calibrated_on: str
    """Objects and episodes; empty: the paper's bounds."""
    precise: tuple[float, float] | None = None
    """The same two to stop within 0.1 rad; None: not calibrated."""
    tolerance_rad: float = PAPER.success.rotation_rad
    """Tolerance that the first two are for [rad]."""

    @classmethod
    def of(cls, rules: StoppingRules) -> "StoppingPart":
        """The rules of a policy."""
        stop, precise = rules.stopping, rules.precise
        return cls(
            stop.distance_rad,
            stop.action_norm,
            rules.calibrated_on,
            None if precise is None else (precise.distance_rad, precise.action_norm),
            rules.tolerance_rad,
        )

    def rules(self) -> dict[str, Any]:
        """The fields of :class:`vd.stopping.StoppingRules`."""
        return {
            "stopping": StoppingRule(self.distance_rad, self.action_norm),
            "tolerance_rad": self.tolerance_rad,
            "precise": None if self.precise is None else StoppingRule(*self.precise),
            "calibrated_on": self.calibrated_on,
        }


@dataclass(frozen=True)
class Provenance:
    """Where a policy comes from."""

    RETIRED: ClassVar[dict[str, Any]] = {"stage": None}
    teacher: str
    """Whose layers act by what a camera shows; empty for a teacher."""
    objects: tuple[str, ...]
    """Names of the object sets it was trained on."""
    iterations: int
    env_steps: int
    task: dict[str, Any]
    """Configuration of the environment of its training."""
    depth: dict[str, Any] = field(default_factory=dict)
    """Configuration of the depth camera of its training."""


@dataclass(frozen=True)
class Contract:
    """The whole of contract.json."""

    kind: Kind
    interface: Interface
    network: dict[str, Any]
    """What rebuilds the network: PolicySpec; of a tracking or vision policy as ``policy``, and of a vision
    policy AlignmentCfg beside it, as ``alignment``."""
    stopping: StoppingPart | None
    provenance: Provenance
    software: dict[str, str]
    """Versions with which it was written."""
    files: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the other files of the bundle, by name."""
    format: str = BUNDLE_FORMAT

    @property
    def task(self) -> ReorientCfg:
        """The environment of the training."""
        return from_dict(ReorientCfg, self.provenance.task, where="provenance.task")

    @property
    def own_camera(self) -> tuple[float, ...] | None:
        """Where the training put the camera, optical frame in the base frame [7]; None: the hand's own."""
        camera = self.interface.camera
        return camera.pose_in_base if camera is not None and camera.source == "policy" else None


def derive_interface(
    hand: HandModel,
    source: Provenance,
    camera: tuple[float, ...] | None = None,
) -> Interface:
    """What a policy of such a training and this hand have to agree on.

    Args:
        hand: The hand.
        source: Where it comes from; ``depth`` is empty for one that sees by no camera.
        camera: Where the training put that, optical frame in the base frame [7]; None: the hand's own.

    Raises:
        ContractError: A robot's loop cannot give what it observes.
    """
    task = from_dict(ReorientCfg, source.task, where="provenance.task")
    depth = from_dict(DepthCameraCfg, source.depth, where="provenance.depth") if source.depth else None
    return Interface(
        conventions=Conventions(),
        hand=HandPart(
            name=hand.name,
            joint_names=hand.joint_names,
            lower_rad=_floats(hand.lower),
            upper_rad=_floats(hand.upper),
            base_in_world=_floats(BASE_IN_WORLD),
        ),
        action=ActionPart(task.sim.control_hz, task.action.ema_alpha, task.action.scale_rad_s),
        observation=_observation(hand, task),
        camera=None if depth is None else _camera(hand, depth, camera),
    )


def _observation(hand: HandModel, task: ReorientCfg) -> ObservationPart:
    seen = task.observation
    slices = teacher_observation_slices(hand.num_fingers)
    parts = {name: (part.start, part.stop) for name, part in slices.items()}
    if seen.shape != "none":
        end = slices["previous_action"].stop
        parts["shape"] = (end, end + shape_observation_size(hand.num_fingers))
    return ObservationPart(parts, view=seen.view, file_axes=seen.file_axes)


def _camera(hand: HandModel, depth: DepthCameraCfg, pose: tuple[float, ...] | None) -> CameraPart:
    camera = hand.camera.at(pose)
    return CameraPart(
        source="hand" if pose is None else "policy",
        pose_in_base=_floats([*camera.position, *camera.quaternion]),
        points=depth.points,
        crop_m=depth.crop_m,
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
    )


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


_REMEDY = {
    "conventions": "export the policy again with this version",
    "hand": "use the hand it was trained for, or train a policy for this one",
    "action": "export the policy again; its contract was changed after the export",
    "observation": "export the policy again with this version",
    "camera": "use the camera it was made for, or write it for this one (vd-train, --camera)",
}
"""What to do about a difference in each part of the interface."""


def check_hand(contract: Contract, hand: HandModel, where: str | Path) -> None:
    """Refuse a hand that is not the one of the contract.

    Args:
        contract: Of the bundle.
        hand: The hand to move.
        where: The bundle, for the message.

    Raises:
        ContractError: The first field that differs, what the hand has, what the bundle wants, what to do.
    """
    found = derive_interface(hand, contract.provenance, contract.own_camera)
    for name, have, want in _differences(to_dict(found), to_dict(contract.interface)):
        part = name.split(".")[0]
        raise ContractError(
            f"{where} does not fit the hand {hand.name} ({hand.path}): {name} is {_short(have)} here, but "
            f"{_short(want)} in the bundle; {_REMEDY[part]}"
        )


def _differences(found: Any, wanted: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Fields in which two trees of plain values differ: name, found, wanted."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in dict.fromkeys((*wanted, *found)):
            below = f"{name}.{key}" if name else str(key)
            yield from _differences(found.get(key), wanted.get(key), below)
    elif isinstance(found, list) and isinstance(wanted, list):
        if len(found) != len(wanted):
            yield f"{name} (their number)", len(found), len(wanted)
            return
        for index, (one, other) in enumerate(zip(found, wanted, strict=True)):
            yield from _differences(one, other, f"{name}[{index}]")
    elif isinstance(found, float) and isinstance(wanted, float):
        if not math.isclose(found, wanted, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE):
            yield name, found, wanted
    elif found != wanted:
        yield name, found, wanted


def _short(value: Any) -> str:
    """A value for a message."""
    if value is None:
        return "missing"
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{len(value)} fields" if isinstance(value, dict) else repr(value)
