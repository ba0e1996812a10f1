"""What a policy is and what it was made for, and whether a hand is that.

A contract's ``interface`` follows from the policy's training and a hand's USD alone, so that a
check derives it again from the hand at hand and compares field by field. SI units, radians;
quaternions are xyzw. Nothing here needs torch.
"""

import hashlib
import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from vd.assets_usd.hand_data import HandModel
from vd.command.config import from_dict, leaves, to_dict
from vd.envs.cfg import ReorientCfg
from vd.paper import PAPER
from vd.policy.stopping import StoppingRules
from vd.sensors.cfg import DepthCameraCfg
from vd.vision.cfg import AlignmentCfg, StudentCfg

POLICY_FORMAT = "visual-dexterity policy 1"
CONTRACT_KEY = "contract"
"""Key of the contract, in JSON, among the metadata of a policy's file."""
SEAL_KEY = "seal"
"""Name of what stands last in a policy's file."""
UNSEALED = b"-" * 64
"""What it is before the file is sealed."""
# Differences of numbers that are no difference: a hand that was measured again differs by more.
RELATIVE_TOLERANCE = 1e-4
ABSOLUTE_TOLERANCE = 1e-5
CONVENTIONS = {
    "units": "m, rad, s, kg, N",
    "quaternion": "xyzw",
    "pose": "position x y z, then quaternion",
    "base_frame": "the hand's base link, +z in the direction of the fingers",
    "world_frame": "z up, table top at z = 0",
    "optical_frame": "x right, y down, z forward",
}
"""How numbers are to be read."""
Kind = Literal["teacher", "vision", "student"]


class ContractError(ValueError):
    """A policy that is damaged, or does not fit the hand or this version.

    Names field, found, expected and remedy.
    """


@dataclass(frozen=True)
class PolicySpec:
    """What is needed to rebuild an actor around its weights: O observations, D actions."""

    num_observations: int
    num_actions: int
    hidden: tuple[int, ...]
    """Widths of the hidden layers."""
    distribution: str
    """``gaussian``, the network gives the mean, or ``state-dependent``: mean, then std."""
    normalise_observations: bool
    """Whether a running normalisation belongs to the actor."""


@dataclass(frozen=True, kw_only=True)
class CameraSpec(StoppingRules):
    """How a policy sees by a camera, and when it stops."""

    teacher: str = ""
    """Name of its teacher."""
    camera: tuple[float, ...] | None = None
    """Pose of the optical frame in the base frame, position [m] and quaternion xyzw; None: the
    hand's.
    """
    depth: DepthCameraCfg = field(default_factory=DepthCameraCfg)
    """Points and crop of the camera's clouds."""


@dataclass(frozen=True, kw_only=True)
class VisionSpec(CameraSpec):
    """How a teacher is let act by a camera."""

    alignment: AlignmentCfg
    """Sizes of the network that finds the object by the cloud of its goal."""


@dataclass(frozen=True, kw_only=True)
class StudentSpec(CameraSpec):
    """What a student is besides its weights."""

    network: StudentCfg
    """Its sizes."""


@dataclass(frozen=True)
class Contract:
    """All that a policy's file says beside its weights."""

    interface: dict[str, Any]
    """As :func:`derive_interface` gave it for the hand of the training."""
    network: PolicySpec
    """What rebuilds the actor; of a student the number of actions alone counts."""
    task: dict[str, Any]
    """Configuration of the environment of its training."""
    iterations: int
    env_steps: int
    tracking: VisionSpec | None = None
    """How the actor is let act on what a camera shows; None for teachers and students."""
    student: StudentSpec | None = None
    """What the student is; None for others."""
    learner: dict[str, Any] = field(default_factory=dict)
    """Configuration of the learner, with which a run may go on; empty where it is not known."""
    stage: dict[str, Any] = field(default_factory=dict)
    """How far the curriculum had come; empty: to its end."""
    software: dict[str, str] = field(default_factory=dict)
    """Versions with which it was written."""
    format: str = POLICY_FORMAT

    @property
    def kind(self) -> Kind:
        """What a policy of this contract is called."""
        if self.student is not None:
            return "student"
        return "teacher" if self.tracking is None else "vision"

    @property
    def camera(self) -> CameraSpec | None:
        """How it sees; None for a teacher."""
        return self.student or self.tracking

    @property
    def num_tips(self) -> int:
        """Fingertips of the hand."""
        return len(self.interface["hand"]["tips_in_base"])


class Contracted:
    """A policy, of which its contract says this."""

    contract: Contract

    @property
    def task(self) -> dict[str, Any]:
        """Configuration of the environment it was trained in."""
        return self.contract.task

    @property
    def hand(self) -> str:
        """Name of the hand it moves."""
        return str(self.task["hand"])

    @property
    def num_observations(self) -> int:
        """Values O of an observation of its layers."""
        return self.contract.network.num_observations

    @property
    def num_actions(self) -> int:
        """Actions D."""
        return self.contract.network.num_actions


def contract_text(contract: Contract) -> str:
    """A contract as policies' files have it."""
    return json.dumps(to_dict(contract), indent=1, allow_nan=False)


def contract_of(text: str, where: str | Path) -> Contract:
    """The contract of the policy ``where``.

    Raises:
        ContractError: It is of another format, or says what this version does not know.
    """
    try:
        values = json.loads(text)
        if values["format"] != POLICY_FORMAT:
            raise ValueError(
                f"format is {values['format']!r}, this version reads {POLICY_FORMAT!r}"
            )
        contract = from_dict(Contract, values, where="contract")
        ReorientCfg.of_task(contract.task, where="contract.task")
    except (ValueError, TypeError, KeyError) as error:
        raise ContractError(f"{where}: {error}; take the version that wrote it") from error
    return contract


def installed_contract(path: str | Path) -> Contract:
    """What a policy's file says of it; its weights are not read.

    Raises:
        OSError: It cannot be read.
        ContractError: It is damaged, no policy, or of another version.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "numpy") as file:
            text = file.metadata()[CONTRACT_KEY]
    except (SafetensorError, TypeError, KeyError) as error:
        raise ContractError(f"{path} is damaged, or no policy; copy it again") from error
    return contract_of(text, path)


def without_folders(contract: Contract) -> Contract:
    """A contract for others: without folders of the machine on which the policy was trained."""
    objects = [Path(name).name for name in contract.task.get("objects", ())]
    changes: dict[str, Any] = {"task": contract.task | {"objects": objects}}
    if contract.camera is not None:
        part = "tracking" if contract.student is None else "student"
        changes[part] = replace(contract.camera, teacher=Path(contract.camera.teacher).name)
    return replace(contract, **changes)


def sealed(data: bytes) -> bytes:
    """The content of a policy's file, whose last 64 bytes become the SHA-256 of all before them."""
    assert data.endswith(UNSEALED), "the seal has to stand last"
    body = data.removesuffix(UNSEALED)
    return body + hashlib.sha256(body).hexdigest().encode()


def read_sealed(path: Path) -> bytes:
    """The content of a policy's file, once its seal was compared.

    Raises:
        FileNotFoundError: There is no such file.
        ContractError: It cannot be read, is damaged, or is no policy.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"there is no policy {path}") from error
    except OSError as error:
        raise ContractError(f"{path} cannot be read ({error.strerror})") from error
    if sealed(data[: -len(UNSEALED)] + UNSEALED) != data:
        raise ContractError(
            f"{path} is damaged, or no policy: it does not end with the SHA-256 of its content; "
            "copy it again, or write it with vd-train export"
        )
    return data


def derive_interface(
    task: ReorientCfg, hand: HandModel, camera: CameraSpec | None = None
) -> dict[str, Any]:
    """What a policy and a hand have to agree on, as JSON has it, by part.

    Args:
        task: The environment of the policy's training.
        hand: The hand without a layer, whose servo model was identified later.
        camera: How the policy sees; None for a teacher.
    """
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
        "camera": None if camera is None else _camera(hand, camera),
    }
    interface: dict[str, Any] = to_dict(parts)
    return interface


def _hand(hand: HandModel) -> dict[str, Any]:
    """The hand as an interface has it."""
    return {
        "name": hand.name,  # of the root prim of its USD
        "joint_names": hand.joint_names,  # in the order of joint positions and actions
        "lower_rad": _floats(hand.lower),
        "upper_rad": _floats(hand.upper),
        "base_in_world": _floats(hand.mount),
        "effort_nm": _floats(hand.effort),
        "drop_m": _floats(hand.workspace.drop_m),
        "tips_in_base": [_floats(tip[:3]) for tip in hand.tip_poses(hand.start)],  # at the start
    }


def _observation(hand: HandModel, task: ReorientCfg) -> dict[str, Any]:
    """The vector that a teacher's layers see.

    Vision policies make it of joints and camera.
    """
    from vd.kernels.task.observations import teacher_observation_slices
    from vd.kernels.task.shapes import shape_observation_size

    observation = task.observation
    slices = teacher_observation_slices(hand.num_fingers, hand.num_joints)
    parts = {name: (part.start, part.stop) for name, part in slices.items()}
    if observation.history:
        parts = {"history": (0, 2 * hand.num_joints * observation.history)}
    elif observation.shape != "none":
        end = slices["previous_action"].stop
        parts["shape"] = (end, end + shape_observation_size(hand.num_fingers))
    if observation.terms and not observation.history:
        end = max(last for _, last in parts.values())
        parts["terms"] = (end, end + sum(observation.terms.values()))
    return {
        "parts": parts,  # first column and the one after the last
        "velocity_scale": PAPER.observation.velocity_scale,  # of joints, and of the object's turning
        "view": observation.view,
        "file_axes": observation.file_axes,
    }


def _camera(hand: HandModel, spec: CameraSpec) -> dict[str, Any]:
    """The depth camera: the one of the hand's USD, or one that the training placed elsewhere."""
    camera = hand.camera.at(spec.camera)
    return {
        "source": "hand" if spec.camera is None else "policy",
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "pose_in_base": _floats([*camera.position, *camera.quaternion]),
        "points": spec.depth.points,  # of a cloud at most
        "crop_m": spec.depth.crop_m,  # world heights that are kept
    }


def _floats(values: Any) -> list[float]:
    return list(map(float, values))


_REMEDY = {
    "hand": "use the hand it was trained for (if imported, import it again), or train a policy for "
    "this one",
    "camera": "use the camera it was made for, or write it for this one (vd-train tracker, "
    "--camera)",
}
"""What to do about a difference in a part of the interface."""
_OTHERWISE = "train it again, or take the version that wrote it"


def check_hand(contract: Contract, hand: HandModel, where: str | Path) -> None:
    """Refuse a hand that is not the one of a policy's contract.

    Args:
        contract: The contract.
        hand: The hand without a layer.
        where: The policy.

    Raises:
        ContractError: The first field that differs, what the hand has, what the policy wants, what
            to do.
    """
    task = ReorientCfg.of_task(contract.task, where="contract.task")
    have = dict(leaves(derive_interface(task, hand, contract.camera)))
    want = dict(leaves(contract.interface))
    for name in dict.fromkeys((*want, *have)):
        here = have.get(name)
        there = want.get(name)
        if not _same(here, there):
            raise ContractError(
                f"{where} does not fit the hand {hand.name} ({hand.path}): {name} is "
                f"{_short(here)} here, but {_short(there)} in the policy's contract; "
                f"{_REMEDY.get(name.split('.')[0], _OTHERWISE)}"
            )


def _same(here: Any, wanted: Any) -> bool:
    """Whether two plain values are equal, numbers but for rounding."""
    if isinstance(here, float) and isinstance(wanted, float):
        return math.isclose(here, wanted, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE)
    return bool(here == wanted)


def _short(value: Any) -> str:
    """A value for a message."""
    if value is None:
        return "missing"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)
