"""Students at work: what they believe and remember from step to step, in a simulator or on a robot."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from vd.assets_usd.hand_data import HandModel
from vd.geometry.quaternions import product, rotated
from vd.policy.contract import Contract, Contracted, StudentSpec
from vd.policy.senses import CameraDecision, Senses
from vd.vision.student import Belief, InputBuilder, Student, StudentInput, StudentOutput


@dataclass(frozen=True)
class StudentPolicy(Contracted):
    """A student, which acts on what it sees by itself.

    Attributes:
        network: The network, in evaluation mode and without gradients.
        contract: All else, in ``contract.student``.
    """

    network: Student
    contract: Contract
    kind: Literal["student"] = "student"

    @property
    def spec(self) -> StudentSpec:
        """How it sees, and when it stops."""
        assert self.contract.student is not None
        return self.contract.student


class ActingStudent:
    """A student on N hands, with what it believes and remembers of each.

    Args:
        network: The network.
        hand: The hand.
        goals: Clouds of the goals, in the objects' frames and of true size [m] [N, P, 3].

    Attributes:
        build: Makes what the network reads.
        belief: Where the objects are believed to be, for the next step.
        hidden: Memory for the next step [N, G].
    """

    def __init__(self, network: Student, hand: HandModel, goals: Tensor):
        self.network = network
        self.build = InputBuilder(hand, goals)
        upright = goals.new_tensor([0.0, 0.0, 0.0, 1.0])
        self.belief = self.build.first_belief(upright.repeat(len(goals), 1))
        self.hidden = network.first_hidden(len(goals))
        mount = torch.tensor(hand.mount, dtype=torch.float32, device=goals.device)
        self._base = mount.repeat(len(goals), 1)

    @property
    def pose(self) -> Tensor:
        """Where the objects' frames are believed to be, base frame [N, 7]."""
        return self.build.pose_of(self.belief)

    def look(self, senses: Senses) -> StudentInput:
        """What the network reads; where an episode begins nothing is known from before."""
        fresh = senses.fresh[:, None]
        first = self.build.first_belief(senses.goal_quat)
        before = self.belief
        self.belief = Belief(
            rotation=torch.where(fresh[..., None], first.rotation, before.rotation),
            position=torch.where(fresh, first.position, before.position),
        )
        self.hidden = self.hidden.masked_fill(fresh, 0.0)
        return self.build(senses, self.belief)

    def decide(self, sight: StudentInput) -> StudentOutput:
        """What the network says, which is believed and remembered from then on."""
        output = self.network.act(sight, self.hidden)
        # One that strayed would have nothing in sight to come back by.
        self.belief = self.build.near_place(output.belief, self.network.cfg.reach_m)
        self.hidden = output.hidden
        return output

    @torch.no_grad()
    def step(self, senses: Senses) -> CameraDecision:
        """One control step."""
        output = self.decide(self.look(senses))
        pose = self.pose
        turn = self._base[:, 3:]
        return CameraDecision(
            action=output.mean,
            angle=output.log_distance.exp(),
            position=self._base[:, :3] + rotated(turn, pose[:, :3]),
            orientation=product(turn, pose[:, 3:]),
            voxels=output.voxels,
        )
