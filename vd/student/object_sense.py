"""What a student knows of its object once that is found: pose, motion, and the surface.

The object is found among the voxels that the network reads (:mod:`vd.student.registration`). N worlds, G
fingers. World frame unless said otherwise: z up; quaternions xyzw. Of the orientations that look like the
wanted one (:mod:`vd.student.symmetry`) the nearest is the goal: which of them it is, nobody can see.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.aim import AimCfg
from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.kernels.aim import aim_kernel
from vd.kernels.observations import (
    JOINTS_PER_FINGER,
    teacher_observation_size,
    teacher_observation_slices,
)
from vd.kernels.shapes import (
    ORIENTATIONS,
    extent_directions,
    extent_kernel,
    shape_observation_size,
    shape_observation_slices,
    surface_kernel,
)
from vd.paper import PAPER
from vd.student.quaternions import canonical, product, relative_rotation, rotated, rotation_distance
from vd.student.registration import FAR_M, POINTS, Registration
from vd.student.sites import Sites
from vd.student.symmetry import nearest_goal, symmetries_of_worlds

ANGLE = 0
"""Column of the angle to the goal [rad]."""
ROTATION = slice(1, 5)
"""Columns of the rotation from the goal, q_object conj(q_goal)."""
PLACE_M = 0.1
"""Unit of positions [m]."""
LEAP_RAD = 0.5
"""A larger turn in one step is another belief, not a motion."""
STATE_VALUES = 16
"""Angle to the goal, rotation from it (4), position (3), velocity (3), spin (3), misfit, and its share of
that of the next pose."""
TINY_M2 = 1e-9
"""A misfit smaller than any."""


def object_values(num_actions: int) -> int:
    """Values of the sense for a hand of so many joints."""
    return STATE_VALUES + shape_observation_size(num_actions // JOINTS_PER_FINGER)


def observed(num_actions: int, columns: int) -> tuple[list[int], list[int], list[float]]:
    """What of a teacher's observation, of so many columns, the sense tells.

    Returns:
        Columns of the observation, in the world frame, the columns of the sense that tell them, and the
        factors from these to those.
    """
    fingers = num_actions // JOINTS_PER_FINGER
    parts, first = teacher_observation_slices(fingers), teacher_observation_size(fingers)
    told = [
        (range(parts["relative_orientation"].start, parts["relative_orientation"].stop), 1, 1.0),
        (range(parts["object_position"].start, parts["object_position"].stop), 5, PLACE_M),
        (range(parts["object_velocity"].start, parts["object_velocity"].stop), 8, PLACE_M),
        (range(parts["object_spin"].start, parts["object_spin"].stop), 11, 1.0),
        (range(first, columns), STATE_VALUES, 1.0),
    ]
    rows = [(column, source + i, factor) for part, source, factor in told for i, column in enumerate(part)]
    return [row[0] for row in rows], [row[1] for row in rows], [row[2] for row in rows]


class ObjectSense:
    """Follows the object of each world and says what the teacher would want to know of it.

    Attributes:
        registration: Finds and follows it.
    """

    def __init__(
        self,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        *,
        link_body: np.ndarray,
        world_object: np.ndarray,
        world_scale: np.ndarray,
        camera: CameraModel | None,
        voxel_m: float,
        aim: AimCfg,
        device: str,
    ):
        """Put shapes and fingertips on the device.

        Args:
            hand: The hand.
            objects: The objects.
            link_body: Column of each link in the poses, base first, shape [L].
            world_object: Object of each world, shape [N].
            world_scale: Size factor of each world's object, shape [N].
            camera: What sees them, posed in the base frame; None where clouds are complete.
            voxel_m: Side of a voxel [m].
            aim: Where the goal is said to be while it is near.
            device: Warp device.
        """
        self.device, self._aim = device, aim
        self._symmetry = symmetries_of_worlds(objects, world_object, device)
        self._voxel_m, self._fingers, self._base = voxel_m, hand.num_fingers, int(link_body[0])
        self.registration = Registration(
            objects, world_object=world_object, world_scale=world_scale, camera=camera, device=device
        )

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._shapes = [
            array(np.stack([item.surface_points for item in objects]), wp.vec3),
            array(world_object, wp.int32),
            array(world_scale, float),
        ]
        self._tips = [
            array(np.asarray(link_body)[hand.tip_link], wp.int32),
            array(hand.tip_frame, wp.transform),
        ]
        self._directions = array(extent_directions(self._fingers), wp.vec3)
        self._before = self.registration.pose[:, 0].clone()

    def __call__(
        self,
        sites: Sequence[Sites],
        body_q: torch.Tensor,
        goal_quat: torch.Tensor,
        *,
        fresh: torch.Tensor,
        points: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Look at the object of every world, and say what is known of it.

        Args:
            sites: Voxels as the network reads them, of all worlds, without noise.
            body_q: Poses of the links, shape [N, B, 7].
            goal_quat: Wanted orientations, shape [N, 4].
            fresh: Where an episode begins, bool [N].
            points: What the camera sees, base frame [m], NaN for none, shape [N, K, 3].

        Returns:
            Angle to the goal [rad], rotation q_object conj(q_aimed) of at most half a turn, position
            [PLACE_M], velocity [PLACE_M / s], spin [rad/s, scaled as the teacher's], root of the misfit
            [FAR_M], the misfit as a share of that of the next pose, and the shape's values as the teacher
            observes them (:mod:`vd.kernels.shapes`): [N, V].
        """
        voxels, present = sites[0].places(sites[0].item, POINTS)
        count = present.sum(dim=(1, 2)).int()
        found = self.registration
        found.look(self._voxel_m * voxels, count, fresh=fresh, points=points)
        base, pose = body_q[:, self._base], found.pose[:, 0]
        turn = base[:, 3:]
        # A first look knows no motion.
        known = (found.looks > 1) & (rotation_distance(pose[:, 3:], self._before[:, 3:]) < LEAP_RAD)
        shift = rotated(turn, pose[:, :3] - self._before[:, :3])
        step = relative_rotation(pose[:, 3:], self._before[:, 3:])
        spin = 2.0 * rotated(turn, step[:, :3] * step[:, 3:].sign())  # of a small angle
        self._before.copy_(pose)
        orientation, position = product(turn, pose[:, 3:]), base[:, :3] + rotated(turn, pose[:, :3])
        goal_quat = nearest_goal(orientation, goal_quat, self._symmetry)
        angle = rotation_distance(orientation, goal_quat)[:, None]
        if self._aim.enabled:
            goal_quat = self._aimed(orientation, goal_quat)
        rotation = canonical(relative_rotation(orientation, goal_quat))
        rate, moves = PAPER.scene.control_hz, known[:, None].float()
        first, second = found.misfit[:, :1], found.misfit[:, 1:2]
        return torch.cat(
            [
                angle,
                rotation,
                position / PLACE_M,
                moves * shift * (rate / PLACE_M),
                moves * spin * (rate * PAPER.observation.velocity_scale),
                first.sqrt() / FAR_M,
                first / second.clamp(min=TINY_M2),
                self._shape(torch.cat([position, orientation], dim=1), body_q, goal_quat),
            ],
            dim=1,
        )

    def stateful(self) -> dict[str, wp.array]:
        """What another one needs to go on as this one would."""
        found = self.registration
        state = {"pose": found.pose, "misfit": found.misfit, "looks": found.looks, "before": self._before}
        return {f"object_{name}": wp.from_torch(value) for name, value in state.items()}

    def _aimed(self, orientation: torch.Tensor, goal_quat: torch.Tensor) -> torch.Tensor:
        """Orientations to aim at [N, 4], for those of objects and goals [N, 4]."""
        aimed = torch.empty_like(orientation)
        wp.launch(
            aim_kernel,
            dim=len(aimed),
            inputs=[
                self._aim.past_rad,
                self._aim.within_rad,
                0,
                wp.from_torch(orientation.contiguous()),
                wp.from_torch(goal_quat.contiguous(), dtype=wp.quat),
            ],
            outputs=[wp.from_torch(aimed, dtype=wp.quat)],
            device=self.device,
        )
        return aimed

    def _shape(self, pose: torch.Tensor, body_q: torch.Tensor, goal_quat: torch.Tensor) -> torch.Tensor:
        """The shape's values of poses [N, 7], as the environment computes those of true ones."""
        values = torch.empty((len(pose), shape_observation_size(self._fingers)), device=pose.device)
        slices = shape_observation_slices(self._fingers)
        where, out = wp.from_torch(pose.contiguous()), wp.from_torch(values)
        links = wp.from_torch(body_q.contiguous(), dtype=wp.transform)
        goal = wp.from_torch(goal_quat.contiguous(), dtype=wp.quat)
        for kernel, dim, part, model, read in (
            (surface_kernel, (len(pose), self._fingers), "surface", self._tips, links),
            (
                extent_kernel,
                (len(pose), ORIENTATIONS, len(self._directions)),
                "extent",
                [self._directions],
                goal,
            ),
        ):
            inputs = [*self._shapes, *model, 0, slices[part].start, where, read]
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=[out], device=self.device)
        return values
