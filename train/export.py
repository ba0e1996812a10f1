"""``vd-train export`` and ``vd-train bundle``.

Policies without their training, for others to use.
"""

import logging
import timeit
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd import interrupt
from vd.command_line import parse
from vd.files import atomic_path, check_file, check_folder
from vd.onnx_policy import ONNX

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

    from vd.policy import TrainedPolicy
    from vd.tracking.policy import TrackingPolicy

CHECKED = 64
"""Random observations, or pairs of clouds, on which the runtime of ONNX is compared."""
POINTS, CLOUD_M = 512, 0.03
"""Points of these clouds, and their standard deviation [m]: as of objects."""
TOLERANCE = 1e-4
"""Largest difference from torch that is rounding of single precision."""
TIMED = 50
"""Calls of which the shortest tells the time."""


@dataclass
class ExportCfg:
    """Write the policy of a checkpoint without its training state, as ONNX, or a small checkpoint.

    A policy keeps its critic, so that --init can go on from it.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """Checkpoint of vd-train teacher, its policy.pt, its run's folder, or a policy's name; for ONNX
    by camera too."""
    output: Annotated[Path, tyro.conf.Positional] = Path("policy.pt")
    """File to write. A name that ends in .onnx gets the layers from observation to mean action, and
    NAME-alignment.onnx beside it the network of a vision policy. They are checked against
    onnxruntime where that is installed."""
    resumable: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write a checkpoint for --resume instead, all but the state of the environments: a run that
    moves to another machine or number of GPUs starts its episodes anew anyway."""


@dataclass
class BundleCfg:
    """Write a policy as it is deployed.

    Weights, a contract in JSON, golden inputs and outputs, in a folder.

    vd-eval takes the folder in place of a policy, and refuses it for a hand that it was not made
    for.
    """

    policy: Annotated[str, tyro.conf.Positional]
    """policy.pt, tracking.pt, a checkpoint, a run's folder, or the name of an installed policy."""
    output: Annotated[Path, tyro.conf.Positional]
    """Folder to write; a bundle that is there is replaced."""


def export_command(arguments: list[str]) -> int:
    """``vd-train export``; the exit status."""
    cfg: ExportCfg = parse(ExportCfg, arguments, prog="vd-train export")
    check_file(cfg.output)
    if cfg.resumable and cfg.output.suffix == ONNX:
        raise ValueError(
            f"--resumable writes a checkpoint, which {cfg.output} is not; leave one of them out"
        )
    from vd.train.checkpoint import save_checkpoint

    if cfg.output.suffix == ONNX:
        from vd.evaluate.agents import find_policy, open_policy

        policy = open_policy(str(find_policy(cfg.checkpoint)), "cpu")
        assert policy is not None  # a file was found
        export_onnx(policy, cfg.output)
    else:
        save_checkpoint(cfg.output, _exported(cfg))
    print(cfg.output)
    return 0


def _exported(cfg: ExportCfg) -> dict[str, Any]:
    """What the file gets."""
    from vd.evaluate.agents import find_policy
    from vd.policy import policy_export
    from vd.train.checkpoint import load_checkpoint, without_worlds

    path = cfg.checkpoint if cfg.resumable else find_policy(cfg.checkpoint)
    state = load_checkpoint(path, flag="vd-train export")
    if cfg.resumable and "optimizer_state_dict" not in state:
        raise ValueError(
            f"{cfg.checkpoint} is a policy, not a checkpoint; nothing can go on from it"
        )
    return without_worlds(state) if cfg.resumable else policy_export(state)


def export_onnx(policy: "TrainedPolicy | TrackingPolicy", path: Path) -> None:
    """Write a policy's networks, and compare them with onnxruntime if that is installed.

    The layers of a teacher, or of that of a camera policy, take ``observation`` [N, O], which they
    normalise, to the mean ``action`` [N, D]. The network of a vision policy goes to
    NAME-alignment.onnx: clouds about their means, ``goal_points`` [N, G, 3] and ``seen_points`` [N,
    S, 3] [m], to ``rotation`` [N, 3, 3] and ``offset`` [N, 3] [m] of
    :class:`vd.vision.alignment.Residual`. N, G and S vary.

    Raises:
        ModuleNotFoundError: What the export needs is not installed.
        RuntimeError: Outputs differ by more than rounding.
    """
    import torch

    from vd.onnx_policy import onnx_metadata
    from vd.policy import TrainedPolicy
    from vd.vision.alignment import Residual

    interrupt.need("onnx", "onnxscript")
    teacher = policy if isinstance(policy, TrainedPolicy) else policy.teacher
    drawn = torch.randn(
        CHECKED, teacher.num_observations, generator=torch.Generator().manual_seed(0)
    )
    _export(teacher.network, {"observation": drawn}, ["action"], path, onnx_metadata(policy))
    if not isinstance(policy, TrainedPolicy) and policy.alignment is not None:
        _have_exported(Residual)
        clouds = CLOUD_M * torch.randn(
            2, CHECKED, POINTS, 3, generator=torch.Generator().manual_seed(0)
        )
        named = {
            "goal_points": clouds[0],
            "seen_points": clouds[1, :, : POINTS - 1],
        }  # of another number
        outputs = [one.name for one in fields(Residual)]
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

    network = network.eval().requires_grad_(False)
    number = torch.export.Dim("environments")
    shapes = tuple(
        {0: number} | {i: torch.export.Dim(f"{name}_{i}") for i in range(1, value.ndim - 1)}
        for name, value in inputs.items()
    )
    # It warns of libraries that this network does not need, and of its own future.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), atomic_path(path) as temporary:
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(
                value[:2] for value in inputs.values()
            ),  # of one it would take the number for fixed
            temporary,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=shapes,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
        model = onnx.load(temporary)
        onnx.helper.set_model_props(model, metadata or {})
        onnx.save(model, temporary)
        if find_spec("onnxruntime") is None:
            print(
                f"{path}: onnxruntime is not installed: not checked "
                f"({interrupt.remedy('onnxruntime')})"
            )
            return
        worst, ours, theirs = _compared(network, inputs, temporary)
        if not worst <= TOLERANCE:
            raise RuntimeError(
                f"{path}: onnxruntime's outputs differ by {worst:.2g}; it is not written"
            )
        print(
            f"{path}: onnxruntime gives the same within {worst:.1e}, in {theirs:.2f} ms (torch "
            f"{ours:.2f})"
        )


def _compared(
    network: "Module", inputs: dict[str, "Tensor"], path: Path
) -> tuple[float, float, float]:
    """Largest difference of an output, and times of torch and onnxruntime for one environment [ms]."""
    import onnxruntime
    import torch

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # as in the control loop, torch too
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    told = {name: value.numpy() for name, value in inputs.items()}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        wanted: Any = network(*inputs.values())
        tensors = vars(wanted).values() if is_dataclass(wanted) else [wanted]
        pairs = zip(session.run(None, told), tensors, strict=True)
        worst = max(float(np.abs(found - value.numpy()).max()) for found, value in pairs)
        single = [value[:1] for value in inputs.values()]
        one = {name: value[:1] for name, value in told.items()}
        return worst, _ms(lambda: network(*single)), _ms(lambda: session.run(None, one))
    finally:
        torch.set_num_threads(threads)


def _ms(call: Callable[[], object]) -> float:
    """Time of a call [ms], the shortest of some."""
    return 1e3 * min(timeit.repeat(call, number=1, repeat=TIMED))


def bundle_command(arguments: list[str]) -> int:
    """``vd-train bundle``; the exit status."""
    cfg: BundleCfg = parse(BundleCfg, arguments, prog="vd-train bundle")
    check_folder(cfg.output.parent)

    from vd.bundle.store import write_bundle
    from vd.evaluate.agents import find_policy, open_policy

    policy = open_policy(str(find_policy(cfg.policy)), "cpu")
    assert policy is not None  # a file was found
    contract = write_bundle(policy, cfg.output)
    hand = contract.interface["hand"]
    print(f"{cfg.output}: {contract.kind} for {hand['name']}, {len(hand['joint_names'])} joints")
    return 0
