"""Where the fingertips are and how they move, from the joints: what a student need not estimate.

G fingers, D joints, three of each finger. World frame: z up; quaternions xyzw.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from vd.assets_usd.hand_data import HandModel, compose, invert
from vd.kernels.observations import FINGERTIP_VALUES, JOINTS_PER_FINGER
from vd.student.quaternions import product, rotated


class Fingertips(nn.Module):
    """Poses and velocities of a hand's fingertips, as its teacher observes them.

    The geometry is part of the weights, so that a student's file holds that of its hand; zero until
    :meth:`adopt`.

    Args:
        num_actions: D.
    """

    frame: torch.Tensor
    axis: torch.Tensor

    def __init__(self, num_actions: int) -> None:
        super().__init__()
        fingers = num_actions // JOINTS_PER_FINGER
        # From each joint's frame, turned, to the next one's: of the first from the world, at the end the tip.
        self.register_buffer("frame", torch.zeros(fingers, JOINTS_PER_FINGER + 1, 7))
        self.register_buffer("axis", torch.zeros(fingers, JOINTS_PER_FINGER, 3))

    def adopt(self, hand: HandModel, base: Sequence[float]) -> None:
        """Take over the geometry of a hand.

        Args:
            hand: The hand.
            base: Pose of its base in the world frame, position [m] and quaternion xyzw, [7].

        Raises:
            ValueError: Its joints are no chains of three from the base to each fingertip.
        """
        order = np.arange(hand.num_joints).reshape(-1, JOINTS_PER_FINGER)
        if len(order) != len(self.axis):
            raise ValueError(f"{hand.name} has {len(order)} fingers, the student {len(self.axis)}")
        for finger, joints in enumerate(order):
            before, links = np.asarray(base, dtype=float), [0, *hand.joint_child[joints]]
            if list(hand.joint_parent[joints]) != links[:-1] or hand.tip_link[finger] != links[-1]:
                raise ValueError(f"the joints of finger {finger} of {hand.name} are no chain to its tip")
            frames = []
            for joint in joints:
                frames.append(compose(before, hand.joint_parent_frame[joint]))
                before = invert(hand.joint_child_frame[joint])
            frames.append(compose(before, hand.tip_frame[finger]))
            self.frame[finger] = torch.from_numpy(np.stack(frames))
            self.axis[finger] = torch.from_numpy(hand.joint_axis[joints])

    def forward(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Position [m], quaternion, velocity [m/s] and angular velocity [rad/s] of each fingertip in turn.

        Args:
            position: Joint positions [rad], shape [.., D].
            velocity: Joint velocities [rad/s], shape [.., D].

        Returns:
            Columns as of :func:`vd.kernels.observations.teacher_observation_slices`, shape [.., 13 G].
        """
        shape = position.shape[:-1]
        half = 0.5 * position.reshape(*shape, *self.axis.shape[:2], 1)
        turn = torch.cat([self.axis * half.sin(), half.cos()], dim=-1)
        rate = velocity.reshape(*shape, *self.axis.shape[:2], 1)
        pose = self.frame[:, 0].expand(*shape, -1, -1)
        spin, moment = torch.zeros_like(pose[..., :3]), torch.zeros_like(pose[..., :3])
        for joint in range(turn.shape[-2]):
            place, orientation = pose[..., :3], product(pose[..., 3:], turn[..., joint, :])
            axis = rate[..., joint, :] * rotated(orientation, self.axis[:, joint].expand_as(place))
            spin, moment = spin + axis, moment + torch.linalg.cross(axis, place)
            following = self.frame[:, joint + 1].expand_as(pose)
            place = place + rotated(orientation, following[..., :3])
            pose = torch.cat([place, product(orientation, following[..., 3:])], dim=-1)
        # Each joint moves the tip by its axis x (tip - joint).
        velocity = torch.linalg.cross(spin, pose[..., :3]) - moment
        values = torch.cat([pose, velocity, spin], dim=-1)
        return values.reshape(*shape, FINGERTIP_VALUES * len(self.axis))
