"""Policies by camera in files: a teacher, and how it is let act on what a camera shows.

Tracking policies find the object by its known shape, vision policies by a network that was trained
for it.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from vd.config import Dropped, from_dict, to_dict
from vd.sensors.cfg import DepthCameraCfg
from vd.stopping import StoppingRules
from vd.vision.cfg import AlignmentCfg

if TYPE_CHECKING:
    from vd.policy import TrainedPolicy
    from vd.vision.alignment import AlignmentNetwork

TRACKING_FORMAT = "visual-dexterity tracking 1"


@dataclass(frozen=True, kw_only=True)
class TrackingSpec(StoppingRules):
    """What a tracking policy is besides its teacher."""

    RETIRED: ClassVar[dict[str, Any]] = {"aim": {"enabled": Dropped(False)}}
    teacher: str = ""
    """Name of that teacher."""
    camera: tuple[float, ...] | None = None
    """Pose of the optical frame in the base frame, position [m] and quaternion xyzw; None: the
    hand's.
    """
    depth: DepthCameraCfg = field(default_factory=DepthCameraCfg)
    """Points and crop of the camera's clouds."""
    alignment: AlignmentCfg | None = None
    """Sizes of the network that finds the object by the cloud of its goal; None: it is found by its
    shape.
    """


@dataclass(frozen=True)
class TrackingPolicy:
    """A teacher that acts on a camera's view of an object.

    Its layers have learned nothing for that.

    Attributes:
        teacher: Its layers, critic, and task.
        spec: All else.
        alignment: Finds the object by the cloud of its goal; None: it is found by its known shape.
    """

    teacher: "TrainedPolicy"
    spec: TrackingSpec
    alignment: "AlignmentNetwork | None" = None

    @property
    def kind(self) -> Literal["tracking", "vision"]:
        """What it is called."""
        return "tracking" if self.alignment is None else "vision"

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


def tracking_export(policy: TrackingPolicy) -> dict[str, Any]:
    """What :func:`read_policy` reads."""
    teacher = policy.teacher
    network = policy.alignment
    own = {} if network is None else {name: v.cpu() for name, v in network.state_dict().items()}
    return {
        "format": TRACKING_FORMAT,
        "tracking": to_dict(policy.spec),
        "teacher_state_dict": {
            "policy": to_dict(teacher.spec),
            "task": teacher.task,
            "iter": teacher.iteration,
            "env_steps": teacher.env_steps,
            "actor_state_dict": {name: v.cpu() for name, v in teacher.weights.items()},
        },
        **({"alignment_state_dict": own} if own else {}),
    }


def read_policy(path: str | Path, device: str = "cpu") -> "TrainedPolicy | TrackingPolicy":
    """The policy in a file: by camera, of vd-train tracker, or a teacher (:func:`vd.policy.load_policy`).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, no policy, or of another version.
    """
    from vd.policy import REMEDY, policy_of, read_state, teacher_in
    from vd.vision.saved import alignment_network

    state = read_state(path, device, remedy=REMEDY)
    if "tracking" not in state:
        return teacher_in(state, path, device)
    try:
        spec, network = from_dict(TrackingSpec, state["tracking"]), None
        if spec.alignment is not None:
            network = alignment_network(spec.alignment, state["alignment_state_dict"], device)
        return TrackingPolicy(policy_of(state["teacher_state_dict"], device), spec, network)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}; write it anew with vd-train tracker") from error
