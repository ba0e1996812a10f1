"""Teachers and tracking policies that ``vd-train export`` wrote as ONNX, by onnxruntime, without torch."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from vd import interrupt
from vd.config import from_dict, to_dict
from vd.tracking.policy import TrackingPolicy, TrackingSpec

if TYPE_CHECKING:
    from vd.policy import TrainedPolicy

ONNX = ".onnx"
ONNX_FORMAT = "visual-dexterity onnx 1"
METADATA = "visual-dexterity"
"""Key under which a file says what policy it is, in JSON."""


class OnnxNetwork:
    """A policy's layers on the CPU, in one thread.

    Attributes:
        offset: Mean of observations in training [1, O].
    """

    def __init__(self, path: Path):
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # of several, some would wait for one that has no core
        providers = ["CPUExecutionProvider"]
        self._session = onnxruntime.InferenceSession(str(path), options, providers=providers)
        self.told = json.loads(self._session.get_modelmeta().custom_metadata_map[METADATA])
        self.offset = np.array(self.told["offset"], dtype=np.float32)[None]

    def to(self, device: str) -> "OnnxNetwork":
        """Itself, on the CPU."""
        if device != "cpu":
            raise ValueError(f"a policy as ONNX runs on the CPU, not on {device}")
        return self

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Mean actions [N, D] of observations [N, O]."""
        return cast(np.ndarray, self._session.run(None, {"observation": observation})[0])


@dataclass(frozen=True)
class OnnxTeacher:
    """What :class:`vd.policy.TrainedPolicy` is, without its weights."""

    network: OnnxNetwork
    task: dict[str, Any]
    trained_hand: dict[str, Any]
    num_observations: int
    num_actions: int
    kind: Literal["teacher"] = "teacher"

    @property
    def hand(self) -> str:
        """Name of the hand it moves."""
        return str(self.task.get("hand", ""))

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Mean actions [N, D] for observations [N, O]."""
        return self.network(observation)


def onnx_metadata(policy: "TrainedPolicy | TrackingPolicy") -> dict[str, str]:
    """What a policy's ONNX file says of it, besides its layers."""
    teacher: Any = policy.teacher if isinstance(policy, TrackingPolicy) else policy
    told = {
        "format": ONNX_FORMAT,
        "task": teacher.task,
        "trained_hand": teacher.trained_hand,
        "num_observations": teacher.num_observations,
        "num_actions": teacher.num_actions,
        "offset": teacher.network.offset[0].tolist(),
        **({"tracking": to_dict(policy.spec)} if isinstance(policy, TrackingPolicy) else {}),
    }
    return {METADATA: json.dumps(told)}


def read_onnx(path: Path) -> "OnnxTeacher | TrackingPolicy":
    """The policy in a file.

    Raises:
        ModuleNotFoundError: onnxruntime is not installed.
        ValueError: It is damaged, of a vision policy, or no file of ``vd-train export``.
    """
    interrupt.need("onnxruntime")
    try:
        network = OnnxNetwork(path)
        told = network.told
        if told["format"] != ONNX_FORMAT:
            raise ValueError(
                f"its format is {told['format']!r}, this version reads {ONNX_FORMAT!r}"
            )
        names = ("task", "trained_hand", "num_observations", "num_actions")
        teacher = OnnxTeacher(network, **{name: told[name] for name in names})
        spec = from_dict(TrackingSpec, told["tracking"]) if "tracking" in told else None
    except Exception as error:  # onnxruntime has many of its own
        raise ValueError(
            f"{path} cannot be read ({error}); write it anew with vd-train export"
        ) from error
    if spec is None:
        return teacher
    if spec.alignment is not None:
        raise ValueError(
            f"{path} is of a vision policy, whose search computes with torch; give policy.pt"
        )
    return TrackingPolicy(cast(Any, teacher), spec)
