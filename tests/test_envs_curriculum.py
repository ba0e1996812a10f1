"""How hard the task is while it is learned: when a level moves, and what each asks for."""

import dataclasses

import numpy as np
import pytest

from vd.envs.cfg import (
    CurriculumCfg,
    GoalCfg,
    LevelCfg,
    RandomisationCfg,
    ReorientCfg,
    SuccessCfg,
    TableCfg,
)
from vd.envs.curriculum import LEVELS, Levels, moving_levels, next_levels
from vd.envs.effects import PARAMETERS
from vd.envs.parameters import GOAL_START_RAD, STILLNESS_START
from vd.envs.reorient import ReorientEnv
from vd.evaluate.conditions import CONDITIONS
from vd.kernels.task.observations import teacher_observation_slices
from vd.paper import PAPER

LEVEL = LevelCfg(rate=0.25, raise_at=0.5, lower_at=0.3)
WELL, SO_SO, BADLY = 0.9, 0.4, 0.1
NOTHING = RandomisationCfg(enabled=False)


def make(curriculum: CurriculumCfg, **changes) -> ReorientEnv:
    cfg = ReorientCfg(
        hand="dclaw3", objects=("cube",), num_envs=2, randomisation=NOTHING, curriculum=curriculum
    )
    return ReorientEnv(dataclasses.replace(cfg, **changes), "cpu")


def update(env: ReorientEnv, success_rate: float) -> dict[str, float]:
    """An update after ten goals."""
    env.goal_counts.assign(np.array([10.0, 10.0 * success_rate, 3.0], dtype=np.float32))
    return env.update_curriculum()


def thresholds(env: ReorientEnv) -> list[float]:
    """Joint speed, speed and spin of the object, norm of the action, angle.

    What success asks at present.
    """
    values = env.parameters.success.numpy()
    names = ("joint_speed", "object_speed", "object_spin", "action_norm", "rotation")
    return [float(values[name][0]) for name in names]


def test_goals_recede_only_while_they_are_reached():
    env = make(CurriculumCfg(goals=LEVEL), goal=GoalCfg(max_angle_rad=1.5))

    def present() -> tuple[float, float]:
        return thresholds(env)[0], float(env.parameters.goal.numpy()["max_angle"][0])

    limit = SuccessCfg().joint_speed_rad_s
    assert present() == pytest.approx((STILLNESS_START * limit, GOAL_START_RAD))
    update(env, WELL)
    assert env.levels == Levels(goals=0.25) and env.progress == 0.25
    assert present()[0] < STILLNESS_START * limit and present()[1] > GOAL_START_RAD
    for _ in range(5):
        update(env, WELL)
    assert present() == pytest.approx((limit, 1.5)), "level 1 is the configured task"
    numbers = update(env, BADLY)
    assert env.levels == Levels(goals=0.75)
    assert numbers["success_per_goal"] == pytest.approx(0.1)
    assert numbers["drop_per_goal"] == pytest.approx(0.3)


def test_levels_rise_one_after_the_other_and_fall_in_reverse():
    half = dataclasses.replace(LEVEL, rate=0.5)
    curriculum = CurriculumCfg(goals=half, stillness=half, physics=half, air=half)
    task = ReorientCfg(curriculum=curriculum, table=TableCfg(away_share=0.5))
    moving = moving_levels(task)
    levels = Levels(**dict.fromkeys(moving, 0.0))
    seen = [dataclasses.astuple(levels)]
    for rate in [WELL] * 9 + [SO_SO] + [BADLY] * 9:
        levels = next_levels(levels, rate, moving)
        seen.append(dataclasses.astuple(levels))
    up = [tuple(float(np.clip(t / 2 - i, 0, 1)) for i in range(len(LEVELS))) for t in range(9)]
    down = up[-2::-1]
    assert seen == [*up, up[-1], up[-1], *down, up[0]]


def test_a_level_that_changes_nothing_in_the_task_is_passed_over():
    curriculum = CurriculumCfg(goals=LEVEL, stillness=LEVEL, physics=LEVEL, air=LEVEL)
    plain = ReorientCfg(curriculum=curriculum, randomisation=NOTHING)
    assert list(moving_levels(plain)) == ["goals", "stillness"]
    moving = moving_levels(dataclasses.replace(plain, table=TableCfg(lift_share=0.1)))
    assert list(moving) == ["goals", "stillness", "air"]
    done = dataclasses.replace(Levels(), air=0.0)
    assert next_levels(done, WELL, moving) == dataclasses.replace(done, air=0.25)


def test_thresholds_shrink_by_the_same_factor_from_loose_to_those_of_success():
    success = SuccessCfg(object_spin_rad_s=0.0, rotation_rad=0.1)
    curriculum = CurriculumCfg(stillness=LEVEL)
    env = make(curriculum, success=success)
    loosest = curriculum.loose
    loose = [loosest.joint_speed_rad_s, loosest.object_speed_m_s, 0.0, loosest.action_norm, 0.4]
    tight = [success.joint_speed_rad_s, success.object_speed_m_s, 0.0, success.action_norm, 0.1]
    seen = [thresholds(env)]
    for level in (0.25, 0.5, 0.75, 1.0):
        update(env, WELL)
        assert env.levels.stillness == level
        seen.append(thresholds(env))
    assert seen[0] == pytest.approx(loose) and seen[-1] == pytest.approx(tight)
    assert seen[2] == pytest.approx(np.sqrt(np.multiply(loose, tight)), rel=1e-5)
    update(env, BADLY)
    assert thresholds(env) == pytest.approx(seen[3])


def test_what_is_drawn_grows_with_the_level_of_physics():
    random = RandomisationCfg(
        stiffness_scale=(2.0, 2.0),
        friction=(0.4, 0.4),
        table_friction=(0.1, 0.1),
        observation_latency_s=(0.1, 0.1),
        effects={
            "coulomb_friction.tau_c_nm": (0.2, 0.2),
            "torque_limit.tau_max_nm": (1.0, 1.0),
        },
    )
    env = make(CurriculumCfg(physics=LEVEL), randomisation=random)

    def drawn(level: float) -> list[float]:
        env.set_levels(Levels(physics=level))
        env.reset()
        rows = env.sim.servo.parameters.numpy()
        effects = [rows[0, PARAMETERS[name].column] for name in random.effects]
        return [
            env.randomiser.kp.numpy()[0, 0] / env.hand.kp[0],
            env.randomiser.hand_friction.numpy()[0],
            env.randomiser.table_friction.numpy()[0],
            env.observer.seen.latency.numpy()[0],
            *effects,
            env.parameters.action.numpy()["noise_std"][0],
            env.parameters.force.numpy()["force_per_mass"][0],
        ]

    nothing, half, full = drawn(0.0), drawn(0.5), drawn(1.0)
    materials = PAPER.materials
    plain = [1.0, materials.friction, materials.table_friction, 0.0, 0.0, 1.0, 0.0, 0.0]
    assert nothing == pytest.approx(plain), "a torque limit has no way from off at zero"
    noise, force = random.action_noise_std, full[-1]
    assert full == pytest.approx([2.0, 0.4, 0.1, 0.1, 0.2, 1.0, noise, force]) and force > 0.0
    assert half == pytest.approx(np.mean([nothing, full], axis=0), rel=1e-5)


def test_a_tracker_is_exact_and_at_once_before_the_level_of_physics_rises():
    random = dataclasses.replace(CONDITIONS["tracked"], table_friction=(0.5, 0.5))
    env = make(CurriculumCfg(physics=LEVEL), randomisation=random)
    column = teacher_observation_slices(3, 9)["object_position"]

    def largest_error() -> float:
        """Of the position that is told in the steps of a fall [m]."""
        env.reset()
        errors = []
        for _ in range(4):
            env.launch_step()
            true = env.sim.joint_q.numpy()[:, env.num_actions :][:, :3]
            errors.append(np.abs(env.observation.numpy()[:, column] - true).max())
        return max(errors)

    step_m = 1.5 / env.cfg.sim.physics_hz  # what falls from the start is slower than 1.5 m/s
    assert largest_error() < step_m
    env.set_levels(Levels())
    assert largest_error() > 2.0 * step_m


def test_tables_leave_and_lifted_objects_get_their_weight_with_the_level_of_air():
    table = TableCfg(lift_share=0.5, away_share=1.0, away_s=(0.01, 0.01))
    env = make(CurriculumCfg(air=LEVEL, object_weight=0.01), table=table, num_envs=4)
    assert (
        not env.parameters.must_lift.numpy().any() and env.parameters.table_steps.numpy().min() > 9
    )

    def fallen() -> np.ndarray:
        """How far each object falls in a control step, from where nothing is in its way [m]."""
        env.reset()
        q = env.sim.joint_q.numpy()
        q[:, env.num_actions + 2] = 0.6
        env.sim.joint_q.assign(q)
        env.launch_step()
        return 0.6 - env.object_pose_end.numpy()[:, 2]

    env.set_levels(Levels(air=0.5))
    lifted = env.parameters.must_lift.numpy() == 1
    assert lifted.sum() == 1 and (env.parameters.table_steps.numpy() == 1).sum() == 2
    step = env.cfg.sim.control_dt
    plain, light = fallen()[~lifted], fallen()[lifted]
    assert plain == pytest.approx(0.5 * 9.81 * step**2, rel=0.2)
    assert light == pytest.approx(0.1 * plain[0], rel=0.05), "geometric: a tenth at half"
    env.set_levels(Levels())
    assert env.parameters.must_lift.numpy().sum() == 2
    assert fallen() == pytest.approx(plain[0], rel=1e-3), "in the end they weigh the same"


def test_masses_come_with_the_level_of_physics_and_are_the_drawn_ones_at_its_end():
    random = RandomisationCfg(
        object_mass_kg=(0.4, 0.4),
        link_mass_scale=(4.0, 4.0),
        object_scale=(1.0, 1.0),
        object_scale_count=1,
    )
    task = {"randomisation": random}
    whole = make(CurriculumCfg(), **task)
    env = make(CurriculumCfg(physics=LEVEL), **task)
    plain = make(CurriculumCfg())

    def masses(of: ReorientEnv) -> np.ndarray:
        solver = of.sim.solver.mjw_model
        inertia = solver.body_inertia.numpy()[:, 1:].ravel()
        return np.concatenate([solver.body_mass.numpy()[:, 1:].ravel(), inertia])

    light, heavy = masses(plain), masses(whole)
    object_kg = float(plain.randomiser.object_mass.numpy()[0])
    np.testing.assert_allclose(masses(env), light, rtol=1e-6)
    env.set_levels(Levels(physics=0.5))
    np.testing.assert_allclose(masses(env), np.sqrt(light * heavy), rtol=1e-5)
    np.testing.assert_allclose(env.randomiser.object_mass.numpy(), np.sqrt(0.4 * object_kg))
    other = make(CurriculumCfg(physics=LEVEL), **task)
    other.load_state_dict(env.state_dict())
    np.testing.assert_array_equal(masses(other), masses(env))
    env.set_levels(Levels())
    np.testing.assert_array_equal(masses(env), heavy)
    np.testing.assert_array_equal(env.randomiser.object_mass.numpy(), np.float32(0.4))


def test_a_saved_environment_goes_on_at_its_levels():
    cfg = CurriculumCfg(stillness=LEVEL)
    env = make(cfg)
    update(env, WELL)
    state = env.state_dict()
    other = make(cfg)
    other.load_state_dict(state)
    assert other.levels == Levels(stillness=0.25) and thresholds(other) == thresholds(env)

    plain = make(CurriculumCfg())
    plain.load_state_dict(state)
    assert plain.levels == Levels(), "a run that moves no level asks for the whole task"
