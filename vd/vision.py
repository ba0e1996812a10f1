"""What the student sees of an environment: frames of poses or camera points, and their voxels when needed.

A frame holds poses, not clouds: a cloud is a hundred times as large, and is made again from its frame, with
new noise, whenever a batch needs it. N worlds, B bodies, D actions, K camera points; R rows are frames of any
worlds at any times. World frame: z up, table top at z = 0; quaternions xyzw.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.assets_usd.objects.model import ObjectModel
from vd.envs.reorient import ReorientEnv
from vd.kernels.observations import teacher_observation_slices
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sensors.surfaces import scene_surfaces
from vd.sim.scene import hand_mount
from vd.student.cfg import NoiseCfg, StudentCfg
from vd.student.clouds import HandKinematics, SceneClouds, Voxeliser
from vd.student.object_sense import ObjectSense
from vd.student.quaternions import canonical, relative_rotation, rotation_distance
from vd.student.sites import Sites
from vd.student.symmetry import nearest_goal, symmetries_of_worlds

Frame = dict[str, torch.Tensor]
"""Tensors of N worlds: ``body_q`` [N, B, 7], ``goal_quat`` [N, 4], ``action`` [N, D] (smoothed, of the step
before), ``position`` [rad] and ``velocity`` [rad/s] of the joints as their encoders report them [N, D],
``distance`` [N] (true angle to the goal [rad], or to what looks like it, if that is nearer), if the student
senses it ``object`` [N, V] (:class:`vd.student.object_sense.ObjectSense`) and, with a camera, ``points``
[N, K, 3] (base frame [m])."""


def voxels(
    points: torch.Tensor,
    ends: tuple[int, int],
    voxelise: Voxeliser,
    *,
    network: StudentCfg,
    augment: bool,
    complete: bool = False,
) -> tuple[Sites, ...]:
    """Voxels of clouds as the student takes them: of all points, or of scene and goal apart.

    Args:
        points: Points [m], shape [R, P, 3]: the goal's, the hand's, then others.
        ends: Columns at which the goal's points end, and the hand's after them.
        voxelise: Makes the voxels.
        network: Whether the goal is a cloud of its own, and whether voxels are marked.
        augment: Add noise, as in training.
        complete: The other points are of the object alone, not a camera's.

    Returns:
        Arguments of :meth:`vd.student.network.Student.encode`.
    """
    goal, hand = ends
    marked = "marks" in network.encoder.inputs
    if network.goal == "merged":
        scene = voxelise(points, augment=augment, ends=(goal, hand) if marked else ())
        scene.complete = complete
        return (scene,)
    rest, own = points[:, goal:].contiguous(), points[:, :goal].contiguous()
    # Marks are of goal and hand in both: the one has no goal, the other no hand.
    scene = voxelise(rest, augment=augment, ends=(0, hand - goal) if marked else ())
    scene.complete = complete
    return scene, voxelise(own, augment=augment, ends=(goal, goal) if marked else ())


class StudentView:
    """The student's eyes in every world of an environment.

    Stage 1 sees complete clouds of hand and object; stage 2 sees a depth camera's points, and the hand's own
    cloud from its joints as the encoders report them. Both see the goal beside the scene.
    """

    def __init__(
        self,
        env: ReorientEnv,
        network: StudentCfg,
        *,
        rendered: bool,
        depth: DepthCameraCfg | None = None,
        camera: Sequence[float] | None = None,
        known: Sequence[ObjectModel] | None = None,
        noise: NoiseCfg | None = None,
        batch: int = 0,
        seed: int = 0,
    ):
        """Put samples and cameras on the environment's device.

        Args:
            env: The environment.
            network: What of the student concerns its clouds.
            rendered: See by a depth camera.
            depth: Its settings.
            camera: Pose of its optical frame in the hand's base frame, position [m] and quaternion xyzw; the
                hand's camera by default.
            known: The objects as the student knows them, if it looks for them by their shapes; as they are by
                default.
            noise: Noise of training; None where there will be none.
            batch: Clouds of a training batch at most.
            seed: Of noise and camera.
        """
        self.env = env
        env.acts_in_view = False  # the student sees the world as it is, whatever its teacher does
        self.device = wp.device_to_torch(env.device)
        scene = env.scene
        self._network = network
        self._clouds = SceneClouds(
            env.hand,
            env.objects,
            link_body=scene.link_body,
            object_body=scene.object_body,
            world_object=scene.world_object,
            world_scale=scene.world_scale,
            device=env.device,
        )
        self._voxelise = Voxeliser(
            network.voxel_m, noise=noise, clouds=max(batch, env.num_worlds), seed=seed, device=env.device
        )
        self.camera: DepthCamera | None = None
        model = scene.hand.camera if rendered else None
        if model is not None:
            if camera is not None:
                turn = np.asarray(camera[3:], dtype=float)
                if not np.linalg.norm(turn) > 0.0:
                    raise ValueError(f"camera = {tuple(camera)}; its last four values must be a quaternion")
                model = replace(
                    model, position=np.asarray(camera[:3]), quaternion=turn / np.linalg.norm(turn)
                )
            self.camera = DepthCamera(
                scene_surfaces(scene),
                model,
                env.sim.body_q,
                cfg=depth,
                camera_body=int(scene.link_body[0]),
                frame_s=env.cfg.sim.control_dt,
                seed=seed,
            )
        self._symmetry = symmetries_of_worlds(env.objects, scene.world_object, env.device)
        self._sense: ObjectSense | None = None
        if "object" in network.senses:
            self._sense = ObjectSense(
                env.hand,
                env.objects if known is None else known,
                link_body=scene.link_body,
                world_object=scene.world_object,
                world_scale=scene.world_scale,
                camera=model,
                voxel_m=network.voxel_m,
                aim=network.aim,
                device=env.device,
            )
        # Encoders that read late or wrong show the hand where they say it is, as they do on the robot.
        self._kinematics: HandKinematics | None = None
        if env.measured_q is not env.sim.joint_q:
            self._kinematics = HandKinematics(
                env.hand, link_body=scene.link_body, base=hand_mount(), device=env.device
            )
        self._body_q = wp.to_torch(env.sim.body_q)
        self._goal = wp.to_torch(env.goal_quat)
        self._smoothed = wp.to_torch(env.smoothed)
        self._steps = wp.to_torch(env.step_count)
        self._object, self._joints = scene.object_body, env.num_actions

    def frame(self) -> Frame:
        """What there is to see before the next action: copies, so that later steps do not change them."""
        body_q = self._body_q.clone()
        if self._kinematics is not None:
            self._kinematics.write(self.env.measured_q, wp.from_torch(body_q, dtype=wp.transform))
        frame = {
            "body_q": body_q,
            "goal_quat": self._goal.clone(),
            "action": self._smoothed.clone(),
            "position": wp.to_torch(self.env.measured_q)[:, : self._joints].clone(),
            "velocity": wp.to_torch(self.env.measured_qd)[:, : self._joints].clone(),
            "distance": rotation_distance(*self._towards()),
        }
        if self.camera is not None:
            # A late image must not show what was before a reset.
            self.camera.reset(wp.from_torch((self._steps == 0).int()))
            self.camera.capture()
            points = wp.to_torch(self.camera.points).clone()
            # Without a pixel in the crop the cloud is one false point at the origin: it counts for nothing.
            unseen = wp.to_torch(self.camera.count) == 0
            frame["points"] = points.masked_fill_(unseen[:, None, None], torch.nan)
        if self._sense is not None:
            frame["object"] = self._sense(
                self.sites(frame, augment=False),
                body_q,
                frame["goal_quat"],
                fresh=self._steps == 0,
                points=frame.get("points"),
            )
        return frame

    def observation(self, observed: torch.Tensor) -> torch.Tensor:
        """A teacher's observation [N, O], world frame: of all that looks like the goal the nearest is it.

        The rotation to it is less than half a turn, as at the beginning of every goal of its training.
        """
        orientation, goal = self._towards()
        turn = relative_rotation(orientation, goal)
        kept = canonical(turn)
        goal = torch.where((kept == turn).all(dim=-1, keepdim=True), goal, -goal)
        columns = teacher_observation_slices(self.env.num_fingers)
        changed = observed.clone()
        changed[:, columns["goal_orientation"]] = (
            canonical(goal) if self.env.cfg.observation.canonical else goal
        )
        changed[:, columns["relative_orientation"]] = kept
        return changed

    def points(self, frame: Mapping[str, torch.Tensor], worlds: torch.Tensor | None = None) -> torch.Tensor:
        """Clouds of frames: goal, hand, and the object or what the camera sees [R, P, 3]; base frame [m].

        Args:
            frame: ``body_q`` [R, B, 7], ``goal_quat`` [R, 4] and, with a camera, ``points`` [R, K, 3].
            worlds: World of each row [R]; row i is of world i by default.
        """
        rows, columns = frame["body_q"].shape[0], self._clouds.item
        seen = frame["points"].shape[1] if self.camera is not None else columns.stop - columns.start
        points = torch.empty((rows, columns.start + seen, 3), device=self.device)
        self._clouds.write(
            wp.from_torch(points, dtype=wp.vec3),
            wp.from_torch(frame["body_q"].contiguous(), dtype=wp.transform),
            wp.from_torch(frame["goal_quat"].contiguous(), dtype=wp.quat),
            with_object=self.camera is None,
            worlds=None if worlds is None else wp.from_torch(worlds.int()),
        )
        if self.camera is not None:
            points[:, columns.start :] = frame["points"]
        return points

    def sites(
        self, frame: Mapping[str, torch.Tensor], worlds: torch.Tensor | None = None, *, augment: bool
    ) -> tuple[Sites, ...]:
        """Voxels of frames; arguments as of :meth:`points`.

        Args:
            frame: The frames.
            worlds: World of each row.
            augment: Add noise, as in training.

        Returns:
            Arguments of :meth:`vd.student.network.Student.encode`.
        """
        points = self.points(frame, worlds)
        return voxels(
            points,
            self._clouds.ends,
            self._voxelise,
            network=self._network,
            augment=augment,
            complete=self.camera is None,
        )

    def state_dict(self) -> dict[str, Any]:
        """Random states and what the camera remembers, as NumPy arrays."""
        return {name: array.numpy().copy() for name, array in self._stateful().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        for name, array in self._stateful().items():
            array.assign(state[name])

    def _towards(self) -> tuple[torch.Tensor, torch.Tensor]:
        """True orientation of each world's object, and the nearest that looks like its goal [N, 4]."""
        orientation = self._body_q[:, self._object, 3:]
        return orientation, nearest_goal(orientation, self._goal, self._symmetry)

    def _stateful(self) -> dict[str, wp.array]:
        arrays = {"noise": self._voxelise.rng}
        if self.camera is not None:
            arrays |= self.camera.stateful()
        if self._sense is not None:
            arrays |= self._sense.stateful()
        return arrays
