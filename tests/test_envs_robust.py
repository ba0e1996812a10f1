"""Time, memory and what is told: states seen late, past steps, drawn dynamics, and how long a force acts."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.conditions import CONDITIONS, EXACT
from vd.kernels.servo import actuators
from vd.kernels.task import dynamics, history
from vd.kernels.task.observations import teacher_observation_slices
from vd.sim.cfg import SimCfg, coarser

WORLDS = 3
STEP_S = 1.0 / 12.0


def make(**changes) -> ReorientEnv:
    cfg = ReorientCfg(hand="dclaw3", objects=("cube",), num_envs=WORLDS, randomisation=EXACT)
    return ReorientEnv(dataclasses.replace(cfg, **changes), "cpu")


def run(env: ReorientEnv, steps: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random actions from equal starts: what was observed, before the first step too, and what was true."""
    quats = Rotation.random(WORLDS, rng=np.random.default_rng(1)).as_quat()
    env.state.rng.assign(np.arange(WORLDS, dtype=np.uint32))  # building one drew a latency, another did not
    env.reset(object_quat=quats, goal_quat=quats[::-1])
    rng = np.random.default_rng(seed)
    seen, rewards, states = [env.observation.numpy().copy()], [], [env.sim.joint_q.numpy().copy()]
    for _ in range(steps):
        env.action.assign(rng.uniform(-1, 1, (WORLDS, env.num_actions)).astype(np.float32))
        env.step(env.action)
        seen.append(env.observation.numpy().copy())
        states.append(env.sim.joint_q.numpy().copy())
        rewards.append(env.reward.numpy().copy())
    env.check()
    assert env.step_count.numpy().tolist() == [steps] * WORLDS, "no episode may end on the way"
    return {"seen": np.array(seen), "reward": np.array(rewards), "state": np.array(states)}


def late(latency_s: float, **changes) -> RandomisationCfg:
    return dataclasses.replace(EXACT, observation_latency_s=(latency_s, latency_s), **changes)


@pytest.mark.parametrize("steps_late", [0, 2])
def test_the_policy_sees_what_was_true_a_latency_ago_and_is_paid_for_what_is_true(steps_late):
    observation = ObservationCfg(shape="full")
    present = run(make(observation=observation), 7)
    then = run(make(observation=observation, randomisation=late(max(1e-9, steps_late * STEP_S))), 7)
    parts = teacher_observation_slices(3)
    now = np.zeros(present["seen"].shape[2], dtype=bool)
    for name in ("goal_orientation", "previous_action"):  # known, not measured
        now[parts[name]] = True
    for step in range(8):
        np.testing.assert_array_equal(
            then["seen"][step][:, ~now], present["seen"][max(0, step - steps_late)][:, ~now]
        )
        np.testing.assert_array_equal(then["seen"][step][:, now], present["seen"][step][:, now])
    np.testing.assert_array_equal(then["reward"], present["reward"])
    assert np.ptp(present["state"], axis=0).max() > 0.05, "something moves"


def test_a_latency_between_steps_is_that_of_the_nearest_physics_step():
    env, present = make(randomisation=late(0.4 * STEP_S)), make()
    parts, q = teacher_observation_slices(3)["object_position"], present.num_actions
    past: list[np.ndarray] = []
    present.step = lambda _: present.launch_step()  # a captured graph would not call back
    present.sim.after_physics_step = lambda joint_q, *_: past.append(joint_q.numpy()[:, q : q + 3].copy())
    run(present, 3)
    np.testing.assert_array_equal(run(env, 3)["seen"][-1][:, parts], past[-1 - 4])


def test_encoders_are_read_late_and_then_seen_late():
    effects = {"read_delay.delay_s": (STEP_S, STEP_S)}
    read = run(make(randomisation=dataclasses.replace(EXACT, effects=effects)), 6)["seen"]
    seen = run(make(randomisation=late(STEP_S, effects=effects)), 6)["seen"]
    joints = teacher_observation_slices(3)["joint_position"]
    np.testing.assert_allclose(seen[2:, :, joints], read[1:-1, :, joints], atol=1e-6)


def test_every_episode_draws_its_latency_and_forgets_the_one_before():
    random = dataclasses.replace(EXACT, observation_latency_s=(0.02, 0.1), redraw_s=100.0)
    env = make(randomisation=random, episode_s=0.5, observation=ObservationCfg(history=3))
    env.step_count.assign(np.array([0, 4, 0], dtype=np.int32))
    before = env.observer.seen.latency.numpy().copy()
    assert len(set(before)) == WORLDS and before.min() >= 0.02 and before.max() <= 0.1
    for _ in range(2):
        env.action.fill_(0.7)
        env.step(env.action)
    assert env.timed_out.numpy().tolist() == [0, 1, 0]
    after = env.observer.seen.latency.numpy()
    assert after[1] != before[1] and np.array_equal(after[[0, 2]], before[[0, 2]])
    seen = env.observation.numpy()
    start = make(observation=ObservationCfg(history=3)).observation.numpy()
    joints = teacher_observation_slices(3)["joint_position"]
    np.testing.assert_allclose(seen[1, joints], start[1, joints], atol=1e-6)
    frames = seen[:, env.observer.parts["history"]]
    assert not frames[1].any() and frames[[0, 2]].any(axis=1).all()


def expected_frames(seen: np.ndarray, step: int, count: int, parts: dict[str, slice]) -> np.ndarray:
    """The history as the observations themselves tell it, [N, K, H]."""

    def rotation(observation: np.ndarray) -> Rotation:
        return Rotation.from_quat(observation[:, parts["relative_orientation"]])

    frames = []
    for back in range(1, count + 1):
        past, now = seen[max(0, step - back)], seen[step]
        turn = (rotation(past) * rotation(now).inv()).as_quat(canonical=True)
        frames.append(
            np.concatenate(
                [
                    (past - now)[:, parts["joint_position"]] / history.JOINT_UNIT,
                    past[:, parts["previous_action"]],
                    (past - now)[:, parts["object_position"]] / history.POSITION_UNIT_M,
                    2.0 * turn[:, :3] / history.ROTATION_UNIT_RAD,
                ],
                axis=1,
            )
        )
    return np.stack(frames, axis=1)


@pytest.mark.parametrize("view", ["world", "goal", "mirrored"])
def test_the_history_is_what_was_observed_in_any_view(view):
    observation = ObservationCfg(history=4, view=view, file_axes=False)
    random = dataclasses.replace(late(0.5 * STEP_S), observation_noise_std=0.002)
    env = make(observation=observation, randomisation=random)
    seen = run(env, 7)["seen"]
    if view != "world":
        assert env.symmetry_frames.chosen.numpy().any(), "worlds are seen turned"
    columns = env.observer.parts["history"]
    for step in range(len(seen)):
        got = seen[step][:, columns].reshape(WORLDS, 4, -1)
        wanted = expected_frames(seen, step, 4, teacher_observation_slices(3))
        if step == 0:  # nothing is known of before
            assert not np.delete(got, np.s_[9:18], axis=2).any()
        else:
            np.testing.assert_allclose(got, wanted, atol=2e-4)


def test_a_new_goal_leaves_the_history_as_it_was():
    env = make(observation=ObservationCfg(history=3, file_axes=False))
    run(env, 4)
    frames = env.observation.numpy()[:, env.observer.parts["history"]].copy()
    env.goal_quat.assign(Rotation.random(WORLDS, rng=np.random.default_rng(9)).as_quat().astype(np.float32))
    env.observe()
    np.testing.assert_allclose(env.observation.numpy()[:, env.observer.parts["history"]], frames, atol=2e-4)


def told(env: ReorientEnv, name: str) -> np.ndarray:
    return env.observer.all_values.numpy()[:, env.observer.parts[name]].copy()


@pytest.mark.parametrize("view", ["world", "goal"])
def test_dynamics_are_told_in_the_order_of_the_joints_that_are_seen(view):
    random = dataclasses.replace(CONDITIONS["mixed"], force_probability=0.0)
    env = make(randomisation=random, observation=ObservationCfg(dynamics="critic", view=view))
    run(env, 2)
    rows = env.sim.servo.parameters.numpy().reshape(WORLDS, 9, -1)
    order, drawn = np.tile(np.arange(9), (WORLDS, 1)), env.randomiser
    if view == "goal":
        # Joint of the view that is each joint of the world, turned round.
        order = np.argsort(env.symmetry_frames.tables.joints[env.symmetry_frames.chosen.numpy()], axis=1)
    channels = [
        (drawn.kp.numpy() / env.hand.kp - 1.0) / dynamics.GAIN_UNIT,
        (drawn.kd.numpy() / env.hand.kd - 1.0) / dynamics.GAIN_UNIT,
        rows[:, :, actuators.COMMAND_DELAY] / dynamics.DELAY_UNIT_S,
        rows[:, :, actuators.COULOMB_TORQUE] / dynamics.TORQUE_UNIT_NM,
        rows[:, :, actuators.BACKLASH_WIDTH] / dynamics.PLAY_UNIT_RAD,
    ]
    scalars = [
        drawn.hand_friction.numpy() / 0.8 - 1.0,
        drawn.object_friction.numpy() / 0.8 - 1.0,
        drawn.table_friction.numpy() / 0.5 - 1.0,
        drawn.object_mass.numpy() / 0.1 - 1.0,
        env.observer.seen.latency.numpy() / dynamics.LATENCY_UNIT_S,
    ]
    wanted = [np.take_along_axis(channel, order, axis=1) for channel in channels]
    np.testing.assert_allclose(
        told(env, "dynamics"), np.hstack([*wanted, np.stack(scalars, axis=1)]), atol=1e-4
    )
    assert np.abs(told(env, "dynamics")).max() < 4.0, "of order one"
    delays = rows[:, :, actuators.COMMAND_DELAY]
    assert np.ptp(delays, axis=1).max() < 1e-6 < np.ptp(delays[:, 0]), "one bus, and another in every world"


def test_only_the_critic_is_told_and_nothing_varies_where_nothing_is_drawn():
    env = make(randomisation=RandomisationCfg(enabled=False), observation=ObservationCfg(dynamics="critic"))
    plain = make(randomisation=RandomisationCfg(enabled=False))
    assert env.num_observations == plain.num_observations
    np.testing.assert_array_equal(run(env, 3)["seen"], run(plain, 3)["seen"])
    np.testing.assert_allclose(told(env, "dynamics"), 0.0, atol=2e-4)
    np.testing.assert_array_equal(told(env, "present"), env.observation.numpy())
    assert env.privileged.shape[1] == dynamics.dynamics_size(9) + env.num_observations
    assert env.num_present == env.num_observations and plain.num_present == 0


@pytest.mark.parametrize("view", ["world", "goal", "mirrored"])
def test_the_critic_is_told_the_present_as_it_would_be_seen_at_once_and_without_noise(view):
    seen = ObservationCfg(shape="full", view=view, history=2)
    random = late(STEP_S, observation_noise_std=0.1)
    env = make(randomisation=random, observation=dataclasses.replace(seen, dynamics="critic"))
    exact = make(observation=dataclasses.replace(seen, history=0))
    run(env, 5)
    out = run(exact, 5)["seen"][-1]
    assert env.num_present == exact.num_observations
    np.testing.assert_allclose(env.privileged.numpy()[:, -env.num_present :], out, atol=1e-5)
    assert np.abs(env.observation.numpy()[:, : env.num_present] - out).max() > 0.1


def test_a_saved_memory_goes_on_exactly():
    changes = {
        "randomisation": CONDITIONS["mixed"],
        "observation": ObservationCfg(history=3, dynamics="critic", view="goal"),
    }
    first, second = make(**changes), make(**changes)
    run(first, 4)
    run(second, 2, seed=9)
    second.load_state_dict(first.state_dict())
    for env in (first, second):
        for _ in range(3):
            env.action.fill_(0.3)
            env.step(env.action)
    np.testing.assert_array_equal(first.observer.all_values.numpy(), second.observer.all_values.numpy())
    with pytest.raises(ValueError, match="observation_latency_s"):
        make().load_state_dict(first.state_dict())


@pytest.mark.parametrize(
    ("force_s", "share", "sim"),
    [(1.0 / 60.0, 0.2, coarser(SimCfg())), (STEP_S, 1.0, SimCfg())],
)
def test_a_force_gives_its_impulse_in_the_time_it_acts(force_s, share, sim):
    random = dataclasses.replace(EXACT, force_probability=1.0, force_s=force_s)
    env = make(randomisation=random, sim=sim)
    calm = make(sim=env.cfg.sim)
    ends, d = [], env.num_actions
    for each in (env, calm):
        q = each.sim.joint_q.numpy().copy()
        q[:, d : d + 3] = (0.0, 0.0, 0.6)  # falls freely
        each.sim.joint_q.assign(q)
        speeds: list[np.ndarray] = []
        each.sim.after_physics_step = lambda _, qd, *rest, kept=speeds: kept.append(
            qd.numpy()[:, d : d + 3].copy()
        )
        each.randomiser.disturb()
        each.sim.step()
        ends.append(np.array(speeds))
    gained = ends[0] - ends[1]
    direction = env.randomiser.force.numpy() / np.linalg.norm(env.randomiser.force.numpy(), axis=1)[:, None]
    np.testing.assert_allclose(gained[-1], 15.0 * force_s * direction, atol=2e-3)
    steps = round(share * env.cfg.sim.substeps)
    np.testing.assert_allclose(gained[steps - 1], gained[-1], atol=1e-5)
    assert np.linalg.norm(gained[0], axis=1) == pytest.approx(15.0 * force_s / steps, rel=0.02)
