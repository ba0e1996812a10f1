"""Time, memory and what is told: states seen late, drawn dynamics, and how long a force acts."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg, TrackedPoseCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.conditions import CONDITIONS, EXACT
from vd.kernels.servo import actuators
from vd.kernels.task import dynamics
from vd.kernels.task.observations import teacher_observation_slices
from vd.sim.cfg import SimCfg, coarser

WORLDS = 3
STEP_S = 1.0 / 12.0


def make(**changes) -> ReorientEnv:
    cfg = ReorientCfg(hand="dclaw3", objects=("cube",), num_envs=WORLDS, randomisation=EXACT)
    return ReorientEnv(dataclasses.replace(cfg, **changes), "cpu")


def run(env: ReorientEnv, steps: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random actions from equal starts.

    What was observed, before the first step too, and what was true.
    """
    quats = Rotation.random(WORLDS, rng=np.random.default_rng(1)).as_quat()
    # Building one drew a latency, another did not.
    env.state.rng.assign(np.arange(WORLDS, dtype=np.uint32))
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


def late(latency_s: float, encoder_s: float = 0.0, **changes) -> RandomisationCfg:
    late_s, encoder = (latency_s, latency_s), (encoder_s, encoder_s)
    return dataclasses.replace(
        EXACT, observation_latency_s=late_s, encoder_latency_s=encoder, **changes
    )


@pytest.mark.parametrize(("object_late", "hand_late"), [(0, 0), (2, 0), (2, 2), (1, 3)])
def test_object_and_hand_are_seen_as_old_as_each_is_and_what_is_true_is_paid(
    object_late, hand_late
):
    observation = ObservationCfg(shape="full")
    present = run(make(observation=observation), 7)
    random = late(max(1e-9, object_late * STEP_S), hand_late * STEP_S)
    then = run(make(observation=observation, randomisation=random), 7)
    parts = teacher_observation_slices(3, 9)
    ages = np.full(present["seen"].shape[2], object_late)
    for name in ("joint_position", "joint_velocity", "fingertips"):
        ages[parts[name]] = hand_late
    for name in ("goal_orientation", "previous_action"):  # known, not measured
        ages[parts[name]] = 0
    # A late object and other fingertips: what lies between them is of no state.
    if object_late != hand_late:
        ages[parts["previous_action"].stop :][:9] = -1
    for step in range(8):
        for age in set(ages) - {-1}:
            np.testing.assert_array_equal(
                then["seen"][step][:, ages == age],
                present["seen"][max(0, step - age)][:, ages == age],
            )
    np.testing.assert_array_equal(then["reward"], present["reward"])
    assert np.ptp(present["state"], axis=0).max() > 0.05, "something moves"


def test_the_nearest_surface_is_from_present_fingertips_to_the_late_object():
    env = make(observation=ObservationCfg(shape="full"), randomisation=late(STEP_S))
    joint_q, body_q = [], []
    for step in range(5):
        env.action.fill_(0.5 if step % 2 else -0.5)
        env.step(env.action)
        joint_q.append(env.sim.joint_q.numpy().copy())
        body_q.append(env.sim.body_q.numpy().copy())
    exact = make(observation=ObservationCfg(shape="full"))
    exact.sim.joint_q.assign(joint_q[-2])
    exact.sim.body_q.assign(body_q[-1])
    exact.observe()
    columns = slice(teacher_observation_slices(3, 9)["previous_action"].stop, None)
    exact.goal_quat.assign(env.goal_quat)
    exact.observe()
    np.testing.assert_allclose(
        env.observation.numpy()[:, columns], exact.observation.numpy()[:, columns], atol=1e-5
    )


def test_a_latency_between_steps_is_that_of_the_nearest_physics_step():
    env, present = make(randomisation=late(0.4 * STEP_S)), make()
    parts, q = teacher_observation_slices(3, 9)["object_position"], present.num_actions
    past: list[np.ndarray] = []
    present.step = lambda _: present.launch_step()  # a captured graph would not call back
    present.sim.after_physics_step = lambda joint_q, *_: past.append(
        joint_q.numpy()[:, q : q + 3].copy()
    )
    run(present, 3)
    np.testing.assert_array_equal(run(env, 3)["seen"][-1][:, parts], past[-1 - 4])


def tracked(**changes) -> RandomisationCfg:
    """A tracker of 6 poses a second, 50 ms late, without errors."""
    exact = {"dropped": 0.0, "jumping": 0.0, "noise": (0.0, 0.0)} | changes
    tracker = TrackedPoseCfg(rate_hz=(6.0, 6.0), age_s=(0.05, 0.05), **exact)
    return dataclasses.replace(EXACT, tracked_pose=tracker)


def test_a_tracked_pose_is_a_true_one_of_the_past_and_held_until_the_next_comes():
    """At 6 Hz every second step brings one, 50 to 133 ms old, and velocity is what it moved."""
    present, env = make(), make(randomisation=tracked())
    q, parts = present.num_actions, teacher_observation_slices(3, 9)
    past: list[np.ndarray] = []
    present.step = lambda _: present.launch_step()  # a captured graph would not call back
    present.sim.after_physics_step = lambda joint_q, *_: past.append(
        joint_q.numpy()[:, q : q + 3].copy()
    )
    run(present, 8)
    seen = run(env, 8)["seen"]
    heights, told = np.array(past)[..., 2], seen[..., parts["object_position"]][..., 2]
    changed = np.abs(np.diff(told, axis=0)) > 0.0
    assert (changed[2:].sum(axis=0) == 3).all(), "the first may still show the start"
    assert not (changed[1:] & changed[:-1]).any()
    np.testing.assert_array_equal(
        seen[..., parts["joint_position"]], run(make(), 8)["seen"][..., parts["joint_position"]]
    )
    speeds = seen[..., parts["object_velocity"]][..., 2]
    for world in range(WORLDS):
        came = np.flatnonzero(changed[2:, world]) + 3  # the first one refers to the start
        for step in came:
            ages = 10 * step - 1 - np.flatnonzero(heights[:, world] == told[step, world])
            assert any(6 <= age <= 16 for age in ages), f"{ages} physics steps old"
            moved = told[step, world] - told[step - 1, world]
            np.testing.assert_allclose(speeds[step, world], 6.0 * moved, rtol=0.01, atol=1e-4)


def test_a_tracker_that_drops_every_pose_shows_the_start_and_has_ages_of_its_own():
    seen = run(make(randomisation=tracked(dropped=1.0)), 4)["seen"]
    parts = teacher_observation_slices(3, 9)
    assert not np.ptp(seen[..., parts["object_position"]], axis=0).any()
    assert not seen[..., parts["object_velocity"]].any()
    both = dataclasses.replace(tracked(), observation_latency_s=(0.0, 0.1))
    with pytest.raises(ValueError, match=r"tracked_pose .*leave observation_lat"):
        make(randomisation=both)
    slow = TrackedPoseCfg(rate_hz=(0.5, 30.0))
    with pytest.raises(ValueError, match=r"rate_hz is 0.5 30; .*2"):
        make(randomisation=dataclasses.replace(EXACT, tracked_pose=slow))


def test_encoders_are_read_late_and_then_seen_late():
    effects = {"read_delay.delay_s": (STEP_S, STEP_S)}
    read = run(make(randomisation=dataclasses.replace(EXACT, effects=effects)), 6)["seen"]
    seen = run(make(randomisation=late(0.0, STEP_S, effects=effects)), 6)["seen"]
    joints = teacher_observation_slices(3, 9)["joint_position"]
    np.testing.assert_allclose(seen[2:, :, joints], read[1:-1, :, joints], atol=1e-6)


def test_every_episode_draws_its_latency_and_forgets_the_one_before():
    random = dataclasses.replace(
        EXACT, observation_latency_s=(0.02, 0.1), encoder_latency_s=(0.0, 0.04), redraw_s=100.0
    )
    env = make(randomisation=random, episode_s=0.5)
    env.step_count.assign(np.array([0, 4, 0], dtype=np.int32))
    before = env.observer.seen.latency.numpy().copy()
    assert len(set(before)) == WORLDS and before.min() >= 0.02 and before.max() <= 0.1
    encoders = env.observer.seen.encoder_latency.numpy()
    np.testing.assert_allclose(encoders / 0.04, (before - 0.02) / 0.08, atol=1e-5)
    for _ in range(2):
        env.action.fill_(0.7)
        env.step(env.action)
    assert env.timed_out.numpy().tolist() == [0, 1, 0]
    after = env.observer.seen.latency.numpy()
    assert after[1] != before[1] and np.array_equal(after[[0, 2]], before[[0, 2]])
    seen = env.observation.numpy()
    start = make().observation.numpy()
    joints = teacher_observation_slices(3, 9)["joint_position"]
    np.testing.assert_allclose(seen[1, joints], start[1, joints], atol=1e-6)


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
        order = np.argsort(
            env.symmetry_frames.tables.joints[env.symmetry_frames.chosen.numpy()], axis=1
        )
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
    assert np.ptp(delays, axis=1).max() < 1e-6 < np.ptp(delays[:, 0]), (
        "one bus, and another in every world"
    )


def test_only_the_critic_is_told_and_nothing_varies_where_nothing_is_drawn():
    env = make(
        randomisation=RandomisationCfg(enabled=False), observation=ObservationCfg(dynamics="critic")
    )
    plain = make(randomisation=RandomisationCfg(enabled=False))
    assert env.num_observations == plain.num_observations
    np.testing.assert_array_equal(run(env, 3)["seen"], run(plain, 3)["seen"])
    np.testing.assert_allclose(told(env, "dynamics"), 0.0, atol=2e-4)
    np.testing.assert_array_equal(told(env, "present"), env.observation.numpy())
    assert env.privileged.shape[1] == dynamics.dynamics_size(9) + env.num_observations
    assert plain.privileged.shape[1] == 0


@pytest.mark.parametrize("view", ["world", "goal", "mirrored"])
def test_the_critic_is_told_the_present_as_it_would_be_seen_at_once_and_without_noise(view):
    seen = ObservationCfg(shape="full", view=view)
    random = late(STEP_S, observation_noise_std=0.1)
    env = make(randomisation=random, observation=dataclasses.replace(seen, dynamics="critic"))
    exact = make(observation=seen)
    run(env, 5)
    out = run(exact, 5)["seen"][-1]
    count = exact.num_observations
    np.testing.assert_allclose(env.privileged.numpy()[:, -count:], out, atol=1e-5)
    assert np.abs(env.observation.numpy()[:, :count] - out).max() > 0.1


@pytest.mark.parametrize("condition", ["mixed", "mixed-tracked"])
def test_a_saved_past_goes_on_exactly(condition):
    changes = {
        "randomisation": dataclasses.replace(CONDITIONS[condition], encoder_latency_s=(0.0, 0.02)),
        "observation": ObservationCfg(dynamics="critic", view="goal"),
    }
    first, second = make(**changes), make(**changes)
    run(first, 4)
    run(second, 2, seed=9)
    second.load_state_dict(first.state_dict())
    for env in (first, second):
        for _ in range(3):
            env.action.fill_(0.3)
            env.step(env.action)
    np.testing.assert_array_equal(
        first.observer.all_values.numpy(), second.observer.all_values.numpy()
    )
    with pytest.raises(ValueError, match="observation_latency_s"):
        make().load_state_dict(first.state_dict())


@pytest.mark.parametrize(
    ("force_s", "share", "sim"), [(1.0 / 60.0, 0.2, coarser(SimCfg())), (STEP_S, 1.0, SimCfg())]
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
    direction = (
        env.randomiser.force.numpy() / np.linalg.norm(env.randomiser.force.numpy(), axis=1)[:, None]
    )
    np.testing.assert_allclose(gained[-1], 15.0 * force_s * direction, atol=2e-3)
    steps = round(share * env.cfg.sim.substeps)
    np.testing.assert_allclose(gained[steps - 1], gained[-1], atol=1e-5)
    assert np.linalg.norm(gained[0], axis=1) == pytest.approx(15.0 * force_s / steps, rel=0.02)


def test_a_centre_of_mass_beside_the_middle_reaches_the_solver():
    env = make(randomisation=dataclasses.replace(EXACT, object_com_m=0.01))
    centre = env.sim.solver.mjw_model.body_ipos.numpy()[:, -1]
    assert np.linalg.norm(centre, axis=1) == pytest.approx(0.01, rel=1e-5)
    assert len(np.unique(centre[:, 0])) == WORLDS
    assert not make().sim.solver.mjw_model.body_ipos.numpy()[:, -1].any()
