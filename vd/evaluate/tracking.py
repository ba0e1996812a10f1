"""A tracking policy at work in an environment."""

from typing import Any

import torch
import warp as wp

from vd.evaluate.goals import Goals
from vd.evaluate.scanned import known_objects
from vd.evaluate.senses import EnvironmentSenses
from vd.tracking.policy import TrackingPolicy
from vd.tracking.tracker import Tracker


class TrackingActor:
    """A tracking policy in every environment of an environment.

    Attributes:
        num_actions: D.
        predicted: Angle that it found before the latest action [rad], shape [N].
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
        scene, camera, depth = env.scene, env.hand.camera.at(policy.spec.camera), policy.spec.depth
        self.num_actions = policy.num_actions
        depth = depth.with_errors() if sensor_errors else depth
        self._senses = EnvironmentSenses(env, camera, depth, seed=seed)
        self._tracker = Tracker(
            policy,
            env.hand,
            known_objects(env.objects, goals, seed=seed, device=env.device),
            camera,
            world_object=scene.world_object,
            world_scale=scene.world_scale,
            device=env.device,
        )
        place = wp.device_to_torch(env.device)
        self.predicted = torch.zeros(env.num_envs, device=place)
        self.active = torch.ones(env.num_envs, dtype=torch.bool, device=place)

    def act(self, _observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] for what is sensed now; the teacher's observation is not looked at."""
        decision = self._tracker.step(self._senses.read())
        self.predicted.copy_(decision.angle)
        return decision.action.masked_fill(~self.active[:, None], 0.0)
