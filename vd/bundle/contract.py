"""What a policy was made for, in words and numbers, and whether a hand is that.

A contract's ``interface`` follows from the policy's training and a hand's USD alone, so that a
check derives it again from the hand at hand and compares field by field. SI units, radians;
quaternions are xyzw.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from vd.assets_usd.hand_data import HandModel
from vd.config import from_dict, leaves, to_dict
from vd.envs.cfg import ReorientCfg
from vd.kernels.task.observations import teacher_observation_slices
from vd.kernels.task.shapes import shape_observation_size
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.stopping import StoppingRules

BUNDLE_FORMAT = "visual-dexterity bundle 1"
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-4, 1e-5
"""Differences of numbers that are no difference: a hand that was measured again differs by more."""
CONVENTIONS = {
    "units": "m, rad, s, kg, N",
    "quaternion": "xyzw",
    "pose": "position x y z, then quaternion",
    "base_frame": "the hand's base link, +z in the direction of the fingers",
    "world_frame": "z up, table top at z = 0",
    "optical_frame": "x right, y down, z forward",
}
"""How numbers are to be read."""
BEFORE: dict[str, dict[str, Any]] = {
    "observation": {"view": "world", "file_axes": True},
}
"""By part of the interface the fields that bundles of earlier versions lack, with what is so
there.
"""
Kind = Literal["teacher", "tracking", "vision"]


class ContractError(ValueError):
    """A bundle that does not fit the hand or this version.

    Names field, found, expected and remedy.
    """


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
    interface: dict[str, Any]
    """As :func:`derive_interface` gives it."""
    network: dict[str, Any]
    """What rebuilds the network: PolicySpec; of a tracking or vision policy as ``policy``, and of a
    vision policy AlignmentCfg beside it, as ``alignment``."""
    stopping: StoppingRules | None
    """When a policy that sees clouds stops."""
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
        """Where the training put the camera, optical frame in the base frame [7].

        None: the hand's own.
        """
        camera = self.interface.get("camera")
        return tuple(camera["pose_in_base"]) if camera and camera["source"] == "policy" else None


def derive_interface(
    hand: HandModel, source: Provenance, camera: tuple[float, ...] | None = None
) -> dict[str, Any]:
    """What a policy of such a training and this hand have to agree on, as JSON has it, by part.

    Args:
        hand: The hand.
        source: Where it comes from; ``depth`` is empty for one that sees by no camera.
        camera: Where the training put that, optical frame in the base frame [7]; None: the hand's
            own.
    """
    task = from_dict(ReorientCfg, source.task, where="provenance.task")
    depth = (
        from_dict(DepthCameraCfg, source.depth, where="provenance.depth") if source.depth else None
    )
    parts = {
        "conventions": CONVENTIONS,
        "hand": _hand(hand),
        # smoothed = ema_alpha clip(action) + (1 - ema_alpha) smoothed, zero at the start;
        # target = clamp(q + smoothed scale_rad_s / control_hz, lower, upper), q as measured.
        "action": {
            "control_hz": task.sim.control_hz,
            "ema_alpha": task.action.ema_alpha,
            "scale_rad_s": task.action.scale_rad_s,
            "clip": (-1.0, 1.0),
        },
        "observation": _observation(hand, task),
        "camera": None if depth is None else _camera(hand, depth, camera),
    }
    found: dict[str, Any] = to_dict(parts)
    return found


def _hand(hand: HandModel) -> dict[str, Any]:
    """The hand as a bundle's interface has it."""
    return {
        "name": hand.name,  # of the root prim of its USD
        "joint_names": hand.joint_names,  # in the order of joint positions and actions
        "lower_rad": _floats(hand.lower),
        "upper_rad": _floats(hand.upper),
        "base_in_world": _floats(hand.mount),
    }


def trained_hand(hand: HandModel) -> dict[str, Any]:
    """What a policy's file says of the hand of its training, as JSON has it.

    Args:
        hand: The hand without a layer, whose servo model was identified later.
    """
    own = {
        "effort_nm": _floats(hand.effort),
        "drop_m": _floats(hand.workspace.drop_m),
        "tips_in_base": [_floats(tip[:3]) for tip in hand.tip_poses(hand.start)],
    }
    found: dict[str, Any] = to_dict(_hand(hand) | own)
    return found


def _observation(hand: HandModel, task: ReorientCfg) -> dict[str, Any]:
    """The vector that a teacher's layers see.

    Tracking and vision policies make it of joints and camera.
    """
    seen = task.observation
    slices = teacher_observation_slices(hand.num_fingers, hand.num_joints)
    parts = {name: (part.start, part.stop) for name, part in slices.items()}
    if seen.shape != "none":
        end = slices["previous_action"].stop
        parts["shape"] = (end, end + shape_observation_size(hand.num_fingers))
    if seen.terms:
        end = max(last for _, last in parts.values())
        parts["terms"] = (end, end + sum(seen.terms.values()))
    return {
        "parts": parts,  # first column and the one after the last
        "velocity_scale": PAPER.observation.velocity_scale,  # of joints, and of the object's turning
        "view": seen.view,
        "file_axes": seen.file_axes,
    }


def _camera(
    hand: HandModel, depth: DepthCameraCfg, pose: tuple[float, ...] | None
) -> dict[str, Any]:
    """The depth camera: the one of the hand's USD, or one that the training placed elsewhere."""
    camera = hand.camera.at(pose)
    return {
        "source": "hand" if pose is None else "policy",
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "pose_in_base": _floats([*camera.position, *camera.quaternion]),
        "points": depth.points,  # of a cloud at most
        "crop_m": depth.crop_m,  # world heights that are kept
    }


def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]


_REMEDY = {
    "conventions": "export the policy again with this version",
    "hand": "use the hand it was trained for (if imported, import it again), or train a policy for this one",
    "action": "export the policy again; its contract was changed after the export",
    "observation": "export the policy again with this version",
    "camera": "use the camera it was made for, or write it for this one (vd-train, --camera)",
}
"""What to do about a difference in each part of the interface."""


def check_hand(contract: Contract, hand: HandModel, where: str | Path) -> None:
    """Refuse a hand that is not the one of the contract of the bundle at ``where``.

    Raises:
        ContractError: The first field that differs, what the hand has, what the bundle wants, what
            to do.
    """
    found = derive_interface(hand, contract.provenance, contract.own_camera)
    wanted = {
        part: values and BEFORE.get(part, {}) | values
        for part, values in contract.interface.items()
        if part != "cloud"  # none, in bundles of earlier versions
    }
    _check_same(found, wanted, hand, where, "in the bundle")


def check_trained_hand(wanted: dict[str, Any], hand: HandModel, where: str | Path) -> None:
    """Refuse a hand that is called like the one of a policy's training, and is another one.

    Args:
        wanted: What the policy's file says (:func:`trained_hand`).
        hand: The hand without a layer.
        where: The policy.

    Raises:
        ContractError: The first field that differs, what the hand has, what the policy wants, what
            to do.
    """
    if wanted and wanted["name"] == hand.name:
        _check_same({"hand": trained_hand(hand)}, {"hand": wanted}, hand, where, "in its training")


def _check_same(
    found: dict[str, Any], wanted: dict[str, Any], hand: HandModel, where: str | Path, said: str
) -> None:
    """Refuse the first field of ``wanted``, which is ``said``, that is another one in ``found``."""
    have, want = dict(leaves(found)), dict(leaves(wanted))
    for name in dict.fromkeys((*want, *have)):
        here, there = have.get(name), want.get(name)
        if not _same(here, there):
            raise ContractError(
                f"{where} does not fit the hand {hand.name} ({hand.path}): {name} is "
                f"{_short(here)} here, "
                f"but {_short(there)} {said}; {_REMEDY[name.split('.')[0]]}"
            )


def _same(found: Any, wanted: Any) -> bool:
    """Whether two plain values are equal, numbers but for rounding."""
    if isinstance(found, float) and isinstance(wanted, float):
        return math.isclose(found, wanted, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE)
    return bool(found == wanted)


def _short(value: Any) -> str:
    """A value for a message."""
    if value is None:
        return "missing"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)
