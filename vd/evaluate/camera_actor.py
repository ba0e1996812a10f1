"""Policies that see by a camera at work in an environment."""

from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from vd.evaluate.goals import Goals
from vd.evaluate.scanned import known_points
from vd.policy.senses import Senses
from vd.sensors.depth_camera import DepthCamera
from vd.vision.acting import ActingStudent, StudentPolicy
from vd.vision.acting_teacher import ActingTeacher, VisionPolicy

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

AnyCameraPolicy = VisionPolicy | StudentPolicy


def sensed(env: "ReorientEnv", camera: DepthCamera) -> Senses:
    """What the hands of an environment sense now; later steps change all of it but the points."""
    fresh = wp.to_torch(env.step_count) == 0
    camera.reset(wp.from_torch(fresh.int()))  # a late image must not show what was before a reset
    camera.capture()
    # Without a pixel in the crop the cloud is one false point at the origin: it counts for nothing.
    unseen = (wp.to_torch(camera.count) == 0)[:, None, None]
    return sensed_with(env, wp.to_torch(camera.points).masked_fill(unseen, torch.nan))


def sensed_with(env: "ReorientEnv", points: torch.Tensor) -> Senses:
    """What the hands of an environment sense now, with these points for those of a camera."""
    joints = env.num_joints
    return Senses(
        joint_q=wp.to_torch(env.measured_q)[:, :joints],
        joint_qd=wp.to_torch(env.measured_qd)[:, :joints],
        action=wp.to_torch(env.smoothed),
        goal_quat=wp.to_torch(env.goal_quat),
        points=points,
        fresh=wp.to_torch(env.step_count) == 0,
    )


class CameraActor:
    """A policy that sees by a camera in every environment of an environment.

    Args:
        env: The environment.
        policy: The policy.
        goals: What it knows of shapes and goals.
        sensor_errors: See with the errors of a real camera.
        seed: Of these, and of scans.

    Attributes:
        hand: The hand.
        camera: A depth camera in every environment.
        tracker: What decides.
        predicted: Distance to the goal that it expected before the latest action [rad], shape [N].
        active: Where it acts, bool [N]; elsewhere its actions are 0.
    """

    def __init__(
        self,
        env: "ReorientEnv",
        policy: AnyCameraPolicy,
        *,
        goals: Goals = "points",
        sensor_errors: bool = False,
        seed: int = 0,
    ):
        self.hand = env.hand
        self._env = env
        self._surfaces = [item.surface_points for item in env.objects]
        # Who sees by a camera acts in the world, whatever its teacher does.
        env.acts_in_frame = False
        camera = env.hand.camera.at(policy.spec.camera)
        depth = policy.spec.depth
        self.camera = DepthCamera.of_scene(
            env.scene,
            env.sim.body_q,
            depth.with_errors() if sensor_errors else depth,
            camera,
            frame_s=env.cfg.sim.control_dt,
            seed=seed,
        )
        place = wp.device_to_torch(env.device)
        clouds = known_points(env.objects, goals, seed=seed)[env.scene.world_object]
        scaled = clouds * np.asarray(env.scene.world_scale)[:, None, None]
        goal_clouds = torch.tensor(scaled, dtype=torch.float32, device=place)
        self.tracker: ActingTeacher | ActingStudent
        if isinstance(policy, StudentPolicy):
            policy.network.half = place.startswith("cuda")
            self.tracker = ActingStudent(policy.network, env.hand, goal_clouds)
        else:
            self.tracker = ActingTeacher(policy, env.hand, goal_clouds)
        self.predicted = torch.zeros(env.num_envs, device=place)
        self.active = torch.ones(env.num_envs, dtype=torch.bool, device=place)

    def surface(self, world: int) -> np.ndarray:
        """Surface points of an environment's object, in the frame that is found [m] [P, 3]."""
        scene = self._env.scene
        return self._surfaces[scene.world_object[world]] * scene.world_scale[world]

    def act(self, _observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] for what is sensed now.

        The teacher's observation is not looked at.
        """
        decision = self.tracker.step(sensed(self._env, self.camera))
        self.predicted.copy_(decision.angle)
        return decision.action.masked_fill(~self.active[:, None], 0.0)
