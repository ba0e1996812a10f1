"""What a student sees and senses: frames of poses or camera points, and their voxels when needed.

Of the simulator and of a robot alike. A frame holds poses, not clouds: a cloud is a hundred times as large,
and is made again from its frame, with new noise, whenever a batch needs it. N hands of L links, D actions, K
camera points; R rows are frames of any hands at any times. World frame: z up; quaternions xyzw.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
import warp as wp

from vd.assets_usd.hand_data import BASE_IN_WORLD, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.clouds import HandKinematics, SceneClouds
from vd.senses import Senses
from vd.vision.cfg import NoiseCfg, StudentCfg
from vd.vision.sites import Sites
from vd.vision.voxels import Voxeliser

OBJECT = -1
"""Column of a frame's poses that is the object's."""

Frame = dict[str, torch.Tensor]
"""Tensors of N hands: ``body_q`` [N, L + 1, 7] (links as the encoders report the joints, then the object),
``goal_quat`` [N, 4], ``action`` [N, D] (smoothed, of the step before), ``position`` [rad] and ``velocity``
[rad/s] of the joints [N, D] and, with a camera, ``points`` [N, K, 3] (base frame [m])."""


class Sight:
    """What students see of N hands.

    They see complete clouds of hand and object, or a camera's points and the hand's own cloud from its
    joints, and the goal beside the scene.

    Attributes:
        rng: Random streams of the noise.
        ends: Columns of a cloud at which goal and hand end.
    """

    def __init__(
        self,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        network: StudentCfg,
        *,
        complete: bool,
        world_object: np.ndarray | None = None,
        world_scale: np.ndarray | None = None,
        goals: Sequence[ObjectModel] | None = None,
        noise: NoiseCfg | None = None,
        batch: int = 0,
        seed: int = 0,
        device: str = "cpu",
    ):
        """Put samples on the device.

        Args:
            hand: The hand.
            objects: The objects.
            network: What of the student concerns its clouds.
            complete: See the object whole, from its true pose; else a camera's points.
            world_object: Object of each hand [N]; the first by default, of one hand.
            world_scale: Size factor of each hand's object [N]; 1 by default.
            goals: The objects as their goals are shown; as they are by default.
            noise: Noise of training; None where there will be none.
            batch: Clouds of a training batch at most.
            seed: Of the noise.
            device: Warp device.
        """
        links = np.arange(len(hand.link_names))
        shapes = np.zeros(1, dtype=int) if world_object is None else world_object
        self._complete = complete
        self._clouds = SceneClouds(
            hand,
            objects,
            link_body=links,
            object_body=len(links),
            world_object=shapes,
            world_scale=np.ones(len(shapes)) if world_scale is None else world_scale,
            device=device,
            goals=goals,
        )
        self._kinematics = HandKinematics(hand, link_body=links, base=BASE_IN_WORLD, device=device)
        self._voxelise = Voxeliser(
            network.voxel_m, noise=noise, clouds=max(batch, len(shapes)), seed=seed, device=device
        )
        self._links, self.rng, self.ends = len(links), self._voxelise.rng, self._clouds.ends
        self._marks = self.ends if network.marked else ()

    def frame(self, senses: Senses, object_pose: torch.Tensor | None = None) -> Frame:
        """A frame, of copies: later steps do not change it.

        Args:
            senses: What is sensed.
            object_pose: True poses of the objects, world frame [N, 7], as far as they are known.

        Raises:
            ValueError: The clouds are complete, and no pose is known.
        """
        if object_pose is None and self._complete:
            raise ValueError("the student was trained on complete clouds, which need the object's true pose")
        body_q = senses.joint_q.new_zeros((len(senses.joint_q), self._links + 1, 7))
        self._kinematics.write(
            wp.from_torch(senses.joint_q.contiguous()), wp.from_torch(body_q, dtype=wp.transform)
        )
        if object_pose is not None:
            body_q[:, OBJECT] = object_pose
        frame = {
            "body_q": body_q,
            "goal_quat": senses.goal_quat.clone(),
            "action": senses.action.clone(),
            "position": senses.joint_q.clone(),
            "velocity": senses.joint_qd.clone(),
        }
        return frame if self._complete else frame | {"points": senses.points.clone()}

    def points(self, frame: Mapping[str, torch.Tensor], envs: torch.Tensor | None = None) -> torch.Tensor:
        """Clouds of frames: goal, hand, and the object or what the camera sees [R, P, 3]; base frame [m].

        Args:
            frame: The frames.
            envs: Hand of each row [R]; row i is of hand i by default.
        """
        rows, columns = frame["body_q"].shape[0], self._clouds.item
        seen = columns.stop - columns.start if self._complete else frame["points"].shape[1]
        points = torch.empty((rows, columns.start + seen, 3), device=frame["goal_quat"].device)
        self._clouds.write(
            wp.from_torch(points, dtype=wp.vec3),
            wp.from_torch(frame["body_q"].contiguous(), dtype=wp.transform),
            wp.from_torch(frame["goal_quat"].contiguous(), dtype=wp.quat),
            with_object=self._complete,
            envs=None if envs is None else wp.from_torch(envs.int()),
        )
        if not self._complete:
            points[:, columns.start :] = frame["points"]
        return points

    def sites(
        self, frame: Mapping[str, torch.Tensor], envs: torch.Tensor | None = None, *, augment: bool = False
    ) -> Sites:
        """Voxels of frames, of scene and goal together.

        Args:
            frame: The frames.
            envs: Hand of each row, as of :meth:`points`.
            augment: Add noise, as in training.
        """
        return self._voxelise(self.points(frame, envs), augment=augment, ends=self._marks)
