"""From joints and a camera's points to what a teacher would observe.

Of the simulator and of a robot alike. The object is found among the camera's points by the cloud of
its goal, and followed (:mod:`.finder`).

N hands, D joints, G fingers, K camera points. World frame unless said otherwise: z up; metres,
radians, quaternions xyzw.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from vd.assets_usd.hand_data import HandModel
from vd.envs.shapes import ShapeObserver
from vd.geometry.arrays import as_warp
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
from vd.vision.alignment import AlignmentNetwork
from vd.vision.finder import GoalFinder
from vd.vision.fingertips import Fingertips
from vd.vision.object_points import object_points

UNSEEN = ("object_orientation", "goal_orientation")
"""Orientations in the axes of the object's file, which no camera shows: zeros stand for them."""
AGES_S = (0.0, 0.035, 0.07)
"""How old what a camera shows of a moving hand may be [s]."""
LEAP_RAD = 0.5
"""A larger turn in one step is another belief, not a motion."""


@dataclass(frozen=True)
class Found:
    """The object as it is found."""

    orientation: Tensor
    """[N, 4]."""
    position: Tensor
    """[m] [N, 3]."""
    velocity: Tensor
    """[m/s] [N, 3]; zero where it is not known."""
    spin: Tensor
    """Angular velocity [rad/s] [N, 3]; zero where it is not known."""
    voxels: Tensor
    """How much is seen of it: voxels of the camera's points that are not the hand's, int32 [N]."""


class CameraObserver:
    """Follows the object of each hand, and makes of it and of the joints a teacher's observation.

    Args:
        hand: The hand.
        alignment: Finds objects by their goals' clouds.
        goals: These clouds, in the objects' frames and of true size [m] [N, P, 3].
        num_observations: O, values that the teacher observes: its state, and with more the object's
            shape.
        control_hz: Control steps a second.
    """

    def __init__(
        self,
        hand: HandModel,
        alignment: AlignmentNetwork,
        goals: Tensor,
        *,
        num_observations: int,
        control_hz: float,
    ):
        self._rate = control_hz
        device = str(goals.device)
        links = np.arange(len(hand.link_names))
        envs = len(goals)

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        def own(values: Any) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=goals.device)

        self._hand_cloud = HandCloud(hand, link_body=links, device=device)
        self.finder = GoalFinder(alignment, goals)
        self._before = self.finder.pose.clone()
        self._fingertips = Fingertips(hand, own)
        self._links = wp.empty((envs, len(links)), dtype=wp.transform, device=device)
        self._past_links = wp.empty_like(self._links)
        self._base = own(hand.mount[None])
        self._lower = own(hand.lower)
        self._upper = own(hand.upper)
        self._columns = teacher_observation_slices(hand.num_fingers, hand.num_joints)
        self._size = num_observations
        state = teacher_observation_size(hand.num_fingers, hand.num_joints)
        self._columns["shape"] = slice(state, num_observations)
        self._shapes = ShapeObserver(
            as_warp(goals, wp.vec3),
            array(np.arange(envs), wp.int32),
            array(np.ones(envs), float),
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

    def __call__(self, senses: Senses) -> tuple[Tensor, Tensor]:
        """Look once.

        Returns:
            The teacher's observation in the world frame [N, O], and how far the object is expected
            to be from its goal [rad] [N].
        """
        self._hand_cloud.pose(as_warp(senses.joint_q), self._links)
        found = self.found = self._find(senses)
        goal = senses.goal_quat
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
        observation = torch.zeros((len(angle), self._size), device=angle.device)
        if (first := self._columns["shape"].start) < self._size:
            pose = as_warp(torch.cat([found.position, found.orientation], dim=1))
            self._shapes.observe(
                pose, 0, self._links, as_warp(goal, wp.quat), as_warp(observation), first
            )
        for name, values in parts.items():
            observation[:, self._columns[name]] = values
        return observation, angle

    def _hand_points(self, age: float, senses: Senses) -> Tensor:
        """The hand's own points as they were so long ago [s], base frame [N, H, 3]."""
        links = self._links
        if age > 0.0:
            links = self._past_links
            joints = senses.joint_q - age * senses.joint_qd
            self._hand_cloud.pose(as_warp(joints), links)
        return wp.to_torch(self._hand_cloud(links))

    def _find(self, senses: Senses) -> Found:
        """Find the objects among the camera's points, or follow them; links are posed."""
        finder = self.finder
        before = self._before
        cloud = [*(self._hand_points(age, senses) for age in AGES_S), senses.points]
        hand = len(AGES_S) * self._hand_cloud.count
        seen, count = object_points(torch.cat(cloud, dim=1), hand, PAPER.cloud.voxel_m, finder.most)
        turn = self._base[:, 3:]
        finder.look(seen, count, fresh=senses.fresh)
        pose = finder.pose
        # A first look knows no motion.
        known = (finder.looks > 1) & (rotation_distance(pose[:, 3:], before[:, 3:]) < LEAP_RAD)
        moves = self._rate * known[:, None].float()
        step = relative_rotation(pose[:, 3:], before[:, 3:])
        found = Found(
            orientation=product(turn, pose[:, 3:]),
            position=self._base[:, :3] + rotated(turn, pose[:, :3]),
            velocity=moves * rotated(turn, pose[:, :3] - before[:, :3]),
            spin=moves
            * 2.0
            * rotated(turn, step[:, :3] * torch.sign(step[:, 3:])),  # of a small angle
            voxels=count,
        )
        before[:] = pose
        return found
