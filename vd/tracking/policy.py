"""Tracking policies in files: a teacher, and how it is let act on what a camera shows."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from vd.config import Dropped, from_dict, to_dict
from vd.policy import TrainedPolicy, holds, policy_of, read_state
from vd.sensors.cfg import DepthCameraCfg
from vd.stopping import StoppingRules

TRACKING_FORMAT = "visual-dexterity tracking 1"


@dataclass(frozen=True, kw_only=True)
class TrackingSpec(StoppingRules):
    """What a tracking policy is besides its teacher."""

    RETIRED: ClassVar[dict[str, Any]] = {"aim": {"enabled": Dropped(False)}}
    teacher: str = ""
    """Name of that teacher."""
    camera: tuple[float, ...] | None = None
    """Pose of the optical frame in the base frame, position [m] and quaternion xyzw; None: the hand's."""
    depth: DepthCameraCfg = field(default_factory=DepthCameraCfg)
    """Points and crop of the camera's clouds."""


@dataclass(frozen=True)
class TrackingPolicy:
    """A teacher that acts on a camera's view of an object of known shape; it has learned nothing itself.

    Attributes:
        teacher: Its layers, critic, and task.
        spec: All else.
    """

    kind: ClassVar[Literal["tracking"]] = "tracking"
    teacher: TrainedPolicy
    spec: TrackingSpec

    @property
    def hand(self) -> str:
        """Name of the hand it moves."""
        return self.teacher.hand

    @property
    def num_actions(self) -> int:
        """Actions D."""
        return self.teacher.num_actions

    @property
    def task(self) -> dict[str, Any]:
        """Configuration of the environment its teacher was trained in."""
        return self.teacher.task


def is_tracking(path: Path) -> bool:
    """Whether a file is a tracking policy, as far as it can be read."""
    return holds(path, "tracking")


def tracking_export(policy: TrackingPolicy) -> dict[str, Any]:
    """What :func:`load_tracking` reads."""
    teacher = policy.teacher
    parts = {"actor_state_dict": teacher.weights, "critic_state_dict": teacher.critic_weights}
    weights = {key: {name: v.cpu() for name, v in part.items()} for key, part in parts.items() if part}
    return {
        "format": TRACKING_FORMAT,
        "tracking": to_dict(policy.spec),
        "teacher_state_dict": {
            "policy": to_dict(teacher.spec),
            "task": teacher.task,
            "iter": teacher.iteration,
            "env_steps": teacher.env_steps,
            **weights,
        },
    }


def load_tracking(path: str | Path, device: str = "cpu") -> TrackingPolicy:
    """Read a tracking policy.

    Args:
        path: The file that ``vd-train tracker`` wrote.
        device: Torch device.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or of another version.
    """
    state = read_state(path, device, remedy="copy it again, or write it anew with vd-train tracker")
    try:
        return TrackingPolicy(
            policy_of(state["teacher_state_dict"], device), from_dict(TrackingSpec, state["tracking"])
        )
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}; write it anew with vd-train tracker") from error
