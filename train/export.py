"""``vd-train export`` and ``vd-train bundle``: policies without their training, for others to use."""

import logging
import warnings
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.command_line import parse
from vd.files import atomic_path, check_file, check_folder

if TYPE_CHECKING:
    from vd.policy import TrainedPolicy

ONNX = ".onnx"
CHECKED = 64
"""Random observations on which the runtime of ONNX is compared."""
TOLERANCE = 1e-4
"""Largest difference from torch that is rounding of single precision."""


@dataclass
class ExportCfg:
    """Write the policy of a checkpoint without its training state, as ONNX, or a small checkpoint.

    A policy keeps its critic, so that --init can go on from it.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """Checkpoint of vd-train teacher, or its policy.pt."""
    output: Annotated[Path, tyro.conf.Positional] = Path("policy.pt")
    """File to write. A name that ends in .onnx gets the network from observation to mean action, checked
    against onnxruntime where that is installed."""
    resumable: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write a checkpoint for --resume instead, all but the state of the environments: a run that moves to
    another machine or number of GPUs starts its episodes anew anyway."""


@dataclass
class BundleCfg:
    """Write a policy as it is deployed: weights, a contract in JSON, golden inputs and outputs, in a folder.

    vd-eval takes the folder in place of a policy, and refuses it for a hand that it was not made for.
    """

    policy: Annotated[str, tyro.conf.Positional]
    """policy.pt, tracking.pt, a checkpoint, a run's folder, or the name of an installed policy."""
    output: Annotated[Path, tyro.conf.Positional]
    """Folder to write; a bundle that is there is replaced."""


def export_command(arguments: list[str], _started: float) -> int:
    """``vd-train export``; the exit status."""
    cfg: ExportCfg = parse(ExportCfg, arguments, prog="vd-train export")
    check_file(cfg.output)
    if cfg.resumable and cfg.output.suffix == ONNX:
        raise ValueError(f"--resumable writes a checkpoint, which {cfg.output} is not; leave one of them out")
    from vd.train.checkpoint import save_checkpoint

    if cfg.output.suffix == ONNX:
        from vd.policy import load_policy

        export_onnx(load_policy(cfg.checkpoint), cfg.output)
    else:
        save_checkpoint(cfg.output, _exported(cfg))
    print(cfg.output)
    return 0


def _exported(cfg: ExportCfg) -> dict[str, Any]:
    """What the file gets."""
    from vd.policy import policy_export
    from vd.train.checkpoint import load_checkpoint, without_worlds

    state = load_checkpoint(cfg.checkpoint, flag="vd-train export")
    if cfg.resumable and "optimizer_state_dict" not in state:
        raise ValueError(f"{cfg.checkpoint} is a policy, not a checkpoint; nothing can go on from it")
    return without_worlds(state) if cfg.resumable else policy_export(state)


def export_onnx(policy: "TrainedPolicy", path: Path) -> None:
    """Write the network of ``policy``, normalisation included, and compare it with onnxruntime if installed.

    The graph takes ``observation`` [N, O] to the mean ``action`` [N, D], for any N.

    Raises:
        RuntimeError: What the export needs is not installed, or actions differ by more than rounding.
    """
    import torch

    if find_spec("onnxscript") is None:
        raise RuntimeError("ONNX export needs onnxscript: pip install -e '.[export]'")
    # It warns of libraries that this network does not need, and of its own future.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), atomic_path(path) as temporary:
        warnings.simplefilter("ignore", FutureWarning)
        torch.onnx.export(
            policy.network,
            (torch.zeros(2, policy.num_observations),),
            temporary,
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes=({0: torch.export.Dim("environments")},),
            dynamo=True,
            external_data=False,
            verbose=False,
        )
        if find_spec("onnxruntime") is None:
            print("onnxruntime is not installed: not checked (pip install -e '.[export]')")
            return
        import onnxruntime

        session = onnxruntime.InferenceSession(str(temporary), providers=["CPUExecutionProvider"])
        draw = np.random.default_rng(0).normal(size=(CHECKED, policy.num_observations)).astype(np.float32)
        (found,) = session.run(["action"], {"observation": draw})
        worst = float(np.abs(found - policy.act(torch.from_numpy(draw)).numpy()).max())
        if not worst <= TOLERANCE:
            raise RuntimeError(f"{path}: onnxruntime's actions differ by {worst:.2g}; it is not written")
        print(f"onnxruntime gives the same actions within {worst:.1e}")


def bundle_command(arguments: list[str], _started: float) -> int:
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
