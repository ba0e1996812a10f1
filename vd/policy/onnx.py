"""Teachers that were exported as ONNX, by onnxruntime, without torch.

Such a file has the contract of the policy it was made of among its metadata, and its seal.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from vd.command import interrupt
from vd.policy.contract import CONTRACT_KEY, Contract, Contracted, contract_of, read_sealed


class OnnxNetwork:
    """A policy's layers on the CPU, in one thread.

    Attributes:
        metadata: What the file says of itself, by key.
    """

    def __init__(self, data: bytes):
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # as several would wait for one that has no core
        providers = ["CPUExecutionProvider"]
        self._session = onnxruntime.InferenceSession(data, options, providers=providers)
        self.metadata = self._session.get_modelmeta().custom_metadata_map

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Mean actions [N, D] of observations [N, O]."""
        return cast(np.ndarray, self._session.run(None, {"observation": observation})[0])


@dataclass(frozen=True)
class OnnxTeacher(Contracted):
    """What :class:`vd.policy.actor.TrainedPolicy` is, without its weights."""

    network: OnnxNetwork
    contract: Contract
    kind: Literal["teacher"] = "teacher"

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Mean actions [N, D] for observations [N, O]."""
        return self.network(observation)


def read_onnx(path: Path) -> OnnxTeacher:
    """The teacher in a file.

    Raises:
        FileNotFoundError: There is no such file.
        ModuleNotFoundError: onnxruntime is not installed.
        ValueError: It is damaged, of another version, or no file of ``vd-train export``.
    """
    interrupt.need("onnxruntime")
    data = read_sealed(path)
    try:
        network = OnnxNetwork(data)
        text = network.metadata[CONTRACT_KEY]
    except Exception as error:  # onnxruntime has many of its own
        raise ValueError(
            f"{path} holds no policy ({error}); write it anew with vd-train export"
        ) from error
    return OnnxTeacher(network, contract_of(text, path))
