"""Bundles on disk: a folder with weights, contract and golden values.

Reading one executes nothing in it.
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vd.assets_usd.hands import load_hand
from vd.bundle import CONTRACT_FILE, is_bundle
from vd.bundle.contract import BUNDLE_FORMAT, Contract, ContractError, Provenance, derive_interface
from vd.config import from_dict, to_dict
from vd.envs.cfg import ReorientCfg
from vd.files import make_folder, write_json, writing
from vd.policy import TrainedPolicy, policy_of
from vd.sensors.cfg import DepthCameraCfg
from vd.stopping import StoppingRules
from vd.tracking.policy import TrackingPolicy, TrackingSpec
from vd.versions import installed_versions
from vd.vision.saved import alignment_network

WEIGHTS_FILE, GOLDEN_FILE = "weights.safetensors", "golden.safetensors"
STATES, GOLDEN_POINTS = 8, 500
"""Golden observations of a teacher or pairs of clouds, and points of each cloud."""
GOLDEN_M = 0.03
"""Standard deviation of the golden points of a network of alignment [m]: about that of an
object's.
"""
TOLERANCE = 5e-3
"""Largest difference of an output from the golden one. Actions are of size 1; processors, GPUs and
other versions of torch differ by 1e-6 to 1e-3."""
_PACKAGES = ("visual-dexterity", "torch", "warp-lang", "newton", "safetensors")
_RULES = [one.name for one in fields(StoppingRules)]
_AGAIN = "write the bundle again with vd-train bundle"

AnyPolicy = TrainedPolicy | TrackingPolicy
Tensors = dict[str, torch.Tensor]


def write_bundle(policy: AnyPolicy, folder: Path) -> Contract:
    """Write the bundle of a policy on the CPU; one that is there is replaced.

    Raises:
        FileExistsError: The folder holds something else.
        OutputError: It cannot be written.
    """
    task = ReorientCfg.of(policy)
    hand = load_hand(task.hand, task.fingertip, task.hand_layer)
    rules: StoppingRules | None = None
    if isinstance(policy, TrackingPolicy):
        rules, trained = policy.spec, policy.teacher
        source = _provenance(trained, policy.spec.teacher, to_dict(policy.spec.depth))
        network, camera = {"policy": to_dict(trained.spec)}, policy.spec.camera
        parts = {"actor": trained.weights}
        if policy.alignment is not None:
            network["alignment"] = to_dict(policy.spec.alignment)
            parts["alignment"] = policy.alignment.state_dict()
        weights = {
            f"{part}.{name}": value for part, own in parts.items() for name, value in own.items()
        }
    else:
        source = _provenance(policy, "", {})
        network, camera, weights = to_dict(policy.spec), None, policy.weights
    contract = Contract(
        kind=policy.kind,
        interface=derive_interface(hand, source, camera),
        network=network,
        stopping=None if rules is None else StoppingRules(**{n: getattr(rules, n) for n in _RULES}),
        provenance=source,
        software=installed_versions(_PACKAGES),
    )
    golden = _golden_inputs(policy)
    _write(Path(folder), contract, weights, golden | _answers(policy, golden))
    return contract


def read_contract(folder: str | Path) -> Contract:
    """The contract of a bundle.

    Raises:
        FileNotFoundError: There is no bundle.
        ContractError: The contract is damaged, or of another version.
    """
    path = Path(folder) / CONTRACT_FILE
    if not path.is_file():
        raise FileNotFoundError(
            f"no bundle at {folder}: there is no {path}; vd-train bundle writes one"
        )
    try:
        values = json.loads(path.read_text())
        found = values.get("format") if isinstance(values, dict) else None
        if found != BUNDLE_FORMAT:
            raise ValueError(f"format is {found!r}, this version reads {BUNDLE_FORMAT!r}")
        if (rules := values.get("stopping")) and "distance_rad" in rules:  # of an earlier version
            pairs = (rules.pop("distance_rad"), rules.pop("action_norm")), rules.get("precise")
            rules["stopping"], rules["precise"] = (
                pair and dict(zip(("distance_rad", "action_norm"), pair, strict=True))
                for pair in pairs
            )
        return from_dict(Contract, values)
    except (ValueError, TypeError, KeyError) as error:
        raise ContractError(f"{path}: {error}; {_AGAIN}") from error


def read_bundle(folder: str | Path, device: str = "cpu") -> AnyPolicy:
    """The policy of a bundle, once it has answered the golden inputs as it did when it was written.

    Raises:
        FileNotFoundError: A file is missing.
        ContractError: A file is damaged or changed, the weights do not fit the network, or the
            policy answers otherwise.
    """
    folder = Path(folder)
    contract = read_contract(folder)
    weights = _tensors(folder / WEIGHTS_FILE, contract, device)
    golden = _tensors(folder / GOLDEN_FILE, contract, "cpu")
    try:
        _ = contract.task  # its settings are those of this version
        policy = _policy_of(contract, weights, device)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        first = " ".join(str(error).split("\n\t")[:2])  # of torch's list of what does not fit
        raise ContractError(
            f"{folder}: policy and {CONTRACT_FILE} do not fit this version ({first}); another one "
            f"wrote "
            f"them: {_AGAIN}"
        ) from error
    answers = _answers(policy, {name: value.to(device) for name, value in golden.items()})
    worst = max(float((value - golden[name]).abs().max()) for name, value in answers.items())
    if not worst <= TOLERANCE:  # NaN is wrong too
        raise ContractError(
            f"{folder}: the policy's outputs differ by {worst:.2g} from those in {GOLDEN_FILE} (at "
            f"most "
            f"{TOLERANCE:g}); it was written by other software ({contract.software}): {_AGAIN}"
        )
    return policy


def _golden_inputs(policy: AnyPolicy) -> Tensors:
    """Inputs, and the outputs that have to come back.

    Of a teacher's layers ``observation`` [S, O] of size 1. Of a network of alignment
    ``goal_points`` and ``seen_points`` [S, G, 3] about their means [m].
    """
    rng = np.random.default_rng(0)
    teacher = policy.teacher if isinstance(policy, TrackingPolicy) else policy
    drawn = {"observation": rng.normal(size=(STATES, teacher.num_observations))}
    if isinstance(policy, TrackingPolicy) and policy.alignment is not None:
        shape = (STATES, GOLDEN_POINTS, 3)
        drawn |= {
            name: rng.normal(scale=GOLDEN_M, size=shape) for name in ("goal_points", "seen_points")
        }
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in drawn.items()}


def _answers(policy: AnyPolicy, golden: Mapping[str, torch.Tensor]) -> Tensors:
    """What a policy makes of golden inputs on its device: ``action`` [S, D].

    Of a network of alignment ``rotation``, matrices [S, 3, 3].
    """
    teacher = policy.teacher if isinstance(policy, TrackingPolicy) else policy
    found = {"action": teacher.act(golden["observation"]).cpu()}
    if isinstance(policy, TrackingPolicy) and policy.alignment is not None:
        with torch.no_grad():
            turn = policy.alignment(golden["goal_points"], golden["seen_points"]).rotation
        found["rotation"] = turn.cpu()
    return found


def _policy_of(contract: Contract, weights: Tensors, device: str) -> AnyPolicy:
    """The policy of a contract with weights."""
    source, network = contract.provenance, dict(contract.network)
    if contract.kind == "teacher":
        return _teacher(network, source, weights, device)
    settings: dict[str, Any] = {"teacher": source.teacher, "camera": contract.own_camera}
    settings |= vars(contract.stopping or StoppingRules())
    teacher = _teacher(network.pop("policy"), source, weights, device)
    spec = from_dict(TrackingSpec, network, where="network")
    depth = from_dict(DepthCameraCfg, source.depth, where="provenance.depth")
    alignment = None
    if spec.alignment is not None:
        alignment = alignment_network(spec.alignment, _part(weights, "alignment."), device)
    return TrackingPolicy(teacher, replace(spec, depth=depth, **settings), alignment)


def _teacher(
    spec: dict[str, Any], source: Provenance, weights: Tensors, device: str
) -> TrainedPolicy:
    """A teacher; of a camera policy names of weights say which are its actor's."""
    trained = {
        "policy": spec,
        "task": source.task,
        "iter": source.iterations,
        "env_steps": source.env_steps,
    }
    return policy_of(trained | {"actor_state_dict": _part(weights, "actor.") or weights}, device)


def _part(weights: Tensors, prefix: str) -> Tensors:
    """Weights whose names begin so, without that."""
    return {n.removeprefix(prefix): value for n, value in weights.items() if n.startswith(prefix)}


def _provenance(trained: TrainedPolicy, teacher: str, depth: dict[str, Any]) -> Provenance:
    """Where a policy comes from, without folders of the machine it was trained on."""
    objects = tuple(Path(name).name for name in trained.task.get("objects", ()))
    return Provenance(
        teacher=Path(teacher).name,
        objects=objects,
        iterations=trained.iteration,
        env_steps=trained.env_steps,
        task={**trained.task, "objects": list(objects)},
        depth=depth,
    )


def _write(folder: Path, contract: Contract, weights: Tensors, golden: Tensors) -> None:
    """Write the files beside the place of the bundle, then put them there at once."""
    from safetensors.torch import save

    if folder.exists() and not is_bundle(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} exists and is no bundle; choose another name")
    make_folder(folder.parent)
    with (
        writing(folder),
        tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as name,
    ):
        made = Path(name) / folder.name
        made.mkdir()
        for file, tensors in ((WEIGHTS_FILE, weights), (GOLDEN_FILE, golden)):
            (made / file).write_bytes(
                save({k: v.detach().cpu().contiguous() for k, v in tensors.items()})
            )
        digests = {file: _digest(made / file) for file in (WEIGHTS_FILE, GOLDEN_FILE)}
        write_json(made / CONTRACT_FILE, to_dict(replace(contract, files=digests)))
        if folder.exists():
            shutil.rmtree(folder)
        made.replace(folder)


def _tensors(path: Path, contract: Contract, device: str) -> Tensors:
    """Tensors of a file of the bundle, after its digest was compared."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        raise FileNotFoundError(f"the bundle has no {path}; copy the whole folder again")
    if _digest(path) != contract.files.get(path.name):
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
