"""Where the fingertips are and how they move, from the joints.

G fingers, D joints, as many of each finger. World frame: z up; quaternions xyzw.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vd.assets_usd.hand_data import HandModel, compose, invert
from vd.geometry.quaternions import product, rotated
from vd.kernels.task.observations import FINGERTIP_VALUES


class Fingertips:
    """Poses and velocities of a hand's fingertips, as a teacher observes them.

    Args:
        hand: The hand.
        array: Makes tensors of the device and precision in which joints are given.

    Raises:
        ValueError: Its fingers differ, or its joints are no chains from the base to each fingertip.
    """

    def __init__(self, hand: HandModel, array: Callable[[Any], Tensor]) -> None:
        order = np.arange(hand.num_joints).reshape(-1, hand.joints_per_finger)
        frames = np.empty((len(order), hand.joints_per_finger + 1, 7))
        for finger, joints in enumerate(order):
            before = hand.mount
            links = [0, *hand.joint_child[joints]]
            if list(hand.joint_parent[joints]) != links[:-1] or hand.tip_link[finger] != links[-1]:
                raise ValueError(
                    f"the joints of finger {finger} of {hand.name} are no chain to its tip"
                )
            for number, joint in enumerate(joints):
                frames[finger, number] = compose(before, hand.joint_parent_frame[joint])
                before = invert(hand.joint_child_frame[joint])
            frames[finger, -1] = compose(before, hand.tip_frame[finger])
        # From each joint's frame, turned, to the next one's: of the first from the world, at the
        # end the tip.
        self._frame = array(frames)
        self._axis = array(hand.joint_axis[order])

    def __call__(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Position [m], quaternion, velocity [m/s] and angular velocity [rad/s] of each fingertip in turn.

        Joint positions [rad] and velocities [rad/s] are [N, D]; columns [N, 13 G] as of
        :func:`vd.kernels.task.observations.teacher_observation_slices`.
        """
        shape = (len(position), *self._axis.shape[:2], 1)
        half = 0.5 * position.reshape(shape)
        rate = velocity.reshape(shape)
        turn = torch.cat([self._axis * torch.sin(half), torch.cos(half)], dim=-1)
        pose = torch.broadcast_to(self._frame[:, 0], (len(position), *self._frame[:, 0].shape))
        spin = torch.zeros_like(pose[..., :3])
        moment = torch.zeros_like(pose[..., :3])
        for joint in range(self._axis.shape[1]):
            place = pose[..., :3]
            orientation = product(pose[..., 3:], turn[..., joint, :])
            axis = rate[..., joint, :] * rotated(orientation, self._axis[None, :, joint])
            spin = spin + axis
            moment = moment + torch.linalg.cross(axis, place)
            following = self._frame[None, :, joint + 1]
            place = place + rotated(orientation, following[..., :3])
            pose = torch.cat([place, product(orientation, following[..., 3:])], dim=-1)
        # Each joint moves the tip by its axis x (tip - joint).
        linear = torch.linalg.cross(spin, pose[..., :3]) - moment
        values = torch.cat([pose, linear, spin], dim=-1)
        return values.reshape(len(position), FINGERTIP_VALUES * len(self._axis))
