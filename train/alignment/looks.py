"""Looks: what a depth camera sees of an object while a policy acts by the network that is trained.

The simulator labels each look with how the object lies, so the network learns where its own
decisions lead (DAgger, Ross et al. 2011). N environments, K looks kept, P points of a look. Base
frame, metres.
"""

from collections.abc import Callable

import numpy as np
import torch
import warp as wp
from torch import Tensor

from vd.evaluate.camera_actor import CameraActor
from vd.geometry.quaternions import poses_in, rotation_distance
from vd.train.alignment.config import LooksCfg
from vd.train.student.views import Pairs, with_goals
from vd.train.vec_env import OBSERVATION_GROUP, ReorientVecEnv
from vd.vision.acting_teacher import ActingTeacher, VisionPolicy
from vd.vision.cfg import SEEN_POINTS
from vd.vision.rotations import quaternion_matrices

ENDS = ("task/reached", "task/dropped", "task/timed_out")
"""How goals end; shares of the environments in each step."""


class SimulatedLooks:
    """Lets a policy act, and keeps the latest looks: a new one takes the place of the oldest.

    Args:
        env: The environments.
        policy: Acts by the network that is trained.
        surfaces: Points of the objects' surfaces in their frames, unscaled [m] [O, P', 3].
        cfg: Settings.
        seed: Of the camera's errors.
    """

    def __init__(
        self,
        env: ReorientVecEnv,
        policy: VisionPolicy,
        surfaces: Tensor,
        cfg: LooksCfg,
        seed: int,
    ):
        self.cfg = cfg
        self._env = env
        self._surfaces = surfaces
        device = surfaces.device
        simulation = env.env
        scene = simulation.scene
        self._actor = CameraActor(simulation, policy, sensor_errors=True, seed=seed)
        self._object_pose = wp.to_torch(simulation.sim.body_q)[:, scene.object_body]
        self._base = torch.tensor(simulation.hand.mount, dtype=torch.float32, device=device)
        self._object_of_env = torch.tensor(np.asarray(scene.world_object), device=device)
        self._scale_of_env = torch.tensor(np.asarray(scene.world_scale), device=device).float()
        self._clouds = torch.empty((cfg.kept, SEEN_POINTS, 3), dtype=torch.half, device=device)
        self._poses = torch.empty((cfg.kept, 7), device=device)
        self._envs = torch.empty(cfg.kept, dtype=torch.long, device=device)
        self._looks_so_far = 0

    @torch.no_grad()
    def collect(self, stopping: Callable[[], bool]) -> dict[str, Tensor] | None:
        """Some steps of every environment; figures of these, or ``None`` if they were cut short."""
        logs = []
        errors = []
        assert isinstance(self._actor.tracker, ActingTeacher)
        finder = self._actor.tracker.observer.finder
        observation = self._env.get_observations()[OBSERVATION_GROUP]
        for _ in range(self.cfg.steps):
            if stopping():
                return None
            action = self._actor.act(observation)
            pose = poses_in(self._base, self._object_pose)
            rows = finder.seen_now.nonzero().flatten()
            self._keep(finder.seen[rows], pose[rows], rows)
            errors.append(rotation_distance(finder.pose[rows, 3:], pose[rows, 3:]))
            _, _, _, extras = self._env.step(action)
            logs.append(torch.stack([extras["log"][name] for name in ENDS]))
        self._env.env.check()
        ends = torch.stack(logs).sum(dim=0)
        return {
            "looks/rotation_error": torch.cat(errors).median(),
            "looks/success_per_goal": ends[0] / ends.sum().clamp(min=1.0 / self._env.num_envs),
        }

    def pairs(self, count: int, points: int, *, near: float, scans: float) -> Pairs:
        """Pairs of looks, drawn from those kept, with goals of the same shapes.

        Clouds of ``points``.
        """
        device = self._surfaces.device
        drawn = torch.randint(min(self._looks_so_far, self.cfg.kept), (count,), device=device)
        envs = self._envs[drawn]
        pose = self._poses[drawn]
        order = torch.randperm(self._surfaces.shape[1], device=device)
        surfaces = self._surfaces[self._object_of_env[envs]][:, order]
        shapes = self._scale_of_env[envs, None, None] * surfaces
        turn = quaternion_matrices(pose[:, 3:])
        seen = self._clouds[drawn, :points].float()
        return with_goals(shapes, turn, pose[:, :3], seen, near=near, scans=scans)

    def close(self) -> None:
        """Release the environments."""
        self._env.env.close()

    def _keep(self, seen: Tensor, pose: Tensor, envs: Tensor) -> None:
        places = torch.arange(
            self._looks_so_far, self._looks_so_far + len(envs), device=envs.device
        )
        places %= self.cfg.kept
        self._clouds[places] = seen.half()
        self._poses[places] = pose
        self._envs[places] = envs
        self._looks_so_far += len(envs)
