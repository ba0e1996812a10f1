"""What a hand would sense if a simulated world were its own."""

import numpy as np

from vd.deploy.loop.policy_runner import Sensed
from vd.envs.reorient import ReorientEnv


def state_of(env: ReorientEnv) -> Sensed:
    """What a hand and its twin would report of a world."""
    d = env.num_actions
    q, qd = env.sim.joint_q.numpy()[0], env.sim.joint_qd.numpy()[0]
    state = np.concatenate([q[d:], qd[d:]])
    return Sensed(
        joint_q=env.measured_q.numpy()[0, :d].copy(),
        joint_qd=env.measured_qd.numpy()[0, :d].copy(),
        smoothed=env.smoothed.numpy()[0].copy(),
        goal_quat=env.goal_quat.numpy()[0].copy(),
        truth=state,
        object_state=state,
    )
