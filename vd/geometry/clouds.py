"""Point clouds and link poses of hands, from joint positions."""

from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import HandModel
from vd.kernels.launch import launch
from vd.kernels.sensor.kinematics import Joints, forward_kinematics_kernel, link_points_kernel


class HandCloud:
    """Links and clouds of a hand, on the device; samples come from its USD.

    Args:
        hand: The hand.
        link_body: Column of each link in the poses, base first, shape [L].
        device: Warp device.

    Attributes:
        count: H, points of a cloud.
    """

    def __init__(self, hand: HandModel, *, link_body: np.ndarray, device: str):
        points = hand.link_points
        body = np.repeat(link_body[hand.point_link], points.shape[1])
        base = int(link_body[0])
        self.count = len(body)

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._samples = [array(points.reshape(-1, 3), wp.vec3), array(body, wp.int32), base]
        joints = Joints()
        joints.parent = array(link_body[hand.joint_parent], wp.int32)
        joints.child = array(link_body[hand.joint_child], wp.int32)
        joints.axis = array(hand.joint_axis, wp.vec3)
        joints.parent_frame = array(hand.joint_parent_frame, wp.transform)
        joints.child_frame = array(hand.joint_child_frame, wp.transform)
        self._joints = [joints, base, wp.transform(*map(float, hand.mount))]

    def pose(self, joint_q: wp.array, body_q: wp.array) -> None:
        """Write link poses in the world frame, shape [N, B], for positions [rad], shape [N, >= D]."""
        launch(forward_kinematics_kernel, joint_q.shape[0], [*self._joints, joint_q], [body_q])

    def __call__(self, body_q: wp.array) -> wp.array:
        """Points in the base frame [m] [R, H] for poses in the world frame [R, B]."""
        points = wp.empty((body_q.shape[0], self.count), dtype=wp.vec3, device=body_q.device)
        launch(link_points_kernel, points.shape, [*self._samples, body_q], [points])
        return points
