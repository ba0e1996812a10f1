"""A test double of the environment: objects turn as the action says, without physics.

The first three actions of a world are its object's angular velocity [rad/s, world frame];
``fall_at`` makes chosen environments drop their object. Everything evaluation and viewing read is
there, with the meaning it has in ``vd.envs``.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

IDENTITY = np.array([[0.0, 0.0, 0.0, 1.0]])


@dataclass
class FakeObject:
    name: str = "thing"
    symmetry: np.ndarray = field(default_factory=IDENTITY.copy)
    warnings: tuple[str, ...] = ()


class FakeEnv:
    def __init__(
        self,
        objects=(FakeObject(),),
        num_envs=1,
        max_episode_steps=24,
        tolerance=0.4,
        fall_at=None,
        hand=None,
    ):
        self.objects = list(objects)
        self.hand = hand or SimpleNamespace(
            name="dclaw3", workspace=SimpleNamespace(goal_m=(0.0, 0.0, 0.08))
        )
        self.device = "cpu"
        self.num_envs = n = num_envs
        self.num_actions, self.num_observations = 9, 8
        self.max_episode_steps = max_episode_steps
        self.cfg = SimpleNamespace(
            sim=SimpleNamespace(control_hz=12.0), goal=SimpleNamespace(max_angle_rad=np.pi)
        )
        self.control_dt = 1.0 / 12.0
        self.world_object = (np.arange(n) * len(self.objects)) // n
        self.tolerance, self.fall_at = tolerance, fall_at or {}
        self.still_speed = 0.5

        def zeros(shape, dtype=float):
            return wp.zeros(shape, dtype=dtype, device="cpu")

        self.observation = zeros((n, self.num_observations))
        self.success, self.fell = zeros(n, wp.int32), zeros(n, wp.int32)
        self.still, self.smoothed = zeros(n, wp.int32), zeros((n, self.num_actions))
        self.timed_out, self.done = zeros(n, wp.int32), zeros(n, wp.int32)
        self.rotation_error, self.goal_quat = zeros(n), zeros(n, wp.quat)
        self.step_count = zeros(n, wp.int32)
        self.object_pose_end = zeros(n, wp.transform)
        self.sim = SimpleNamespace(
            joint_q=zeros((n, self.num_actions + 7)), failed=zeros(n, wp.int32)
        )
        self._rng = np.random.default_rng(0)
        self.resets = 0
        self.reset()

    def reset(self, object_quat=None, goal_quat=None):
        """Reset all environments."""
        self._restart(np.arange(self.num_envs), object_quat, goal_quat)
        self.resets += 1
        self._publish()

    def has_table(self):
        """Tables stay."""
        return np.ones(self.num_envs, dtype=bool)

    def _restart(self, envs, object_quat=None, goal_quat=None):
        if object_quat is None:
            object_quat = Rotation.random(len(envs), rng=self._rng).as_quat()
        if goal_quat is None:
            goal_quat = Rotation.random(len(envs), rng=self._rng).as_quat()
        self.goal_quat.numpy()[envs] = goal_quat
        if not hasattr(self, "_quat"):
            self._quat = np.tile(IDENTITY, (self.num_envs, 1))
        self._quat[envs] = object_quat
        self.step_count.numpy()[envs] = 0

    def give_goals(self, envs, goal_quat):
        """Give new goals to some environments."""
        self.goal_quat.numpy()[envs] = goal_quat
        self._publish()

    def step(self, action):
        """Turn the objects for one control step."""
        a = action.numpy()
        assert a.shape == (self.num_envs, self.num_actions) and a.dtype == np.float32
        turned = Rotation.from_rotvec(a[:, :3] * self.control_dt) * Rotation.from_quat(self._quat)
        self._quat = turned.as_quat()
        steps = self.step_count.numpy()
        steps += 1
        goal = Rotation.from_quat(self.goal_quat.numpy())
        error = (goal * turned.inv()).magnitude()
        still = np.linalg.norm(a[:, :3], axis=1) <= self.still_speed
        fell = np.array([steps[w] == self.fall_at.get(w, -1) for w in range(self.num_envs)])
        success = (error <= self.tolerance) & still & ~fell
        timed_out = (steps >= self.max_episode_steps) & ~success & ~fell
        done = success | fell | timed_out
        for array, value in (
            (self.still, still),
            (self.success, success),
            (self.fell, fell),
            (self.timed_out, timed_out),
            (self.done, done),
        ):
            array.numpy()[:] = value
        self.rotation_error.numpy()[:] = error
        self.object_pose_end.numpy()[:] = self._pose()
        self._restart(np.flatnonzero(done))
        self._publish()

    def _pose(self):
        return np.concatenate([np.tile([0.0, 0.0, 0.08], (self.num_envs, 1)), self._quat], axis=1)

    def object_pose(self):
        """Present poses."""
        return self._pose()

    def _publish(self):
        q = self.sim.joint_q.numpy()
        q[:, : self.num_actions] = np.tile([0.0, 0.8, -1.1], self.num_actions // 3)
        q[:, self.num_actions :] = self._pose()
        self.observation.numpy()[:] = np.concatenate([self._quat, self.goal_quat.numpy()], axis=1)

    def state_dict(self):
        """Everything that :meth:`load_state_dict` needs to go on as from here."""
        arrays = [array.numpy().copy() for array in (self.goal_quat, self.step_count)]
        return {"arrays": arrays, "quat": self._quat.copy(), "rng": self._rng.bit_generator.state}

    def load_state_dict(self, state):
        """Go on from :meth:`state_dict`."""
        for array, saved in zip((self.goal_quat, self.step_count), state["arrays"], strict=True):
            array.numpy()[:] = saved
        self._quat = state["quat"].copy()
        self._rng.bit_generator.state = state["rng"]
        self._publish()

    def close(self):
        """Nothing to release."""
