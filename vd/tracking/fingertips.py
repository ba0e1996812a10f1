"""Where the fingertips are and how they move, from the joints.

G fingers, D joints, as many of each finger. World frame: z up; quaternions xyzw.
"""

import numpy as np
import torch

from vd.assets_usd.hand_data import HandModel, compose, invert
from vd.kernels.task.observations import FINGERTIP_VALUES
from vd.quaternions import product, rotated


class Fingertips:
    """Poses and velocities of a hand's fingertips, as a teacher observes them, in this precision.

    Raises:
        ValueError: Its fingers differ, or its joints are no chains from the base to each fingertip.
    """

    def __init__(
        self, hand: HandModel, device: str | torch.device = "cpu", *, dtype: torch.dtype = torch.float32
    ) -> None:
        order = np.arange(hand.num_joints).reshape(-1, hand.joints_per_finger)
        frames = np.empty((len(order), hand.joints_per_finger + 1, 7))
        for finger, joints in enumerate(order):
            before, links = hand.mount, [0, *hand.joint_child[joints]]
            if list(hand.joint_parent[joints]) != links[:-1] or hand.tip_link[finger] != links[-1]:
                raise ValueError(f"the joints of finger {finger} of {hand.name} are no chain to its tip")
            for number, joint in enumerate(joints):
                frames[finger, number] = compose(before, hand.joint_parent_frame[joint])
                before = invert(hand.joint_child_frame[joint])
            frames[finger, -1] = compose(before, hand.tip_frame[finger])
        # From each joint's frame, turned, to the next one's: of the first from the world, at the end the tip.
        self._frame = torch.tensor(frames, dtype=dtype, device=device)
        self._axis = torch.tensor(hand.joint_axis[order], dtype=dtype, device=device)

    def __call__(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Position [m], quaternion, velocity [m/s] and angular velocity [rad/s] of each fingertip in turn.

        Joint positions [rad] and velocities [rad/s] are [N, D]; columns [N, 13 G] as of
        :func:`vd.kernels.task.observations.teacher_observation_slices`.
        """
        shape = (len(position), *self._axis.shape[:2], 1)
        half, rate = 0.5 * position.reshape(shape), velocity.reshape(shape)
        turn = torch.cat([self._axis * half.sin(), half.cos()], dim=-1)
        pose = self._frame[:, 0].expand(len(position), -1, -1)
        spin, moment = torch.zeros_like(pose[..., :3]), torch.zeros_like(pose[..., :3])
        for joint in range(self._axis.shape[1]):
            place, orientation = pose[..., :3], product(pose[..., 3:], turn[..., joint, :])
            axis = rate[..., joint, :] * rotated(orientation, self._axis[:, joint].expand_as(place))
            spin, moment = spin + axis, moment + torch.linalg.cross(axis, place)
            following = self._frame[:, joint + 1].expand_as(pose)
            place = place + rotated(orientation, following[..., :3])
            pose = torch.cat([place, product(orientation, following[..., 3:])], dim=-1)
        # Each joint moves the tip by its axis x (tip - joint).
        linear = torch.linalg.cross(spin, pose[..., :3]) - moment
        values = torch.cat([pose, linear, spin], dim=-1)
        return values.reshape(len(position), FINGERTIP_VALUES * len(self._axis))
