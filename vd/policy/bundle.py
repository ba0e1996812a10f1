"""Reading and writing policies. Reading one executes nothing in it."""

from pathlib import Path

import numpy as np
import torch

from vd.command.files import atomic_path
from vd.policy import SUFFIX, check_suffix, has_suffix
from vd.policy.actor import REMEDY, TrainedPolicy, read_state, teacher_in
from vd.policy.contract import (
    CONTRACT_KEY,
    SEAL_KEY,
    UNSEALED,
    Contract,
    ContractError,
    contract_text,
    installed_contract,
    read_sealed,
    sealed,
)
from vd.vision.acting import StudentPolicy
from vd.vision.acting_teacher import VisionPolicy
from vd.vision.inputs import Belief, StudentInput
from vd.vision.saved import alignment_network
from vd.vision.student import Student

STATES = 8
"""Golden observations of a teacher, or pairs of clouds."""
GOLDEN_POINTS = 500
"""Points of each cloud."""
GOLDEN_M = 0.03
"""Standard deviation of the golden points of a network of alignment [m]: about that of an
object's.
"""
TOLERANCE = 5e-3
"""Largest difference of an output from the golden one. Actions are of size 1; processors and
other versions of torch differ by 1e-6 to 1e-3."""

AnyPolicy = TrainedPolicy | VisionPolicy | StudentPolicy
Tensors = dict[str, torch.Tensor]


def write_policy(policy: AnyPolicy, path: Path, contract: Contract | None = None) -> None:
    """Write a policy; a file that is there is replaced.

    Args:
        policy: The policy.
        path: The file.
        contract: What the file says of it; the policy's own contract by default.

    Raises:
        OutputError: It cannot be written.
        ValueError: The name is not that of a policy.
    """
    from safetensors.torch import save

    check_suffix(path, SUFFIX)
    contract = contract or policy.contract
    tensors = {}
    for part, weights in _weights(policy).items():
        for name, value in weights.items():
            tensors[f"{part}.{name}"] = value.detach().cpu().contiguous()
    golden = _golden_inputs(policy)
    golden |= _answers(_policy_of(contract, tensors, "cpu"), golden)
    tensors |= {f"golden.{name}": value.contiguous() for name, value in golden.items()}
    tensors[SEAL_KEY] = torch.tensor(list(UNSEALED), dtype=torch.uint8)  # bytes stand last
    data = save(tensors, {CONTRACT_KEY: contract_text(contract)})
    with atomic_path(path) as temporary:
        temporary.write_bytes(sealed(data))


def read_contract(path: str | Path) -> Contract:
    """What a policy's file says of it.

    Raises:
        FileNotFoundError: There is no such file.
        ContractError: It is damaged, no policy, or of another version.
    """
    read_sealed(Path(path))
    return installed_contract(path)


def read_policy(path: str | Path, device: str = "cpu") -> AnyPolicy:
    """The policy in a file, or the teacher in a checkpoint of ``vd-train teacher``.

    A policy has answered its golden inputs as it did when it was written.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, no policy, or of another version, or the policy answers
            otherwise.
    """
    from safetensors.torch import load

    if not has_suffix(path, SUFFIX):
        return teacher_in(read_state(path, device, remedy=REMEDY), path, device)
    data = read_sealed(Path(path))
    contract = installed_contract(path)
    tensors = load(data)
    golden = _part(tensors, "golden.")
    try:
        policy = _policy_of(contract, tensors, "cpu")
        answers = _answers(policy, golden)
    except (KeyError, RuntimeError) as error:
        first = " ".join(str(error).split("\n\t")[:2])  # of torch's list of what does not fit
        raise ContractError(
            f"{path}: the weights do not fit the network of its contract ({first}); take the "
            "version that wrote it"
        ) from error
    worst = max(float((value - golden[name]).abs().max()) for name, value in answers.items())
    if not worst <= TOLERANCE:  # NaN is wrong too
        raise ContractError(
            f"{path}: the policy's outputs differ by {worst:.2g} from the golden ones in it (at "
            f"most {TOLERANCE:g}); other software wrote it ({contract.software}): take that"
        )
    return policy if device == "cpu" else _policy_of(contract, tensors, device)


def _weights(policy: AnyPolicy) -> dict[str, Tensors]:
    """The weights of each part of a policy."""
    if isinstance(policy, StudentPolicy):
        return {"student": policy.network.state_dict()}
    if isinstance(policy, TrainedPolicy):
        return {"actor": policy.weights, "critic": policy.critic}
    return {
        "actor": policy.teacher.weights,
        "critic": policy.teacher.critic,
        "alignment": policy.alignment.state_dict(),
    }


def _policy_of(contract: Contract, tensors: Tensors, device: str) -> AnyPolicy:
    """The policy of a contract with weights."""
    on_device = {name: value.to(device) for name, value in tensors.items()}
    if contract.student is not None:
        actions = contract.network.num_actions
        network = Student(contract.student.network, actions, contract.num_tips).to(device)
        network.load_state_dict(_part(on_device, "student."))
        return StudentPolicy(network.eval().requires_grad_(False), contract)
    teacher = TrainedPolicy(
        contract, _part(on_device, "actor."), _part(on_device, "critic."), device
    )
    if contract.tracking is None:
        return teacher
    weights = _part(on_device, "alignment.")
    alignment = alignment_network(contract.tracking.alignment, weights, device)
    return VisionPolicy(teacher, contract, alignment)


def _golden_inputs(policy: AnyPolicy) -> Tensors:
    """Inputs to which the outputs are known.

    Of a teacher's layers ``observation`` [S, O] of size 1. Of a network of alignment
    ``goal_points`` and ``seen_points`` [S, G, 3] about their means [m]. Of a student three clouds,
    ``tips`` [S, F, 3] and ``proprioception`` [S, 3 D].
    """
    rng = np.random.default_rng(0)
    drawn: dict[str, np.ndarray] = {}
    if isinstance(policy, StudentPolicy):
        for name in ("camera", "hand", "goal"):
            drawn[name] = rng.normal(scale=GOLDEN_M, size=(STATES, GOLDEN_POINTS, 3))
        drawn["tips"] = rng.normal(scale=GOLDEN_M, size=(STATES, policy.contract.num_tips, 3))
        drawn["proprioception"] = rng.normal(size=(STATES, 3 * policy.num_actions))
    else:
        drawn["observation"] = rng.normal(size=(STATES, policy.num_observations))
    if isinstance(policy, VisionPolicy):
        shape = (STATES, GOLDEN_POINTS, 3)
        for name in ("goal_points", "seen_points"):
            drawn[name] = rng.normal(scale=GOLDEN_M, size=shape)
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in drawn.items()}


def _answers(policy: AnyPolicy, golden: Tensors) -> Tensors:
    """What a policy on the CPU makes of golden inputs, by products that are not rounded as in training.

    ``action`` [S, D], of a network of alignment and a student also ``rotation``, matrices [S, 3, 3].
    """
    rounding = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        return _outputs(policy, golden)
    finally:
        torch.set_float32_matmul_precision(rounding)


def _outputs(policy: AnyPolicy, golden: Tensors) -> Tensors:
    """The outputs of a policy on the CPU to golden inputs."""
    if isinstance(policy, StudentPolicy):
        return _student_answers(policy.network, golden)
    teacher = policy.teacher if isinstance(policy, VisionPolicy) else policy
    answers = {"action": teacher.act(golden["observation"])}
    if isinstance(policy, VisionPolicy):
        with torch.no_grad():
            turn = policy.alignment(golden["goal_points"], golden["seen_points"]).rotation
        answers["rotation"] = turn
    return answers


def _student_answers(network: Student, golden: Tensors) -> Tensors:
    """What a student makes of clouds of objects that are believed to be turned as wanted."""
    rotation = torch.eye(3).repeat(STATES, 1, 1)
    sight = StudentInput(
        camera=golden["camera"],
        hand=golden["hand"],
        goal=golden["goal"],
        goal_rotation=rotation,
        proprioception=golden["proprioception"],
        tips=golden["tips"],
        belief=Belief(rotation, torch.zeros((STATES, 3))),
        frame=torch.zeros(STATES, dtype=torch.int64),
    )
    with torch.no_grad():
        look, decision = network.act(sight, network.first_hidden(STATES))
    return {"action": decision.action, "rotation": look.belief.rotation}


def _part(tensors: Tensors, prefix: str) -> Tensors:
    """Tensors whose names begin so, without that."""
    return {n.removeprefix(prefix): value for n, value in tensors.items() if n.startswith(prefix)}
