"""Bundles on disk: a folder with weights, contract and golden values. Reading one executes nothing in it."""

import hashlib
import json
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from vd.assets_usd.hand_data import HandModel
from vd.bundle import CONTRACT_FILE, is_bundle
from vd.bundle.contract import (
    BUNDLE_FORMAT,
    Contract,
    ContractError,
    Provenance,
    StoppingPart,
    derive_interface,
)
from vd.bundle.golden import (
    TOLERANCE,
    Golden,
    student_golden,
    student_outputs,
    teacher_golden,
    teacher_outputs,
    worst_difference,
)
from vd.config import from_dict, to_dict
from vd.envs.cfg import ReorientCfg
from vd.files import atomic_path, make_folder, write_json, writing
from vd.policy import PolicySpec, TrainedPolicy
from vd.sensors.cfg import DepthCameraCfg
from vd.versions import installed_versions

if TYPE_CHECKING:
    from vd.stopping import StoppingRules
    from vd.tracking.policy import TrackingPolicy
    from vd.vision.saved import SavedStudent

WEIGHTS_FILE, GOLDEN_FILE = "weights.safetensors", "golden.safetensors"
FILE_MODE, FOLDER_MODE = 0o644, 0o755
"""A bundle is for others to read."""
RENDERED = 2
"""Stage of students that see a depth camera."""
_PACKAGES = ("visual-dexterity", "torch", "warp-lang", "newton", "safetensors")


@dataclass(frozen=True)
class Bundle:
    """A bundle that was read: its contract, and its policy."""

    contract: Contract
    policy: "TrainedPolicy | SavedStudent | TrackingPolicy"


def write_teacher(folder: Path, policy: TrainedPolicy, hand: HandModel) -> Contract:
    """Write the bundle of a teacher.

    Args:
        folder: To write; a bundle that is there is replaced.
        policy: The teacher.
        hand: The hand of its training.
    """
    task = from_dict(ReorientCfg, policy.task, where="task of the policy")
    contract = Contract(
        kind="teacher",
        interface=derive_interface(hand, task),
        network=to_dict(policy.spec),
        stopping=None,
        provenance=_provenance(policy.task, "", None, policy.iteration, policy.env_steps),
        software=installed_versions(_PACKAGES),
    )
    _write(folder, contract, policy.weights, teacher_golden(policy))
    return contract


def write_student(folder: Path, student: "SavedStudent", hand: HandModel) -> Contract:
    """Write the bundle of a student.

    Args:
        folder: To write; a bundle that is there is replaced.
        student: The student, on the CPU.
        hand: The hand of its training.
    """
    spec = student.spec
    rendered = spec.stage == RENDERED
    depth = (
        from_dict(DepthCameraCfg, student.depth, where="depth camera of the student") if rendered else None
    )
    contract = Contract(
        kind="student",
        interface=derive_interface(
            hand,
            from_dict(ReorientCfg, student.task, where="task of the student"),
            network=spec.network,
            depth=depth,
            camera=spec.camera,
        ),
        network=to_dict(spec.network),
        stopping=_stopping(spec),
        provenance=replace(
            _provenance(student.task, spec.teacher, spec.stage, student.iteration, student.env_steps),
            depth=student.depth if rendered else {},
        ),
        software=installed_versions(_PACKAGES),
    )
    _write(folder, contract, student.network.state_dict(), student_golden(student, hand))
    return contract


def write_tracking(folder: Path, policy: "TrackingPolicy", hand: HandModel) -> Contract:
    """Write the bundle of a tracking policy.

    Args:
        folder: To write; a bundle that is there is replaced.
        policy: The policy, on the CPU.
        hand: The hand of its teacher's training.
    """
    teacher, spec = policy.teacher, policy.spec
    contract = Contract(
        kind="tracking",
        interface=derive_interface(
            hand,
            from_dict(ReorientCfg, policy.task, where="task of the policy"),
            depth=spec.depth,
            camera=spec.camera,
        ),
        network={"policy": to_dict(teacher.spec)},
        stopping=_stopping(spec),
        provenance=replace(
            _provenance(policy.task, spec.teacher, None, teacher.iteration, teacher.env_steps),
            depth=to_dict(spec.depth),
        ),
        software=installed_versions(_PACKAGES),
    )
    weights = {f"actor.{name}": value for name, value in teacher.weights.items()}
    weights |= {f"critic.{name}": value for name, value in teacher.critic_weights.items()}
    _write(folder, contract, weights, teacher_golden(teacher))
    return contract


def _stopping(rules: "StoppingRules") -> StoppingPart:
    precise = rules.precise
    return StoppingPart(
        rules.stopping.distance_rad,
        rules.stopping.action_norm,
        rules.calibrated_on,
        None if precise is None else (precise.distance_rad, precise.action_norm),
        rules.tolerance_rad,
    )


def read_contract(folder: str | Path) -> Contract:
    """The contract of a bundle.

    Raises:
        FileNotFoundError: There is no bundle.
        ContractError: The contract is damaged, or of another version.
    """
    path = Path(folder) / CONTRACT_FILE
    if not path.is_file():
        raise FileNotFoundError(f"no bundle at {folder}: there is no {path}; vd-train bundle writes one")
    try:
        values = json.loads(path.read_text())
        found = values.get("format") if isinstance(values, dict) else None
        if found != BUNDLE_FORMAT:
            raise ContractError(
                f"{path}: format is {found!r}, this version reads {BUNDLE_FORMAT!r}; "
                "write the bundle again with vd-train bundle"
            )
        return from_dict(Contract, values)
    except ContractError:
        raise
    except (ValueError, TypeError) as error:
        raise ContractError(f"{path}: {error}; write the bundle again with vd-train bundle") from error


def read_bundle(folder: str | Path, device: str = "cpu") -> Bundle:
    """Read a bundle, and see that its policy answers the golden inputs as it did when it was written.

    Args:
        folder: The bundle.
        device: Torch device of the policy.

    Raises:
        FileNotFoundError: A file is missing.
        ContractError: A file is damaged or changed, the weights do not fit the network, or the policy answers
            otherwise.
    """
    folder = Path(folder)
    contract = read_contract(folder)
    weights = _tensors(folder / WEIGHTS_FILE, contract, device)
    golden = _tensors(folder / GOLDEN_FILE, contract, "cpu")
    try:
        _ = contract.task  # its settings are those of this version
        bundle = _build(contract, weights, device)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        first = " ".join(str(error).split("\n\t")[:2])  # of torch's list of what does not fit
        raise ContractError(
            f"{folder}: policy and {CONTRACT_FILE} do not fit this version ({first}); "
            "another one wrote them: write the bundle again with vd-train bundle"
        ) from error
    outputs = _outputs(bundle.policy, golden, device)
    worst = worst_difference(outputs, golden)
    if worst > TOLERANCE:
        raise ContractError(
            f"{folder}: the policy's outputs differ by {worst:.2g} from those in {GOLDEN_FILE} (at most "
            f"{TOLERANCE:g}); it was written by other software ({contract.software}): write it again"
        )
    return bundle


def _outputs(policy: "TrainedPolicy | SavedStudent | TrackingPolicy", golden: Golden, device: str) -> Golden:
    """What a policy makes of golden inputs."""
    from vd.vision.saved import SavedStudent

    if isinstance(policy, SavedStudent):
        return student_outputs(policy, golden)
    teacher = policy if isinstance(policy, TrainedPolicy) else policy.teacher
    return teacher_outputs(teacher, {name: value.to(device) for name, value in golden.items()})


def _build(contract: Contract, weights: dict[str, torch.Tensor], device: str) -> Bundle:
    """The policy of a contract with weights."""
    source = contract.provenance
    if contract.kind == "teacher":
        policy = TrainedPolicy(
            from_dict(PolicySpec, contract.network, where="network"),
            weights,
            task=source.task,
            iteration=source.iterations,
            env_steps=source.env_steps,
            device=device,
        )
        return Bundle(contract, policy)
    if contract.kind == "tracking":
        return Bundle(contract, _tracking(contract, weights, device))
    from vd.vision.cfg import StudentCfg
    from vd.vision.network import Student
    from vd.vision.saved import SavedStudent, StudentSpec

    assert source.stage is not None
    spec = StudentSpec(
        network=from_dict(StudentCfg, contract.network, where="network"),
        num_actions=len(contract.interface.hand.joint_names),
        stage=source.stage,
        teacher=source.teacher,
        **_settings(contract),
    )
    network = Student(spec.network, spec.num_actions).to(device)
    network.load_state_dict(weights)
    network.eval().requires_grad_(False)
    student = SavedStudent(spec, network, source.task, source.depth, source.iterations, source.env_steps)
    return Bundle(contract, student)


def _tracking(contract: Contract, weights: dict[str, torch.Tensor], device: str) -> "TrackingPolicy":
    """The tracking policy of a contract with weights."""
    from vd.tracking.policy import TrackingPolicy, TrackingSpec

    source, network = contract.provenance, dict(contract.network)
    parts: dict[str, dict[str, torch.Tensor]] = {"actor": {}, "critic": {}}
    for name, value in weights.items():
        part, _, inside = name.partition(".")
        parts[part][inside] = value
    teacher = TrainedPolicy(
        from_dict(PolicySpec, network.pop("policy"), where="network.policy"),
        parts["actor"],
        task=source.task,
        iteration=source.iterations,
        env_steps=source.env_steps,
        device=device,
        critic=parts["critic"] or None,
    )
    spec = replace(
        from_dict(TrackingSpec, network, where="network"),
        teacher=source.teacher,
        depth=from_dict(DepthCameraCfg, source.depth, where="provenance.depth"),
        **_settings(contract),
    )
    return TrackingPolicy(teacher, spec)


def _settings(contract: Contract) -> dict[str, Any]:
    """Camera and stopping rules of a policy that sees clouds, as its description names them."""
    from vd.stopping import StoppingRule

    assert contract.stopping is not None
    camera, stopping = contract.interface.camera, contract.stopping
    return {
        "camera": camera.pose_in_base if camera is not None and camera.source == "policy" else None,
        "stopping": StoppingRule(stopping.distance_rad, stopping.action_norm),
        "tolerance_rad": stopping.tolerance_rad,
        "precise": None if stopping.precise is None else StoppingRule(*stopping.precise),
        "calibrated_on": stopping.calibrated_on,
    }


def _provenance(
    task: dict[str, Any], teacher: str, stage: int | None, iterations: int, env_steps: int
) -> Provenance:
    """Where a policy comes from, without folders of the machine it was trained on."""
    objects = tuple(Path(name).name for name in task.get("objects", ()))
    return Provenance(
        teacher=Path(teacher).name if "/" in teacher else teacher,
        stage=stage,
        objects=objects,
        iterations=iterations,
        env_steps=env_steps,
        task={**task, "objects": list(objects)},
    )


def _write(folder: Path, contract: Contract, weights: dict[str, Any], golden: Golden) -> None:
    """Write the files beside the place of the bundle, then put them there at once."""
    folder = Path(folder)
    if folder.exists() and not is_bundle(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} exists and is no bundle; choose another name")
    make_folder(folder.parent)
    with writing(folder):
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        with writing(folder):
            _write_into(temporary, contract, weights, golden)
            if folder.exists():
                shutil.rmtree(folder)
            temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_into(folder: Path, contract: Contract, weights: dict[str, Any], golden: Golden) -> None:
    """Write the files of a bundle into an empty folder."""
    from safetensors.torch import save_file

    folder.chmod(FOLDER_MODE)
    for name, tensors in ((WEIGHTS_FILE, weights), (GOLDEN_FILE, golden)):
        plain = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
        with atomic_path(folder / name) as file:
            save_file(plain, file)
        (folder / name).chmod(FILE_MODE)  # the library writes for the owner's eyes only
    digests = {name: _digest(folder / name) for name in (WEIGHTS_FILE, GOLDEN_FILE)}
    write_json(folder / CONTRACT_FILE, to_dict(replace(contract, files=digests)))


def _tensors(path: Path, contract: Contract, device: str) -> dict[str, torch.Tensor]:
    """Tensors of a file of the bundle, after its digest was compared."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        raise FileNotFoundError(f"the bundle has no {path}; copy the whole folder again")
    wanted = contract.files.get(path.name)
    if _digest(path) != wanted:
        raise ContractError(
            f"{path} is not the file that {CONTRACT_FILE} was written with (its SHA-256 differs); "
            "copy the whole folder again"
        )
    try:
        return load_file(path, device=device)
    except SafetensorError as error:
        raise ContractError(f"{path} is damaged ({error}); copy the whole folder again") from error


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
