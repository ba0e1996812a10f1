"""Vision policies: teachers that act on what a camera shows, in a simulator or on a robot."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ReorientCfg
from vd.geometry.frame_maps import FrameMaps
from vd.policy.contract import Contract, Contracted, VisionSpec
from vd.policy.senses import CameraDecision, Senses
from vd.vision.alignment import AlignmentNetwork
from vd.vision.camera_observer import CameraObserver

if TYPE_CHECKING:
    from vd.policy.actor import TrainedPolicy


@dataclass(frozen=True)
class VisionPolicy(Contracted):
    """A teacher that acts on a camera's view of an object.

    Its layers have learned nothing for that.

    Attributes:
        teacher: Its layers, critic, and task.
        contract: All else, in ``contract.tracking``.
        alignment: Finds the object by the cloud of its goal.
    """

    teacher: "TrainedPolicy"
    contract: Contract
    alignment: AlignmentNetwork
    kind: Literal["vision"] = "vision"

    @property
    def spec(self) -> VisionSpec:
        """How the teacher is let act."""
        assert self.contract.tracking is not None
        return self.contract.tracking


class ActingTeacher:
    """Finds the objects of N hands, and lets the teacher act on them.

    Args:
        policy: The policy, on the device of the goals.
        hand: The hand.
        goals: Clouds of the goals, in the objects' frames and of true size [m] [N, P, 3].

    Attributes:
        observer: Finds and follows the objects.
    """

    def __init__(self, policy: VisionPolicy, hand: HandModel, goals: Tensor):
        teacher = policy.teacher
        task = ReorientCfg.of(policy)
        self._teacher = teacher.network.to(goals.device)
        self.observer = CameraObserver(
            hand,
            policy.alignment,
            goals,
            num_observations=teacher.num_observations,
            control_hz=task.sim.control_hz,
        )
        self._maps: FrameMaps | None = None
        if task.observation.view != "world":
            self._maps = FrameMaps(hand, task.observation, goals.device)

    @property
    def pose(self) -> Tensor:
        """Where the objects' frames are believed to be, base frame [N, 7]."""
        return self.observer.finder.pose

    def step(self, senses: Senses) -> CameraDecision:
        """One control step: see, find, observe, choose a symmetry frame, act."""
        observation, angle = self.observer(senses)
        if self._maps is None:
            action = self._teacher(self._guessed(observation))
        else:
            frame = self._maps.choose(observation)  # in whose sector the goal is believed to lie
            action = self._teacher(self._guessed(self._maps.take(observation, frame)))
            action = self._maps.world_action(action, frame)
        found = self.observer.found
        assert found is not None
        return CameraDecision(action, angle, found.position, found.orientation, found.voxels)

    def _guessed(self, seen: Tensor) -> Tensor:
        """Observations as a frame shows them [N, O], with the teacher's mean for what no camera shows."""
        return torch.where(self.observer.known > 0.0, seen, self._teacher.offset)
