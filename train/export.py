"""``vd-train export``: policies without their training, for others to use."""

import logging
import warnings
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.command import interrupt
from vd.command.files import atomic_path, check_file
from vd.command.line import parse
from vd.policy import ONNX_SUFFIX, SUFFIX, check_suffix, has_suffix

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

    from vd.policy.bundle import AnyPolicy
    from vd.policy.contract import Contract

CHECKED = 64
"""Random observations, or pairs of clouds, on which the runtime of ONNX is compared."""
POINTS, CLOUD_M = 512, 0.03
"""Points of these clouds, and their standard deviation [m]: as of objects."""
TOLERANCE = 1e-4
"""Largest difference from torch that is rounding of single precision."""


@dataclass
class ExportCfg:
    """Write a policy for others: as a file with its contract, or as ONNX.

    What is written names no folders of this machine. A policy keeps its critic, so that --init can
    go on from it.
    """

    policy: Annotated[str, tyro.conf.Positional]
    """Checkpoint of vd-train teacher, a policy.safetensors, a run's folder, or a policy's name."""
    output: Annotated[Path, tyro.conf.Positional] = Path(f"policy{SUFFIX}")
    """File to write. A name that ends in .onnx gets the layers from observation to mean action, and
    NAME-alignment.onnx beside it the network of a vision policy. They are checked against
    onnxruntime where that is installed."""
    resumable: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write a checkpoint for --resume instead, all but the state of the environments: a run that
    moves to another machine or number of GPUs starts its episodes anew anyway."""


def export_command(arguments: list[str]) -> int:
    """``vd-train export``; the exit status."""
    cfg: ExportCfg = parse(ExportCfg, arguments, prog="vd-train export")
    check_suffix(cfg.output, *([".pt"] if cfg.resumable else [SUFFIX, ONNX_SUFFIX]))
    check_file(cfg.output)
    if cfg.resumable:
        from vd.train.checkpoint import load_checkpoint, save_checkpoint, without_worlds

        state = load_checkpoint(Path(cfg.policy), flag="vd-train export")
        save_checkpoint(cfg.output, without_worlds(state))
        print(cfg.output)
        return 0
    from vd.policy.agents import find_policy, open_policy
    from vd.policy.bundle import write_policy
    from vd.policy.contract import without_folders

    policy = open_policy(find_policy(cfg.policy), "cpu")
    assert policy is not None  # a file was found
    contract = without_folders(policy.contract)
    if has_suffix(cfg.output, ONNX_SUFFIX):
        export_onnx(policy, cfg.output, contract)
    else:
        write_policy(policy, cfg.output, contract)
    print(f"{cfg.output}: {contract.kind} for {policy.hand}, {policy.num_actions} motors")
    return 0


def export_onnx(policy: "AnyPolicy", path: Path, contract: "Contract") -> None:
    """Write a policy's networks with its contract, and compare them with onnxruntime if it is there.

    The layers of a teacher, or of that of a camera policy, take ``observation`` [N, O], which they
    normalise, to the mean ``action`` [N, D]. The network of a vision policy goes to
    NAME-alignment.onnx: clouds about their means, ``goal_points`` [N, G, 3] and ``seen_points`` [N,
    S, 3] [m], to ``rotation`` [N, 3, 3] and ``offset`` [N, 3] [m] of
    :class:`vd.vision.alignment.Residual`. N, G and S vary.

    Raises:
        ModuleNotFoundError: What the export needs is not installed.
        RuntimeError: Outputs differ by more than rounding.
        ValueError: It is a student.
    """
    import torch

    from vd.policy.actor import TrainedPolicy
    from vd.policy.onnx import onnx_metadata
    from vd.vision.acting import StudentPolicy
    from vd.vision.alignment import Residual

    if isinstance(policy, StudentPolicy):
        raise ValueError(f"{path}: sparse convolutions are not exported to ONNX; name a {SUFFIX}")
    interrupt.need("onnx", "onnxscript")
    teacher = policy if isinstance(policy, TrainedPolicy) else policy.teacher
    rng = torch.Generator().manual_seed(0)
    drawn = {"observation": torch.randn(CHECKED, teacher.num_observations, generator=rng)}
    _export(teacher.network, drawn, ["action"], path, onnx_metadata(policy, contract))
    if not isinstance(policy, TrainedPolicy) and policy.alignment is not None:
        _have_exported(Residual)
        clouds = CLOUD_M * torch.randn(2, CHECKED, POINTS, 3, generator=rng)
        seen = clouds[1, :, : POINTS - 1]  # of another number
        named = {"goal_points": clouds[0], "seen_points": seen}
        outputs = [field.name for field in fields(Residual)]
        _export(policy.alignment, named, outputs, path.with_stem(f"{path.stem}-alignment"))


@cache
def _have_exported(kind: type) -> None:
    """Have exports take apart what a network returns; torch wants to be told once."""
    import torch

    torch.export.register_dataclass(kind)


def _export(
    network: "Module",
    inputs: dict[str, "Tensor"],
    outputs: list[str],
    path: Path,
    metadata: dict[str, str] | None = None,
) -> None:
    """Write a network whose inputs may have any size but the last, and compare it on these."""
    import onnx
    import torch

    from vd.policy.contract import SEAL_KEY, UNSEALED, sealed

    network = network.eval().requires_grad_(False)
    number = torch.export.Dim("environments")
    shapes = []
    for name, value in inputs.items():
        sizes = {0: number}
        for axis in range(1, value.ndim - 1):
            sizes[axis] = torch.export.Dim(f"{name}_{axis}")
        shapes.append(sizes)
    # It warns of libraries that this network does not need, and of its own future.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), atomic_path(path) as temporary:
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            # Of one it would take the number for fixed.
            tuple(value[:2] for value in inputs.values()),
            temporary,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=tuple(shapes),
            dynamo=True,
            external_data=False,
            verbose=False,
        )
        model = onnx.load(temporary)
        onnx.helper.set_model_props(model, (metadata or {}) | {SEAL_KEY: UNSEALED.decode()})
        temporary.write_bytes(sealed(model.SerializeToString()))
        if find_spec("onnxruntime") is None:
            print(
                f"{path}: onnxruntime is not installed: not checked "
                f"({interrupt.remedy('onnxruntime')})"
            )
            return
        worst = _difference(network, inputs, temporary)
        if not worst <= TOLERANCE:
            raise RuntimeError(
                f"{path}: onnxruntime's outputs differ by {worst:.2g}; it is not written"
            )
        print(f"{path}: onnxruntime gives the same within {worst:.1e}")


def _difference(network: "Module", inputs: dict[str, "Tensor"], path: Path) -> float:
    """Largest difference of an output between torch and onnxruntime."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    arrays = {name: value.numpy() for name, value in inputs.items()}
    wanted: Any = network(*inputs.values())
    tensors = vars(wanted).values() if is_dataclass(wanted) else [wanted]
    worst = 0.0
    for output, tensor in zip(session.run(None, arrays), tensors, strict=True):
        worst = max(worst, float(np.abs(output - tensor.numpy()).max()))
    return worst
