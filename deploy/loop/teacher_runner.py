"""A teacher on a twin: it reads the true state, which no real hand tells, as its environment shows it."""

from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import canonical_quat
from vd.deploy.loop.policy_runner import Decision, PolicyRunner, Sensed
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.agents import task_for
from vd.evaluate.second_view import SecondView
from vd.evaluate.statistics import rotation_angle
from vd.paper import PAPER
from vd.policy import TrainedPolicy
from vd.stopping import StoppingRule


class Mirror:
    """An environment of a training, put into states from elsewhere; it is never stepped.

    Args:
        task: The environment: one of one object, not randomised.
    """

    def __init__(self, task: ReorientCfg):
        self.env = ReorientEnv(task, "cpu")
        self._goal: np.ndarray | None = None
        self._turn: np.ndarray | None = None

    def begin(self) -> None:
        """The next state is the first of its goal, also where that is the same as before."""
        self._goal = None

    def take(self, sensed: Sensed) -> None:
        """Take a state, one in every control step: they are counted for the time of the goal.

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


class TeacherRunner(PolicyRunner):
    """A teacher on a twin.

    Arguments are those of :func:`vd.deploy.loop.load_runner.load_runner`.

    Raises:
        ValueError: It is to select views, and has no critic, or sees its goals in none.
    """

    kind = "teacher"
    needs_truth = True

    def __init__(
        self,
        policy: TrainedPolicy,
        hand_name: str,
        item_name: str,
        tolerance_rad: float = PAPER.success.rotation_rad,
        *,
        second_view: bool = False,
    ):
        task = task_for(
            policy,
            hand=hand_name,
            objects=(item_name,),
            num_envs=1,
            seed=0,
            stop_tolerance_rad=PAPER.success.rotation_rad,
            max_goal_angle_rad=None,
            episode_s=PAPER.scene.episode_s,
            randomised=False,
            success_ends_episode=False,
            at_rest=False,
            second_view=second_view,
        )
        super().__init__(task, StoppingRule(tolerance_rad))
        self.mirror = Mirror(task)
        self._actor: Any = SecondView(self.mirror.env, policy) if second_view else policy

    def new_goal(self) -> None:
        """The time of the goal is counted anew, for a teacher that sees it."""
        self.mirror.begin()

    def decide(self, sensed: Sensed) -> Decision:
        """Mean action, in the joints' order, and true distance."""
        self.mirror.take(sensed)
        env = self.mirror.env
        action = self._actor.act(wp.to_torch(env.observation)).contiguous().float()
        if env.views is not None:
            action = wp.to_torch(env.views.world_action(wp.from_torch(action)))
        return Decision(action[0].numpy().copy(), float(env.rotation_error.numpy()[0]))
