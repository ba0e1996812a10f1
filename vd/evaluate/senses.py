"""What camera policies are told of an environment."""

from typing import Any

import torch
import warp as wp

from vd.assets_usd.hand_data import CameraModel
from vd.senses import Senses
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera


class EnvironmentSenses:
    """What the hands of an environment sense: their encoders, and a depth camera in every environment.

    Args:
        env: The environment; from now on it takes actions in the world's order.
        model: The camera, posed in the base frame; None: there is none, and no points.
        depth: What it sees.
        seed: Of its errors.
    """

    def __init__(self, env: Any, model: CameraModel | None, depth: DepthCameraCfg | None, *, seed: int = 0):
        self._env, scene = env, env.scene
        env.acts_in_frame = False  # who sees by a camera acts in the world, whatever its teacher does
        self.camera: DepthCamera | None = None
        if model is not None:
            frame_s = env.cfg.sim.control_dt
            self.camera = DepthCamera.of_scene(
                scene, env.sim.body_q, depth, model, frame_s=frame_s, seed=seed
            )
        self._steps = wp.to_torch(env.step_count)

    def read(self) -> Senses:
        """What there is to sense before the next action; later steps change all of it but the points."""
        env, joints = self._env, self._env.num_joints
        fresh = self._steps == 0
        return Senses(
            joint_q=wp.to_torch(env.measured_q)[:, :joints],
            joint_qd=wp.to_torch(env.measured_qd)[:, :joints],
            action=wp.to_torch(env.smoothed),
            goal_quat=wp.to_torch(env.goal_quat),
            points=self._see(fresh),
            fresh=fresh,
        )

    def _see(self, fresh: torch.Tensor) -> torch.Tensor:
        """What the cameras see now [N, K, 3]."""
        if self.camera is None:
            return torch.empty((len(fresh), 0, 3), device=fresh.device)
        self.camera.reset(wp.from_torch(fresh.int()))  # a late image must not show what was before a reset
        self.camera.capture()
        # Without a pixel in the crop the cloud is one false point at the origin: it counts for nothing.
        unseen = (wp.to_torch(self.camera.count) == 0)[:, None, None]
        return wp.to_torch(self.camera.points).masked_fill(unseen, torch.nan)
