"""A tracking or vision policy at work in an environment."""

from typing import Any

import numpy as np
import torch
import warp as wp

from vd.evaluate.goals import Goals
from vd.evaluate.scanned import known_objects
from vd.policy.senses import Senses
from vd.sensors.depth_camera import DepthCamera
from vd.tracking.policy import TrackingPolicy
from vd.tracking.tracker import Tracker


def sensed(env: Any, camera: DepthCamera) -> Senses:
    """What the hands of an environment sense now; later steps change all of it but the points."""
    fresh = wp.to_torch(env.step_count) == 0
    joints = env.num_joints
    camera.reset(wp.from_torch(fresh.int()))  # a late image must not show what was before a reset
    camera.capture()
    # Without a pixel in the crop the cloud is one false point at the origin: it counts for nothing.
    unseen = (wp.to_torch(camera.count) == 0)[:, None, None]
    return Senses(
        joint_q=wp.to_torch(env.measured_q)[:, :joints],
        joint_qd=wp.to_torch(env.measured_qd)[:, :joints],
        action=wp.to_torch(env.smoothed),
        goal_quat=wp.to_torch(env.goal_quat),
        points=wp.to_torch(camera.points).masked_fill(unseen, torch.nan),
        fresh=fresh,
    )


class TrackingActor:
    """A tracking or vision policy in every environment of an environment.

    Attributes:
        num_actions: D.
        hand: The hand.
        camera: A depth camera in every environment.
        tracker: What decides.
        predicted: Distance to the goal that it expected before the latest action [rad], shape [N].
        active: Where it acts, bool [N]; elsewhere its actions are 0.
    """

    def __init__(
        self,
        env: Any,
        policy: TrackingPolicy,
        *,
        goals: Goals = "mesh",
        sensor_errors: bool = False,
        seed: int = 0,
    ):
        """Open its eyes in every environment, with ``sensor_errors`` those of a real camera."""
        self._env = env
        self.hand = env.hand
        self.num_actions = policy.num_actions
        self._surfaces = [item.surface_points for item in env.objects]
        env.acts_in_frame = False  # a camera policy acts in the world, whatever its teacher does
        scene = env.scene
        camera = env.hand.camera.at(policy.spec.camera)
        depth = policy.spec.depth
        if sensor_errors:
            depth = depth.with_errors()
        self.camera = DepthCamera.of_scene(
            scene, env.sim.body_q, depth, camera, frame_s=env.cfg.sim.control_dt, seed=seed
        )
        self.tracker = Tracker(
            policy,
            env.hand,
            known_objects(
                env.objects, goals, seed=seed, device=env.device, surfaces=policy.alignment is None
            ),
            camera,
            world_object=scene.world_object,
            world_scale=scene.world_scale,
            device=env.device,
        )
        place = wp.device_to_torch(env.device)
        self.predicted = torch.zeros(env.num_envs, device=place)
        self.active = torch.ones(env.num_envs, dtype=torch.bool, device=place)

    def surface(self, world: int) -> np.ndarray:
        """Points on the surface of an environment's object, in the frame that is found [m] [P, 3]."""
        scene = self._env.scene
        return self._surfaces[scene.world_object[world]] * scene.world_scale[world]

    def act(self, _observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] for what is sensed now.

        The teacher's observation is not looked at.
        """
        decision = self.tracker.step(sensed(self._env, self.camera))
        self.predicted.copy_(decision.angle)
        return decision.action.masked_fill(~self.active[:, None], 0.0)
