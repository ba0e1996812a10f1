"""The teacher's network as ONNX: from the observation to the mean action, normalisation included."""

import logging
import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from vd.files import atomic_path
from vd.policy import TrainedPolicy

INPUT, OUTPUT = "observation", "action"
"""Names of the graph's input [N, O] and output [N, D]; N is free."""
CHECKED = 64
"""Random observations on which the runtime is compared."""
TOLERANCE = 1e-4
"""Largest difference from torch that is rounding of single precision."""


def export_onnx(policy: TrainedPolicy, path: Path) -> None:
    """Write the network of ``policy``, which is on the CPU, to ``path``.

    Raises:
        RuntimeError: What the export needs is not installed.
    """
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
            input_names=[INPUT],
            output_names=[OUTPUT],
            dynamic_shapes=({0: torch.export.Dim("environments")},),
            dynamo=True,
            external_data=False,
            verbose=False,
        )


def onnx_difference(policy: TrainedPolicy, path: Path) -> float | None:
    """Largest difference of the file's actions under onnxruntime from the policy's; None without onnxruntime.

    Raises:
        RuntimeError: They differ by more than rounding.
    """
    if find_spec("onnxruntime") is None:
        return None
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    draw = np.random.default_rng(0).normal(size=(CHECKED, policy.num_observations)).astype(np.float32)
    (found,) = session.run([OUTPUT], {INPUT: draw})
    worst = float(np.abs(found - policy.act(torch.from_numpy(draw)).numpy()).max())
    if not worst <= TOLERANCE:
        raise RuntimeError(f"{path}: onnxruntime's actions differ from torch's by {worst:.2g}; do not use it")
    return worst
