"""Point clouds of hands, objects and goals in the hand's base frame, from poses or joint positions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.kernels.sensor.kinematics import Joints, forward_kinematics_kernel
from vd.kernels.sensor.link_points import CloudModel, link_points_kernel
from vd.paper import PAPER


class SceneClouds:
    """Complete synthetic clouds of N environments in the hand's base frame.

    Columns of a cloud are the goal's K samples, the hand's H, and the object's K; samples come from the
    USD of hand and objects. Rows are poses of any environments: of all at one time, or recorded ones.

    Attributes:
        goal: Columns of the goal.
        hand: Columns of the hand.
        item: Columns of the object.
        ends: Columns at which goal and hand end.
    """

    def __init__(
        self,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        *,
        link_body: np.ndarray,
        object_body: int,
        world_object: np.ndarray,
        world_scale: np.ndarray,
        device: str,
        goals: Sequence[ObjectModel] | None = None,
    ):
        """Put the samples on the device.

        Args:
            hand: The hand.
            objects: The objects; without any the cloud is the hand's alone.
            link_body: Body of each link of the hand, an index within a world, base first, shape [L].
            object_body: Body of the object, an index within a world.
            world_object: Object of each environment, shape [N].
            world_scale: Size factor of each environment's object, shape [N].
            device: Warp device.
            goals: The objects as their goals are shown; as they are by default.
        """
        points = hand.link_points
        count = points.shape[0] * points.shape[1]
        surfaces, shown = (
            np.stack([item.surface_points for item in items]) if items else np.zeros((1, 0, 3))
            for items in (objects, goals or objects)
        )
        samples = surfaces.shape[1]
        self.goal = slice(0, samples)
        self.hand = slice(samples, samples + count)
        self.item = slice(samples + count, count + 2 * samples)
        self.ends = (self.goal.stop, self.hand.stop)
        self.device = device

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        model = CloudModel()
        model.hand_points = array(points.reshape(-1, 3), wp.vec3)
        model.hand_body = array(np.repeat(np.asarray(link_body)[hand.point_link], points.shape[1]), wp.int32)
        model.object_points, model.goal_points = array(surfaces, wp.vec3), array(shown, wp.vec3)
        model.world_object = array(world_object, wp.int32)
        model.world_scale = array(world_scale, float)
        model.base_body, model.object_body = int(link_body[0]), int(object_body)
        model.goal_position = wp.vec3(*PAPER.cloud.goal_position_m)
        self._model = model
        self._all_worlds = array(np.arange(len(world_object)), wp.int32)

    def write(
        self,
        points: wp.array,
        body_q: wp.array,
        goal_quat: wp.array,
        *,
        with_object: bool = True,
        envs: wp.array | None = None,
    ) -> None:
        """Write clouds, in one launch that a CUDA graph can hold.

        Args:
            points: Takes the points [m], shape [R, *]; columns beyond those written stay.
            body_q: Body poses in the world frame, shape [R, B].
            goal_quat: Wanted orientations in the world frame, shape [R].
            with_object: Write the object too; without it its columns are left to a camera's points.
            envs: Environment of each row, shape [R]; row i is of environment i by default.
        """
        columns = self.item.stop if with_object else self.item.start
        wp.launch(
            link_points_kernel,
            dim=(body_q.shape[0], columns),
            inputs=[self._model, self._all_worlds if envs is None else envs, body_q, goal_quat],
            outputs=[points],
            device=self.device,
        )


class HandKinematics:
    """Poses of a hand's links from joint positions, on the device, in place of a simulator's."""

    def __init__(self, hand: HandModel, *, link_body: np.ndarray, base: Sequence[float], device: str):
        """Put the joints on the device.

        Args:
            hand: The hand.
            link_body: Column of each link in the poses, base first, shape [L].
            base: Pose of the base in the world frame: position [m], quaternion xyzw, [7].
            device: Warp device.
        """
        self.device = device

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        joints = Joints()
        joints.parent = array(np.asarray(link_body)[hand.joint_parent], wp.int32)
        joints.child = array(np.asarray(link_body)[hand.joint_child], wp.int32)
        joints.axis = array(hand.joint_axis, wp.vec3)
        joints.parent_frame = array(hand.joint_parent_frame, wp.transform)
        joints.child_frame = array(hand.joint_child_frame, wp.transform)
        self._joints, self._base_body = joints, int(link_body[0])
        self._base = wp.transform(*(float(value) for value in base))

    def write(self, joint_q: wp.array, body_q: wp.array) -> None:
        """Write link poses in the world frame, shape [N, B], for positions [rad], shape [N, >= D]."""
        wp.launch(
            forward_kinematics_kernel,
            dim=joint_q.shape[0],
            inputs=[self._joints, self._base_body, self._base, joint_q],
            outputs=[body_q],
            device=self.device,
        )
