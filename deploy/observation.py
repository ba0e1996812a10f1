"""What a student sees of a hand, without a simulator: the clouds, voxels and senses of its training.

The kernels are those of the training, on the CPU. Base frame for clouds, world frame for goals and the
object; metres, radians, quaternions xyzw. One hand, so that all batches are of one.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import warp as wp

from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_cloud import CameraCloud
from vd.sim.scene import hand_mount
from vd.student.cfg import StudentCfg
from vd.student.clouds import HandKinematics, SceneClouds, Voxeliser
from vd.student.object_sense import ObjectSense
from vd.student.sites import Sites
from vd.vision import voxels


@dataclass(frozen=True)
class Sensed:
    """What is known before an action; D joints."""

    joint_q: np.ndarray
    """Joint positions as measured [rad] [D]."""
    joint_qd: np.ndarray
    """Joint velocities as measured [rad/s] [D]."""
    smoothed: np.ndarray
    """Moving average of the actions so far [D]."""
    goal_quat: np.ndarray
    """Wanted orientation of the object [4]."""
    depth: np.ndarray | None = None
    """Depth image [m], 0 for none [H, W]."""
    object_pose: np.ndarray | None = None
    """True pose of the object [7]: a twin's only."""
    object_velocity: np.ndarray | None = None
    """Its true linear [m/s] and angular [rad/s] velocity [6]: a twin's only."""


class StudentSight:
    """Clouds, voxels and senses of a student.

    Args:
        hand: The hand.
        item: The object; its surface samples are the goal's cloud.
        network: What of the student concerns its clouds.
        camera: Depth camera, posed in the hand's base; None: the object's own cloud, from its true pose.
        depth: Points and crop of the camera's clouds.
        seed: Of the choice of points where there are more than fit.
    """

    def __init__(
        self,
        hand: HandModel,
        item: ObjectModel,
        network: StudentCfg,
        *,
        camera: CameraModel | None = None,
        depth: DepthCameraCfg | None = None,
        seed: int = 0,
    ):
        self._network = network
        links = len(hand.link_names)
        self._clouds = SceneClouds(
            hand,
            [item],
            link_body=np.arange(links),
            object_body=links,
            world_object=np.zeros(1, dtype=int),
            world_scale=np.ones(1),
            device="cpu",
        )
        self._kinematics = HandKinematics(hand, link_body=np.arange(links), base=hand_mount(), device="cpu")
        self._camera: CameraCloud | None = None
        seen = self._clouds.item.stop - self._clouds.item.start
        if camera is not None:
            depth = depth or DepthCameraCfg()
            self._camera = CameraCloud(camera, points=depth.points, crop_m=depth.crop_m, seed=seed)
            seen = depth.points
        zeros = partial(wp.zeros, device="cpu")
        self._joint_q = zeros((1, hand.num_joints), dtype=float)
        self._body_q = zeros((1, links + 1), dtype=wp.transform)
        self._goal = zeros(1, dtype=wp.quat)
        self._points = zeros((1, self._clouds.item.start + seen), dtype=wp.vec3)
        self._voxelise = Voxeliser(network.voxel_m)
        self._sense: ObjectSense | None = None
        if "object" in network.senses:
            self._sense = ObjectSense(
                hand,
                [item],
                link_body=np.arange(links),
                world_object=np.zeros(1, dtype=int),
                world_scale=np.ones(1),
                camera=camera,
                voxel_m=network.voxel_m,
                aim=network.aim,
                device="cpu",
            )
        self._fresh = torch.ones(1, dtype=torch.bool)

    @property
    def ends(self) -> tuple[int, int]:
        """Columns of a cloud at which goal and hand end."""
        return self._clouds.ends

    def points(self, sensed: Sensed) -> torch.Tensor:
        """The cloud of the goal, the hand, and the object or what the camera sees, [1, P, 3] [m].

        Points that are not there are NaN. Overwritten by the next call.

        Raises:
            ValueError: There is no image, or without a camera no pose of the object.
        """
        self._joint_q.assign(np.asarray(sensed.joint_q, dtype=np.float32)[None])
        self._goal.assign(np.asarray(sensed.goal_quat, dtype=np.float32)[None])
        self._kinematics.write(self._joint_q, self._body_q)
        first = self._clouds.item.start
        if self._camera is not None:
            if sensed.depth is None:
                raise ValueError("the student sees by a depth camera, but there is no image")
            seen, count = self._camera.make(sensed.depth)
            wp.copy(self._points[:, first:], seen)
            if not count.numpy()[0]:  # the false point of an empty cloud counts for nothing
                wp.to_torch(self._points)[:, first:] = torch.nan
        elif sensed.object_pose is None:
            raise ValueError("the student was trained on complete clouds, which need the object's true pose")
        else:
            poses = self._body_q.numpy()
            poses[0, -1] = sensed.object_pose
            self._body_q.assign(poses)
        self._clouds.write(self._points, self._body_q, self._goal, with_object=self._camera is None)
        return wp.to_torch(self._points)

    def sites(self, points: torch.Tensor) -> tuple[Sites, ...]:
        """Voxels of a cloud, as :meth:`vd.student.network.Student.encode` takes them."""
        return voxels(
            points,
            self.ends,
            self._voxelise,
            network=self._network,
            augment=False,
            complete=self._camera is None,
        )

    def begin(self) -> None:
        """An episode begins: where the object was is of no meaning."""
        self._fresh.fill_(True)

    def frame(
        self, sensed: Sensed, points: torch.Tensor, sites: tuple[Sites, ...]
    ) -> dict[str, torch.Tensor]:
        """What the student senses, by name: itself as of :func:`frame`, and the object where it looks for it.

        Args:
            sensed: What is known.
            points: Its cloud, from :meth:`points`.
            sites: The cloud's voxels.
        """
        known = frame(sensed)
        if self._sense is not None:
            known["object"] = self._sense(
                sites,
                wp.to_torch(self._body_q),
                wp.to_torch(self._goal),
                fresh=self._fresh,
                points=points[:, self._clouds.item.start :] if self._camera is not None else None,
            )
            self._fresh.fill_(False)
        return known


def frame(sensed: Sensed) -> dict[str, torch.Tensor]:
    """What the student senses of itself, by name, [1, D] each."""
    parts = {"action": sensed.smoothed, "position": sensed.joint_q, "velocity": sensed.joint_qd}
    return {name: torch.tensor(value, dtype=torch.float32)[None] for name, value in parts.items()}
