"""A running environment that is watched: what the viewer shows and its buttons change."""

from typing import Any

import numpy as np

from vd.evaluate.rollout import draw_goals
from vd.play.video import Snapshot, Watcher, act


class Session:
    """One environment is watched at a time, ``snapshot`` shows it; all run, one for each object at least."""

    def __init__(self, env: Any, policy: Any, *, seed: int = 0):
        self.env, self._policy = env, policy
        self.hand, self.objects, self.control_hz = env.hand, env.objects, env.cfg.sim.control_hz
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
        self.world = next(w for w, k in enumerate(self.env.world_object) if k == index)
        self._watcher = Watcher(self.env, [self.world])
        self.snapshot: Snapshot = self._watcher.read(stepped=False)[0]

    def step(self) -> Snapshot:
        """One control step of all environments."""
        act(self.env, self._policy)
        self.snapshot = self._watcher.read()[0]
        return self.snapshot

    def reset(self) -> Snapshot:
        """Start all environments anew, with new goals; counts go on."""
        self.env.reset()
        self.snapshot = self._watcher.read(stepped=False)[0]
        return self.snapshot

    def new_goal(self) -> Snapshot:
        """Give every environment a new goal; nothing else changes."""
        env = self.env
        goals = draw_goals(env.object_pose()[:, 3:7].astype(float), self._rng, env.cfg.goal.max_angle_rad)
        env.give_goals(np.arange(env.num_envs), goals)
        self.snapshot = self._watcher.read(stepped=False)[0]
        return self.snapshot
