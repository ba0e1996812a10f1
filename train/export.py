"""``vd-train export``: policies without their training, for others to use."""

import logging
import warnings
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from vd.command import interrupt
from vd.command.files import atomic_path, check_file
from vd.command.line import parse
from vd.policy import ONNX_SUFFIX, SUFFIX, check_suffix, has_suffix

if TYPE_CHECKING:
    from vd.policy.bundle import AnyPolicy
    from vd.policy.contract import Contract

CHECKED = 64
"""Random observations on which the runtime of ONNX is compared."""
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
    """File to write. A name that ends in .onnx gets the layers from observation to mean action,
    checked against onnxruntime where that is installed."""
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
    """Write a policy's layers with its contract, and compare them with onnxruntime if it is there.

    They take ``observation`` [N, O], which they normalise, to the mean ``action`` [N, D] of any
    number N of environments.

    Raises:
        ModuleNotFoundError: What the export needs is not installed.
        RuntimeError: Outputs differ by more than rounding.
        ValueError: It sees by a camera, of which nothing is exported.
    """
    import torch

    from vd.policy.actor import TrainedPolicy
    from vd.policy.contract import CONTRACT_KEY, SEAL_KEY, UNSEALED, contract_text, sealed

    if not isinstance(policy, TrainedPolicy):
        raise ValueError(
            f"{path}: what a {policy.kind} policy sees by is not exported to ONNX; give a teacher"
        )
    interrupt.need("onnx", "onnxscript")
    import onnx

    network = policy.network.eval().requires_grad_(False)
    rng = torch.Generator().manual_seed(0)
    observation = torch.randn(CHECKED, policy.num_observations, generator=rng)
    # It warns of libraries that this network does not need, and of its own future.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), atomic_path(path) as temporary:
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (observation,),
            temporary,
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes=({0: torch.export.Dim("environments")},),
            dynamo=True,
            external_data=False,
            verbose=False,
        )
        model = onnx.load(temporary)
        metadata = {CONTRACT_KEY: contract_text(contract), SEAL_KEY: UNSEALED.decode()}
        onnx.helper.set_model_props(model, metadata)
        temporary.write_bytes(sealed(model.SerializeToString()))
        if find_spec("onnxruntime") is None:
            print(
                f"{path}: onnxruntime is not installed: not checked "
                f"({interrupt.remedy('onnxruntime')})"
            )
            return
        import onnxruntime

        session = onnxruntime.InferenceSession(str(temporary), providers=["CPUExecutionProvider"])
        (action,) = session.run(["action"], {"observation": observation.numpy()})
        worst = float(np.abs(action - network(observation).numpy()).max())
        if not worst <= TOLERANCE:
            raise RuntimeError(
                f"{path}: onnxruntime's outputs differ by {worst:.2g}; it is not written"
            )
        print(f"{path}: onnxruntime gives the same within {worst:.1e}")
