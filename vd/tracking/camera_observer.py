"""From joints and a camera's points to what a teacher would observe.

Of the simulator and of a robot alike.

The object is found among the camera's points and followed: by its known shape
(:mod:`vd.tracking.registration`), or by the cloud of its goal alone (:mod:`vd.vision.finder`).

N hands, D joints, G fingers, K camera points. World frame unless said otherwise: z up; metres,
radians, quaternions xyzw.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.envs.shapes import ShapeObserver
from vd.geometry.arrays import Array, as_warp, library_of, of_warp
from vd.geometry.clouds import HandCloud
from vd.geometry.quaternions import (
    canonical,
    product,
    relative_rotation,
    rotated,
    rotation_distance,
)
from vd.kernels.task.observations import teacher_observation_size, teacher_observation_slices
from vd.paper import PAPER
from vd.policy.senses import Senses
from vd.tracking.fingertips import Fingertips
from vd.tracking.object_points import object_points
from vd.tracking.registration import Registration
from vd.tracking.symmetry import nearest_goal, symmetries_of_worlds

if TYPE_CHECKING:
    from vd.vision.alignment import AlignmentNetwork
    from vd.vision.finder import GoalFinder

UNSEEN = ("object_orientation", "goal_orientation")
"""Orientations in the axes of the object's file, which no camera shows: zeros stand for them."""
AGES_S = (0.0, 0.035, 0.07)
"""How old what a camera shows of a moving hand may be [s]: known shapes are found beside fingers
too, clouds are not."""
LEAP_RAD = 0.5
"""A larger turn in one step is another belief, not a motion."""


@dataclass(frozen=True)
class Found:
    """The object as it is found."""

    orientation: Array
    """[N, 4]."""
    position: Array
    """[m] [N, 3]."""
    velocity: Array
    """[m/s] [N, 3]; zero where it is not known."""
    spin: Array
    """Angular velocity [rad/s] [N, 3]; zero where it is not known."""
    voxels: Array
    """How much is seen of it: voxels of the camera's points that are not the hand's, int32 [N]."""


class CameraObserver:
    """Follows the object of each hand, and makes of it and of the joints a teacher's observation.

    Args:
        hand: The hand.
        objects: The objects, as their shapes are known; with ``alignment`` only their surface
            points count.
        num_observations: O, values that the teacher observes: its state, and with more the object's
            shape.
        world_object: Object of each hand [N].
        world_scale: Size factor of each hand's object [N].
        camera: What sees them, posed in the base frame.
        control_hz: Control steps a second.
        alignment: Finds objects by their goals' clouds; None: they are found by their shapes.
        device: Warp device.
        library: Of its arrays, torch or on a CPU numpy; those of ``alignment`` are torch's.
    """

    def __init__(
        self,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        num_observations: int,
        *,
        world_object: np.ndarray,
        world_scale: np.ndarray,
        camera: CameraModel,
        control_hz: float,
        alignment: "AlignmentNetwork | None" = None,
        device: str,
        library: Any,
    ):
        self._hand = hand
        self._rate = control_hz
        self._device = device
        place = wp.device_to_torch(device)
        links = np.arange(len(hand.link_names))

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        def own(values: Any) -> Array:
            return library.asarray(values, dtype=library.float32, device=place, copy=True)

        self._hand_cloud = HandCloud(hand, link_body=links, device=device)
        self._ages = (0.0,) if alignment is None else AGES_S
        self.finder: Registration | GoalFinder
        symmetry = np.tile([0.0, 0.0, 0.0, 1.0], (len(world_object), 1, 1))
        if alignment is None:
            self.finder = Registration(
                objects,
                world_object=world_object,
                world_scale=world_scale,
                camera=camera,
                device=device,
                library=library,
            )
            symmetry = symmetries_of_worlds(objects, world_object, device)
        else:
            from vd.vision import finder

            self.finder = finder.GoalFinder(
                alignment, objects, world_object=world_object, world_scale=world_scale
            )
        self._symmetry = own(symmetry)
        self._before = own(self.finder.pose[:, 0])
        self._fingertips = Fingertips(hand, own)
        self._links = wp.empty((len(world_object), len(links)), dtype=wp.transform, device=device)
        self._past_links = wp.empty_like(self._links)
        self._base = own(hand.mount[None])
        self._lower = own(hand.lower)
        self._upper = own(hand.upper)
        self._columns = teacher_observation_slices(hand.num_fingers, hand.num_joints)
        self._size = num_observations
        state = teacher_observation_size(hand.num_fingers, hand.num_joints)
        self._columns["shape"] = slice(state, num_observations)
        self._shapes = ShapeObserver(
            array(np.stack([item.surface_points for item in objects]), wp.vec3),
            array(world_object, wp.int32),
            array(world_scale, float),
            array(hand.tip_link, wp.int32),
            array(hand.tip_frame, wp.transform),
        )
        known = own(np.ones(num_observations))
        for name in UNSEEN:
            known[self._columns[name]] = 0.0
        self.found: Found | None = None
        """What was found at the last look."""
        self.known = known
        """1 for the values that are observed, 0 for those of :data:`UNSEEN` [O]."""

    def __call__(self, senses: Senses) -> tuple[Array, Array]:
        """Look once.

        Returns:
            The teacher's observation in the world frame [N, O], and how far the object is expected
            to be from its goal [rad] [N]. Of the orientations in which a known shape looks like the
            wanted one (:mod:`.symmetry`) the nearest is the goal: which of them it is, nobody can
            see.
        """
        self._hand_cloud.pose(as_warp(senses.joint_q), self._links)
        found = self.found = self._find(senses)
        goal = nearest_goal(found.orientation, senses.goal_quat, self._symmetry)
        angle = rotation_distance(found.orientation, goal)
        parts = {
            "joint_position": 2.0 * (senses.joint_q - self._lower) / (self._upper - self._lower)
            - 1.0,
            "joint_velocity": PAPER.observation.velocity_scale * senses.joint_qd,
            "object_position": found.position,
            "object_velocity": found.velocity,
            "object_spin": PAPER.observation.velocity_scale * found.spin,
            "relative_orientation": canonical(relative_rotation(found.orientation, goal)),
            "fingertips": self._fingertips(senses.joint_q, senses.joint_qd),
            "previous_action": senses.action,
        }
        xp = library_of(angle)
        observation = xp.zeros((len(angle), self._size), dtype=xp.float32, device=angle.device)
        if (first := self._columns["shape"].start) < self._size:
            pose = as_warp(xp.concatenate([found.position, found.orientation], axis=1))
            self._shapes.observe(
                pose, 0, self._links, as_warp(goal, wp.quat), as_warp(observation), first
            )
        for name, values in parts.items():
            observation[:, self._columns[name]] = values
        return observation, angle

    def _hand_points(self, age: float, senses: Senses) -> Array:
        """The hand's own points as they were so long ago [s], base frame [N, H, 3]."""
        links = self._links
        if age > 0.0:
            links = self._past_links
            joints = senses.joint_q - age * senses.joint_qd
            self._hand_cloud.pose(as_warp(joints), links)
        return of_warp(self._hand_cloud(links), library_of(senses.joint_q))

    def _find(self, senses: Senses) -> Found:
        """Find the objects among the camera's points, or follow them; links are posed."""
        followed = self.finder
        before = self._before
        xp = library_of(senses.points)
        cloud = [*(self._hand_points(age, senses) for age in self._ages), senses.points]
        hand = len(self._ages) * self._hand_cloud.count
        seen, count = object_points(
            xp.concatenate(cloud, axis=1), hand, PAPER.cloud.voxel_m, followed.most
        )
        pose = followed.pose[:, 0]
        turn = self._base[:, 3:]
        if isinstance(followed, Registration):
            followed.look(seen, count, fresh=senses.fresh, points=senses.points)
        else:
            followed.look(seen, count, fresh=senses.fresh)
        # A first look knows no motion.
        known = (followed.looks > 1) & (rotation_distance(pose[:, 3:], before[:, 3:]) < LEAP_RAD)
        moves = self._rate * xp.asarray(known[:, None], dtype=xp.float32)
        step = relative_rotation(pose[:, 3:], before[:, 3:])
        found = Found(
            orientation=product(turn, pose[:, 3:]),
            position=self._base[:, :3] + rotated(turn, pose[:, :3]),
            velocity=moves * rotated(turn, pose[:, :3] - before[:, :3]),
            spin=moves
            * 2.0
            * rotated(turn, step[:, :3] * xp.sign(step[:, 3:])),  # of a small angle
            voxels=count,
        )
        before[:] = pose
        return found
