"""Point clouds of scenes, from poses or joint positions, and their voxels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.kernels.kinematics import Joints, forward_kinematics_kernel
from vd.kernels.link_points import CloudModel, link_points_kernel
from vd.kernels.rng import init_rng_kernel
from vd.kernels.voxels import CloudNoise, draw_noise, voxelise, voxelise_marked
from vd.paper import PAPER
from vd.student.cfg import NoiseCfg
from vd.student.sites import Sites


class SceneClouds:
    """Complete synthetic clouds of N worlds in the hand's base frame.

    Columns of a cloud are the goal's K samples, the hand's H, and the object's K; samples come from the
    USD of hand and objects. Rows are poses of any worlds: of all at one time, or recorded ones.

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
    ):
        """Put the samples on the device.

        Args:
            hand: The hand.
            objects: The objects.
            link_body: Body of each link of the hand, an index within a world, base first, shape [L].
            object_body: Body of the object, an index within a world.
            world_object: Object of each world, shape [N].
            world_scale: Size factor of each world's object, shape [N].
            device: Warp device.
        """
        points = hand.link_points
        count, samples = points.shape[0] * points.shape[1], objects[0].surface_points.shape[0]
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
        model.object_points = array(np.stack([item.surface_points for item in objects]), wp.vec3)
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
        worlds: wp.array | None = None,
    ) -> None:
        """Write clouds, in one launch that a CUDA graph can hold.

        Args:
            points: Takes the points [m], shape [R, *]; columns beyond those written stay.
            body_q: Body poses in the world frame, shape [R, B].
            goal_quat: Wanted orientations in the world frame, shape [R].
            with_object: Write the object too; without it its columns are left to a camera's points.
            worlds: World of each row, shape [R]; row i is of world i by default.
        """
        columns = self.item.stop if with_object else self.item.start
        wp.launch(
            link_points_kernel,
            dim=(body_q.shape[0], columns),
            inputs=[self._model, self._all_worlds if worlds is None else worlds, body_q, goal_quat],
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


class Voxeliser:
    """Points to voxels, with noise in training that every cloud draws for itself."""

    def __init__(
        self,
        voxel_m: float = PAPER.cloud.voxel_m,
        *,
        noise: NoiseCfg | None = None,
        clouds: int = 0,
        seed: int = 0,
        device: str = "cpu",
    ):
        """Prepare the noise.

        Args:
            voxel_m: Side of a voxel [m].
            noise: Noise of training; None where there will be none.
            clouds: Clouds of a training batch at most: each has a random stream.
            seed: Seed of the streams.
            device: Warp device.

        Raises:
            ValueError: For noise that cannot be drawn.
        """
        self.voxel_m = voxel_m
        self.device = device
        self._noise: wp.array | None = None
        self._ends: dict[tuple[int, ...], wp.array] = {}
        self.rng = wp.empty(clouds, dtype=wp.uint32, device=device)
        """Random stream of each cloud of a batch, shape [clouds]."""
        if noise is not None:
            noise.validate()
            values = CloudNoise()
            values.jitter_probability, values.jitter_std = noise.jitter_probability, noise.jitter_std_m
            values.dropout_probability = noise.dropout_probability
            values.dropout_ratio = wp.vec2(*noise.dropout_ratio)
            self._noise = wp.array([values], dtype=CloudNoise, device=device)
            wp.launch(init_rng_kernel, dim=clouds, inputs=[seed], outputs=[self.rng], device=device)

    def __call__(
        self, points: wp.array | torch.Tensor, *, augment: bool = False, ends: tuple[int, ...] = ()
    ) -> Sites:
        """Voxels of clouds.

        Args:
            points: Points [m], shape [B, P] of vectors, or [B, P, 3] as a tensor; those not finite count
                for nothing.
            augment: Add noise, as in training.
            ends: Columns at which groups of points end, one group after the other from the first column on.
                Voxels are marked by the groups of which they hold points (``marks`` of the result).

        Raises:
            ValueError: Noise is asked for where none was prepared, or for more clouds than were.
        """
        if isinstance(points, torch.Tensor):
            points = wp.from_torch(points, dtype=wp.vec3)
        clouds = points.shape[0]
        draw = None
        if augment:
            if self._noise is None or clouds > self.rng.shape[0]:
                raise ValueError(
                    f"no noise for {clouds} clouds: make the voxeliser with noise and as many clouds"
                )
            draw = draw_noise(self._noise, self.rng[:clouds])
        if not ends:
            return Sites(voxelise(points, self.voxel_m, draw), clouds)
        if ends not in self._ends:
            self._ends[ends] = wp.array(ends, dtype=wp.int32, device=self.device)
        keys, marks = voxelise_marked(points, self.voxel_m, self._ends[ends], draw)
        return Sites(keys, clouds, marks=wp.to_torch(marks))
