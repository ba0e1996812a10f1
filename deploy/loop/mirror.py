"""A simulated world that takes the state of a hand: what the simulator would observe in it."""

from typing import Any

import numpy as np
import torch
import warp as wp

from vd.assets_usd.hand_data import canonical_quat
from vd.deploy.loop.observation import Sensed
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.statistics import rotation_angle


class Mirror:
    """One world of the environment of a training, put into states from elsewhere; it is never stepped.

    Args:
        task: The environment: one world of one object, not randomised.
    """

    def __init__(self, task: ReorientCfg):
        if task.num_envs != 1 or task.randomisation.enabled:
            raise ValueError("a mirror is one world that is not randomised")
        self.env = ReorientEnv(task, "cpu")
        self._goal: np.ndarray | None = None
        self._turn: np.ndarray | None = None

    def begin(self) -> None:
        """The next state is the first of its goal, also where that is the same as before."""
        self._goal = None

    def take(self, sensed: Sensed) -> None:
        """Take a state, one in every control step: they are counted for the time of the goal.

        Args:
            sensed: The state, with that of the object.

        Raises:
            ValueError: The object's state is not known.
        """
        pose, velocity = sensed.object_pose, sensed.object_velocity
        if pose is None or velocity is None:
            raise ValueError("the state of the object is not known: only a twin tells it")
        if self._turn is not None and self._turn @ pose[3:] < 0.0:  # the other quaternion of the same
            pose = np.concatenate([pose[:3], -pose[3:]])
        self._turn = pose[3:].copy()
        env = self.env
        for arrays, values in (
            ((env.sim.joint_q, env.measured_q), np.concatenate([sensed.joint_q, pose])),
            ((env.sim.joint_qd, env.measured_qd), np.concatenate([sensed.joint_qd, velocity])),
            ((env.smoothed,), sensed.smoothed),
        ):
            for array in arrays:
                whole = array.numpy()
                whole[0, : len(values)] = values[: whole.shape[1]]
                array.assign(whole)
        goal = canonical_quat(sensed.goal_quat)
        if self._goal is None or not np.array_equal(self._goal, goal):
            self._goal = goal.copy()
            env.give_goals(self._goal[None])
        else:
            env.goal_steps.fill_(int(env.goal_steps.numpy()[0]) + 1)
        env.rotation_error.fill_(float(rotation_angle(pose[None, 3:].astype(float), self._goal[None])[0]))
        env.sim.forward_kinematics()
        env.observe()


class TeacherSight:
    """What a teacher sees of a twin: the true state, as the environment of its training shows it.

    Args:
        policy: The teacher.
        mirror: A world of its training.
    """

    def __init__(self, policy: Any, mirror: Mirror):
        self._policy, self.mirror = policy, mirror

    def act(self, sensed: Sensed) -> np.ndarray:
        """Mean action, in the joints' order [D]."""
        self.mirror.take(sensed)
        env = self.mirror.env
        action = self._policy.act(wp.to_torch(env.observation)).contiguous().float()
        if env.views is not None:
            action = wp.to_torch(env.views.world_action(wp.from_torch(action)))
        return _row(action)


def _row(action: torch.Tensor) -> np.ndarray:
    return action[0].numpy().copy()
