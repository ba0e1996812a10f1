"""A running environment that is watched: what the viewer shows and its buttons change."""

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.evaluate.rollout import draw_goals
from vd.evaluate.statistics import symmetric_error
from vd.evaluate.trace import advance
from vd.play.camera_view import camera_view
from vd.play.video import Watcher

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv


class Session:
    """One environment is watched at a time, ``snapshot`` shows it.

    All run, one for each object at least.

    Attributes:
        sees: Whether the policy sees by a camera.
    """

    def __init__(self, env: "ReorientEnv", policy: Any, *, seed: int = 0):
        self.env = env
        self._policy = policy
        self.sees = hasattr(policy, "camera")
        self.hand = env.hand
        self.objects = env.objects
        self.control_hz = env.cfg.sim.control_hz
        self.close = env.close
        self._rng = np.random.default_rng(seed)
        self.object_names = [item.name for item in env.objects]
        self.choose_object(self.object_names[env.world_object[0]])
        self.reset()

    @property
    def object_name(self) -> str:
        """Name of the object that is watched."""
        return self.env.objects[self.env.world_object[self.world]].name

    def choose_object(self, name: str) -> None:
        """Watch the first environment with this object; counts start anew."""
        index = self.object_names.index(name)
        self.world = list(self.env.world_object).index(index)
        self._watcher = Watcher(self.env, [self.world])
        self._look()

    def step(self) -> None:
        """One control step of all environments."""
        begun = time.perf_counter()
        action = self._policy.act(wp.to_torch(self.env.observation))
        wp.synchronize_device(self.env.device)
        took = time.perf_counter() - begun
        advance(self.env, action)
        shot = replace(self._watcher.read()[0], latency_s=took)
        if self.sees:
            item = self.env.objects[self.env.world_object[self.world]]
            shot = replace(
                shot,
                believed_rad=float(self._policy.predicted[self.world]),
                alike_rad=float(symmetric_error(shot.joint_q[-4:], shot.goal_quat, item.symmetry)),
            )
        self.snapshot = shot

    def view(self) -> np.ndarray:
        """What the policy's camera saw last, RGB bytes [H, W, 3]; with ``sees`` alone."""
        return camera_view(self._policy, self.world)

    def reset(self) -> None:
        """Start all environments anew, with new goals; counts go on."""
        self.env.reset()
        self._look()

    def new_goal(self) -> None:
        """Give every environment a new goal; nothing else changes."""
        env = self.env
        present = env.object_pose()[:, 3:7].astype(float)
        goals = draw_goals(present, self._rng, env.cfg.goal.max_angle_rad)
        env.give_goals(np.arange(env.num_envs), goals)
        self._look()

    def _look(self) -> None:
        """Show what no step has changed."""
        self.snapshot = self._watcher.read(stepped=False)[0]
