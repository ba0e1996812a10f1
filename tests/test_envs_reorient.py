"""Behaviour of the environment: determinism, fresh observations, goals, guards, randomisation."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.model import write_object
from vd.assets_usd.objects.procedural import cube
from vd.envs.cfg import (
    CurriculumCfg,
    LevelCfg,
    LooseCfg,
    ObservationCfg,
    RandomisationCfg,
    ReorientCfg,
    RewardCfg,
    SpinCfg,
    StartCfg,
    SuccessCfg,
    TableCfg,
)
from vd.envs.parts import observation_columns
from vd.envs.reorient import ReorientEnv
from vd.envs.setup import ALWAYS, chosen, table_steps
from vd.kernels.task.observations import teacher_observation_size, teacher_observation_slices
from vd.kernels.task.shapes import (
    EXTENT_CENTRE_M,
    SHAPE_UNIT_M,
    extent_directions,
    shape_observation_size,
    shape_observation_slices,
)
from vd.paper import PAPER
from vd.sim.cfg import SimCfg
from vd.sim.simulator import SimulationError

WORLDS = 4
STILL = RandomisationCfg(enabled=False)


def make(device: str = "cpu", **changes) -> ReorientEnv:
    cfg = ReorientCfg(hand="dclaw3", objects=("cube",), num_envs=WORLDS, randomisation=STILL)
    return ReorientEnv(dataclasses.replace(cfg, **changes), device)


def run(env: ReorientEnv, steps: int, seed: int = 0) -> np.ndarray:
    """Random actions; returns the observations of every step, [steps, N, O]."""
    rng = np.random.default_rng(seed)
    seen = []
    for _ in range(steps):
        env.action.assign(rng.uniform(-1, 1, (env.num_envs, env.num_actions)).astype(np.float32))
        env.step(env.action)
        seen.append(env.observation.numpy().copy())
    env.check()
    return np.array(seen)


def test_the_same_seed_gives_the_same_rollout_on_the_cpu():
    cfg = {"randomisation": RandomisationCfg(enabled=True), "seed": 3}
    first, second = run(make(**cfg), 30), run(make(**cfg), 30)
    assert np.array_equal(first, second)
    assert not np.array_equal(first, run(make(**{**cfg, "seed": 4}), 30))


def test_the_table_costs_while_the_object_touches_it_and_height_above_it_pays():
    """Equation 7: c6 in every step of contact, none while the object falls or is held."""
    env = make(reward=RewardCfg(table_contact=-3.0, lift=4.0), table=TableCfg(lift_share=1.0))
    column, lift = map(env.reward_term_names.index, ("table_contact", "lift"))
    seen, paid, heights = [], [], []
    for _ in range(24):
        env.step(env.action)
        seen.append(env.reward_terms.numpy()[:, column].copy())
        paid.append(env.reward_terms.numpy()[:, lift].copy())
        heights.append(env.object_pose_end.numpy()[:, 2].copy())
    seen, heights = np.array(seen), np.array(heights)
    falling = heights > heights[-1] + 0.02
    assert falling[0].all() and not falling[-1].any()
    assert (seen[falling] == 0.0).all() and (seen[-1] == -3.0).all()
    # Surface points are a sample: the lowest of them may lie a little above the surface.
    assert (paid[0] > 1.0).all() and (paid[-1] < 0.4).all()
    assert env.reward.numpy() == pytest.approx(env.reward_terms.numpy().sum(axis=1), rel=1e-5)

    env.sim.place_table(present=False)
    env.reset()
    env.step(env.action)
    assert (env.reward_terms.numpy()[:, column] == 0.0).all()
    assert RewardCfg().table_contact == PAPER.reward.table_contact == -1.0


def test_tables_leave_their_share_of_worlds_in_time():
    """In a world that loses its table after 1.5 s the object, at rest until then, falls."""
    env = make(table=TableCfg(away_share=0.5, away_s=(1.5, 1.5)), num_envs=4, episode_s=2.5)
    lost = table_steps(env.cfg, 1.0) < ALWAYS
    assert lost.sum() == 2
    heights, fell, gone = [], np.zeros(4, dtype=int), round(1.5 * env.cfg.sim.control_hz)
    for _ in range(env.max_episode_steps):
        env.step(env.action)
        heights.append(env.object_pose_end.numpy()[:, 2].copy())
        fell += env.fell.numpy()
        if len(heights) == gone:
            assert not fell.any() and env.has_table().all()
        if len(heights) == gone + 1:
            np.testing.assert_array_equal(env.has_table(), ~lost)
    assert (fell[lost] > 0).all() and not fell[~lost].any()
    assert env.has_table().all(), "tables are back when episodes begin anew"
    before, after = heights[gone - 1], heights[gone + 1]
    assert (after[lost] < before[lost] - 0.02).all() and np.allclose(
        after[~lost], before[~lost], atol=2e-3
    )


def test_a_goal_on_the_table_counts_only_where_nothing_is_to_be_lifted():
    """Objects at rest on the table, each at its goal: half of the environments must lift theirs."""
    loose = SuccessCfg(rotation_rad=np.pi, joint_speed_rad_s=0.0, action_norm=0.0)
    env = make(table=TableCfg(lift_share=0.5), success=loose, num_envs=8)
    lift = chosen(env.cfg, 0.5) == 1
    reached = np.zeros(8, dtype=int)
    for _ in range(24):
        env.step(env.action)
        still = env.sim.table_force.numpy() > PAPER.reward.table_contact_force_n
        reached += env.success.numpy() * still
    assert (reached[~lift] > 0).all() and not reached[lift].any()


ANYTHING = SuccessCfg(
    rotation_rad=np.pi,
    joint_speed_rad_s=0.0,
    object_speed_m_s=0.0,
    object_spin_rad_s=0.0,
    action_norm=0.0,
)


def test_a_goal_given_in_the_middle_is_seen_at_once_and_moves_nothing():
    env, goal = make(), np.array([[0.0, 0.0, np.sin(0.3), np.cos(0.3)]])
    run(env, 5)
    before, steps, q = (
        env.goal_quat.numpy().copy(),
        env.step_count.numpy().copy(),
        env.sim.joint_q.numpy(),
    )
    env.give_goals(np.array([1]), goal)
    np.testing.assert_array_equal(env.sim.joint_q.numpy(), q)
    np.testing.assert_array_equal(env.step_count.numpy(), steps)
    np.testing.assert_allclose(np.abs((env.goal_quat.numpy()[1] * goal).sum()), 1.0, atol=1e-6)
    np.testing.assert_array_equal(env.goal_quat.numpy()[[0, 2, 3]], before[[0, 2, 3]])
    columns = teacher_observation_slices(3, 9)["goal_orientation"]
    seen = env.observation.numpy()[:, columns]
    np.testing.assert_allclose(np.abs((seen[1] * goal).sum()), 1.0, atol=1e-6)
    assert not env.smoothed.numpy()[1].any() and env.smoothed.numpy()[0].any()


def test_a_success_gives_a_new_goal_without_a_reset():
    env = make(success=ANYTHING)
    before = env.goal_quat.numpy().copy()
    run(env, 3)
    assert (env.success.numpy() == 1).all() and (env.done.numpy() == 1).all()
    assert (env.step_count.numpy() == 3).all(), "the episode goes on"
    after = env.goal_quat.numpy()
    assert not np.allclose(before, after)
    columns = teacher_observation_slices(3, 9)["goal_orientation"]
    assert np.allclose(env.observation.numpy()[:, columns], after), (
        "the observation shows the new goal"
    )


def test_evaluation_stops_at_success():
    env = make(success=ANYTHING, success_ends_episode=True)
    run(env, 1)
    assert (env.step_count.numpy() == 0).all()
    start = env.object_pose()[:, :3]
    # Dropped from within a centimetre of there, or moved away from a finger by some more.
    assert np.abs(start - [0.0, 0.0, 0.12]).max() < 0.05
    ended = env.object_pose_end.numpy()
    assert not np.allclose(ended[:, :3], start), "the pose at the end is kept"


@pytest.mark.parametrize(
    ("seeing", "object_signs"),
    [
        (ObservationCfg(shape="full", view="goal", canonical=True), (1.0, -1.0)),
        (ObservationCfg(shape="full", view="goal"), (1.0,)),
    ],
    ids=["canonical", "as shipped policies see it"],
)
def test_nothing_depends_on_the_sign_of_a_quaternion(seeing, object_signs):
    """Observation, reward and the action of a network on it, through a few steps of physics, bit for bit."""
    env = make(observation=seeing, seed=5)
    first = env.state_dict()
    rng = np.random.default_rng(0)
    start, goal = (Rotation.random(WORLDS, rng=rng).as_quat() for _ in range(2))
    goal[0] = (Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_quat(start[0])).as_quat()
    weights = rng.normal(size=(env.num_observations, env.num_actions)).astype(np.float32)
    runs = []
    for object_sign in object_signs:
        for goal_sign in (1.0, -1.0):
            env.load_state_dict(first)
            env.reset(object_sign * start, goal_sign * goal)
            seen = []
            for _ in range(4):
                action = np.tanh(env.observation.numpy() @ weights)
                seen += [env.observation.numpy().copy(), action]
                env.action.assign(action)
                env.step(env.action)
                seen += [env.reward.numpy().copy(), env.rotation_error.numpy().copy()]
            runs.append(seen)
    for other in runs[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_objects_can_start_at_rest():
    env = make(start=StartCfg(at_rest=True, poses=2))
    first = env.object_pose()
    env.action.zero_()
    env.step(env.action)
    moved = np.linalg.norm(env.object_pose_end.numpy()[:, :3] - first[:, :3], axis=1)
    assert (first[:, 2] < 0.06).all() and moved.max() < 2e-3
    env.reset()
    assert not np.allclose(env.object_pose()[:, 3:], first[:, 3:]), "every start is turned anew"


def test_lost_contacts_stop_the_run_and_name_the_setting():
    env = make(sim=dataclasses.replace(SimCfg(), njmax=8))
    with pytest.raises(SimulationError, match=r"sim\.njmax \(now 8\)"):
        run(env, 30)


def test_a_state_that_is_not_finite_stops_the_run():
    env = make()
    run(env, 5)
    env.sim.joint_qd.numpy()[2, 0] = np.nan
    with pytest.raises(SimulationError, match=r"world 2, object cube"):
        run(env, 3)


@pytest.mark.parametrize("tolerant", [0.0, 1e6])
def test_a_policy_that_gives_no_number_ends_the_run(tolerant):
    """Also where steps may fail: it is the policy that does, and its episodes are worth nothing."""
    env = make(failures_per_million=tolerant)
    run(env, 2)
    before = env.sim.joint_q.numpy()[2, : env.num_joints].copy()
    env.action.numpy()[2, 0] = np.nan
    with pytest.raises(ValueError, match=r"environment 2"):
        for _ in range(2):
            env.step(env.action)
    moved = np.abs(env.sim.joint_q.numpy()[2, : env.num_joints] - before).max()
    assert moved < 0.1, "it drove to a limit"
    env.action.zero_()
    run(env, 2)  # it was told


@pytest.mark.parametrize(
    "effects", [{}, {"command_delay.delay_s": (0.0, 0.04)}], ids=["drives", "servos"]
)
def test_a_run_goes_on_without_the_few_worlds_that_fail(effects):
    random = RandomisationCfg(enabled=bool(effects), effects=effects)
    env = make(failures_per_million=1e5, randomisation=random)  # one more in ten steps
    env.sim.joint_qd.numpy()[:, 0] = np.nan
    env.step(env.action)
    env.check()  # all environments in the first step: more than the rate, and few
    run(env, 5)
    before = env.step_count.numpy().copy()
    env.sim.joint_qd.numpy()[2, 0] = np.nan
    env.step(env.action)
    assert (
        env.timed_out.numpy()[2] == 1
        and env.done.numpy()[2] == 1
        and env.step_count.numpy()[2] == 0
    )
    np.testing.assert_array_equal(np.delete(env.step_count.numpy(), 2), np.delete(before + 1, 2))
    assert env.reward.numpy()[2] == 0.0
    run(env, 3)
    fingers = env.fingers.tip_pos, env.fingers.effort
    for array in (env.observation, env.reward, env.reward_terms, env.rotation_error, *fingers):
        assert np.isfinite(array.numpy()).all()
    env.check()
    for _ in range(40):
        env.sim.joint_qd.numpy()[1, 0] = np.nan
        env.step(env.action)
    with pytest.raises(SimulationError, match=r"4 of \d+ environments"):
        env.check()


def test_saved_state_continues_exactly():
    cfg = {"randomisation": RandomisationCfg(enabled=True)}
    env = make(**cfg)
    run(env, 10, seed=1)
    state = env.state_dict()
    expected = run(env, 10, seed=2)
    other = make(**cfg)
    run(other, 3, seed=9)
    other.load_state_dict(state)
    assert np.array_equal(run(other, 10, seed=2), expected)
    with pytest.raises(ValueError, match="num_envs"):
        make(num_envs=2, **cfg).load_state_dict(state)


def test_the_shape_is_seen_behind_the_state_and_changes_nothing_else(device):
    seeing = {
        "objects": ("symmetric",),
        "num_envs": 14,
        "observation": ObservationCfg(shape="full"),
    }
    random = RandomisationCfg(enabled=True, observation_noise_mean=0.0, observation_noise_std=0.0)
    env = make(device, **seeing, randomisation=random)
    run(env, 3)
    state = teacher_observation_size(3, 9)
    observation = env.observation.numpy()
    assert env.num_observations == observation.shape[1] == state + shape_observation_size(3)
    slices = shape_observation_slices(3)
    tips = observation[:, teacher_observation_slices(3, 9)["fingertips"]].reshape(-1, 3, 13)[
        ..., :3
    ]
    vectors = SHAPE_UNIT_M * observation[:, state:][:, slices["surface"]].reshape(-1, 3, 3)
    extents = EXTENT_CENTRE_M + SHAPE_UNIT_M * observation[:, state:][:, slices["extent"]]
    pose, goal = env.object_pose(), env.goal_quat.numpy()
    assert set(np.round(env.scene.world_scale, 3)) == {0.95, 1.0, 1.05}, "sizes differ"
    for w in range(env.num_envs):
        cloud = env.scene.world_scale[w] * env.objects[env.world_object[w]].surface_points.astype(
            float
        )
        placed = Rotation.from_quat(pose[w, 3:]).apply(cloud)
        assert extents[w] == pytest.approx(
            (placed @ np.array(extent_directions(3)).T).max(axis=0), abs=1e-5
        )
        aim = Rotation.from_quat(goal[w]).apply(cloud)
        goal_extents = (
            EXTENT_CENTRE_M + SHAPE_UNIT_M * observation[w, state:][slices["goal_extent"]]
        )
        assert goal_extents == pytest.approx(
            (aim @ np.array(extent_directions(3)).T).max(axis=0), abs=1e-5
        )
        distance = np.linalg.norm(tips[w][:, None] - (pose[w, :3] + placed)[None], axis=2).min(
            axis=1
        )
        assert np.linalg.norm(vectors[w], axis=1) == pytest.approx(distance, abs=1e-5)


def test_randomisation_reaches_the_solver():
    env = make(num_envs=16, randomisation=RandomisationCfg(enabled=True))
    model, mujoco = env.sim.model, env.sim.solver.mjw_model
    mass = model.body_mass.numpy().reshape(16, -1)[:, env.scene.object_body]
    low, high = env.cfg.randomisation.object_mass_kg
    assert len(np.unique(mass)) == 16 and (mass >= low).all() and (mass <= high).all()
    assert np.allclose(mujoco.body_mass.numpy()[:, -1], mass)
    gains = mujoco.actuator_gainprm.numpy()[:, :, 0]
    assert np.allclose(gains, env.randomiser.kp.numpy())
    ratio = gains / env.hand.kp
    assert ratio.min() >= 0.8 and ratio.max() <= 1.2 and len(np.unique(ratio)) > 100
    assert env.sim.joint_q.numpy().shape == (16, 9 + 7)


def test_objects_weigh_what_their_files_say_where_nothing_is_drawn(tmp_path):
    write_object(tmp_path / "cube.usd", dataclasses.replace(cube(), mass_kg=0.25))
    env = make(num_envs=2, objects=(str(tmp_path),))
    assert env.sim.model.body_mass.numpy().reshape(2, -1)[
        :, env.scene.object_body
    ] == pytest.approx(0.25)
    assert env.randomiser.object_mass.numpy() == pytest.approx(0.25)


def rising(**loose) -> CurriculumCfg:
    """A curriculum whose thresholds tighten."""
    return CurriculumCfg(stillness=LevelCfg(rate=0.1), loose=LooseCfg(**loose))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"randomisation": RandomisationCfg(observation_latency_s=(0.7, 0.7))},
            "observation_latency_s",
        ),
        ({"table": TableCfg(away_share=0.3, away_s=(3.0, 1.0))}, r"table\.away_s"),
        ({"sim": SimCfg(physics_hz=100.0)}, r"sim\.physics_hz"),
        ({"curriculum": rising(action_norm=0.0)}, r"curriculum\.loose\.action_norm is 0"),
        (
            {"curriculum": CurriculumCfg(air=LevelCfg(rate=0.1), object_weight=0.1)},
            r"give table\.lift_share",
        ),
        ({"curriculum": rising(rotation_rad=0.2)}, "raise the latter"),
        (
            {"curriculum": CurriculumCfg(goals=LevelCfg(raise_at=0.2, lower_at=0.3))},
            r"curriculum\.goals\.lower_at",
        ),
    ],
)
def test_settings_that_cannot_work_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        ReorientCfg(**changes).validate()


def spinning(**reward) -> ReorientEnv:
    """Environments that turn without a goal, seen by the joints of five steps."""
    return make(
        reward=RewardCfg(spin=SpinCfg(rate=1.0, **reward)),
        observation=ObservationCfg(history=5, shape="full", dynamics="critic"),
        success=SuccessCfg(rotation_rad=np.pi, joint_speed_rad_s=0.0, action_norm=0.0),
        episode_s=1.0,
    )


def test_what_spins_has_no_goal_and_counts_its_turns_anew_in_each_episode():
    env = spinning()
    turned = []
    for _ in range(12):
        env.advance(env.action)
        assert not env.success.numpy().any(), "any orientation would do"
        assert env.spin is not None
        turned.append(env.spin.turned.numpy().copy())
        column = env.reward_term_names.index("spin")
        paid = env.reward_terms.numpy()[:, column].copy()
        env.renew()
    np.testing.assert_allclose(
        paid, np.clip(12.0 * (turned[-1] - turned[-2]), -1.0, 1.0), atol=1e-4
    )
    assert np.abs(turned[-1]).min() > 1e-4, "what falls between fingers turns"
    assert not env.spin.turned.numpy().any(), "the episode ended"


def test_a_policy_of_joints_sees_neither_the_object_nor_a_goal():
    """The last step of its history is what the critic sees of the joints."""
    env = spinning()
    run(env, 6)
    columns = observation_columns(env.cfg.observation, env.num_fingers, env.num_joints)
    joints = 2 * env.num_joints
    assert [name for name in columns if not name.startswith("critic/")] == ["history"]
    assert env.num_observations == 5 * joints
    everything = np.hstack([env.observation.numpy(), env.privileged.numpy()])
    for name, half in (("joint_position", slice(None, 9)), ("previous_action", slice(9, None))):
        told = everything[:, columns[f"critic/{name}"]]
        assert np.array_equal(env.observation.numpy()[:, -joints:][:, half], told)
    seen = env.observation.numpy().copy()
    q = env.sim.joint_q.numpy()
    q[:, env.num_joints :] += 0.1
    env.sim.joint_q.assign(q)
    env.give_goals(np.arange(WORLDS), np.tile([0.0, 0.0, 1.0, 0.0], (WORLDS, 1)))
    now = env.observation.numpy()
    assert np.array_equal(now[:, :-joints], seen[:, joints:]), "older steps move up"
    assert np.array_equal(now[:, -joints:][:, :9], seen[:, -joints:][:, :9])
