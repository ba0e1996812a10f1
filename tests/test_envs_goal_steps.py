"""For how many control steps a goal has been pursued, by which second views are timed."""

import numpy as np
import warp as wp

from vd.envs.cfg import RandomisationCfg, ReorientCfg, SuccessCfg
from vd.envs.reorient import ReorientEnv

WORLDS = 4


def make(episode_s: float = 10.0) -> ReorientEnv:
    """All goals are half a turn away, about the vertical: a hand that does nothing reaches none."""
    cfg = ReorientCfg(
        hand="dclaw3",
        objects=("cuboid",),
        num_envs=WORLDS,
        episode_s=episode_s,
        randomisation=RandomisationCfg(enabled=False),
        success=SuccessCfg(
            joint_speed_rad_s=0.0, object_speed_m_s=0.0, object_spin_rad_s=0.0, action_norm=0.0, fall_m=1.0
        ),
    )
    env = ReorientEnv(cfg, "cpu")
    start = np.tile([0.0, 0.0, 0.0, 1.0], (WORLDS, 1))
    env.reset(object_quat=start, goal_quat=np.tile([0.0, 0.0, 1.0, 0.0], (WORLDS, 1)))
    return env


def rest(env: ReorientEnv, steps: int) -> None:
    env.action.zero_()
    for _ in range(steps):
        env.step(env.action)


def test_success_and_time_out_begin_the_count_anew():
    env = make(episode_s=0.5)
    rest(env, 4)
    goals = env.goal_quat.numpy()
    goals[1] = env.object_pose()[1, 3:]
    env.goal_quat.assign(goals)
    rest(env, 1)
    assert env.success.numpy().tolist() == [0, 1, 0, 0]
    assert env.goal_steps.numpy().tolist() == [5, 0, 5, 5]
    rest(env, 1)
    assert env.timed_out.numpy().all() and not env.goal_steps.numpy().any()


def test_it_is_saved_and_older_checkpoints_have_the_steps_of_episodes():
    env, other = make(), make()
    rest(env, 3)
    wp.to_torch(env.goal_steps)[0] = 1
    state = env.state_dict()
    other.load_state_dict(state)
    assert other.goal_steps.numpy().tolist() == [1, 3, 3, 3]
    arrays = {name: value for name, value in state["arrays"].items() if name != "goal_steps"}
    other.load_state_dict(state | {"arrays": arrays})
    assert other.goal_steps.numpy().tolist() == [3, 3, 3, 3]
