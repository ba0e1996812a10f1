"""How hard the task is while it is learned: when a stage is left, and what each asks for."""

import dataclasses

import numpy as np
import pytest

from vd.envs.cfg import (
    CurriculumCfg,
    GoalCfg,
    RandomisationCfg,
    ReorientCfg,
    SuccessCfg,
    TableCfg,
    TighteningCfg,
)
from vd.envs.curriculum import Stage, first_stage, next_stage
from vd.envs.parameters import GOAL_START_RAD, STILLNESS_START
from vd.envs.reorient import ReorientEnv

TIGHTENING = TighteningCfg(enabled=True, rate=0.25, raise_at=0.5, lower_at=0.3)
WELL, SO_SO, BADLY = 0.9, 0.4, 0.1


def make(curriculum: CurriculumCfg, **changes) -> ReorientEnv:
    cfg = ReorientCfg(
        hand="dclaw3",
        objects=("cube",),
        num_envs=2,
        randomisation=RandomisationCfg(enabled=False),
        curriculum=curriculum,
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
    curriculum = CurriculumCfg(enabled=True, rate=0.25)
    env = make(curriculum, goal=GoalCfg(max_angle_rad=1.5))

    def present() -> tuple[float, float]:
        return thresholds(env)[0], float(env.parameters.goal.numpy()["max_angle"][0])

    limit = SuccessCfg().joint_speed_rad_s
    assert present() == pytest.approx((STILLNESS_START * limit, GOAL_START_RAD))
    assert update(env, WELL)["difficulty"] == 0.25
    assert present()[0] < STILLNESS_START * limit and present()[1] > GOAL_START_RAD
    for _ in range(5):
        update(env, WELL)
    assert present() == pytest.approx((limit, 1.5)), "difficulty 1 is the configured task"
    numbers = update(env, BADLY)
    assert numbers["difficulty"] == 0.75 and numbers["tightness"] == 1.0
    assert numbers["success_per_goal"] == pytest.approx(0.1)
    assert numbers["drop_per_goal"] == pytest.approx(0.3)


def test_stillness_tightens_after_the_goals_and_loosens_before_them():
    cfg = CurriculumCfg(enabled=True, rate=0.5, raise_at=0.5, lower_at=0.3, tightening=TIGHTENING)
    stage = first_stage(cfg)
    seen = [stage]
    for rate in [WELL] * 6 + [SO_SO, WELL] + [BADLY] * 5:
        stage = next_stage(stage, rate, cfg)
        seen.append(stage)
    assert [s.difficulty for s in seen] == [0, 0.5] + 11 * [1.0] + [0.5]
    assert [s.tightness for s in seen] == [0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1, 0.75, 0.5, 0.25, 0, 0]


def test_thresholds_shrink_by_the_same_factor_from_loose_to_those_of_success():
    success = SuccessCfg(object_spin_rad_s=0.0, rotation_rad=0.1)
    env = make(CurriculumCfg(tightening=TIGHTENING), success=success)
    loose = [
        TIGHTENING.joint_speed_rad_s,
        TIGHTENING.object_speed_m_s,
        0.0,
        TIGHTENING.action_norm,
        0.4,
    ]
    tight = [success.joint_speed_rad_s, success.object_speed_m_s, 0.0, success.action_norm, 0.1]
    seen = [thresholds(env)]
    for tightness in (0.25, 0.5, 0.75, 1.0):
        assert update(env, WELL)["tightness"] == tightness
        seen.append(thresholds(env))
    assert seen[0] == pytest.approx(loose) and seen[-1] == pytest.approx(tight)
    assert seen[2] == pytest.approx(np.sqrt(np.multiply(loose, tight)), rel=1e-5)
    assert update(env, SO_SO)["tightness"] == 1.0
    assert update(env, BADLY)["tightness"] == 0.75
    assert thresholds(env) == pytest.approx(seen[3])


def test_what_has_to_be_lifted_gets_its_weight_as_stillness_tightens():
    tightening = dataclasses.replace(TIGHTENING, object_weight=0.01)
    table = TableCfg(lift_share=0.5, away_share=1.0, away_s=(0.01, 0.01))
    env = make(CurriculumCfg(tightening=tightening), table=table, num_envs=4)
    lifted = env.must_lift.numpy() == 1
    assert sorted(lifted) == [False, False, True, True]

    def fallen() -> np.ndarray:
        """How far each object falls in a control step, from where nothing is in its way [m]."""
        env.reset()
        q = env.sim.joint_q.numpy()
        q[:, env.num_actions + 2] = 0.6
        env.sim.joint_q.assign(q)
        env.launch_step()
        return 0.6 - env.object_pose_end.numpy()[:, 2]

    step = env.cfg.sim.control_dt
    plain, light = fallen()[~lifted], fallen()[lifted]
    assert plain == pytest.approx(0.5 * 9.81 * step**2, rel=0.2)
    assert light == pytest.approx(0.01 * plain, rel=0.05)
    env.set_stage(Stage())
    assert fallen() == pytest.approx(plain[0], rel=1e-3), (
        "at the end of the curriculum they weigh the same"
    )


def test_a_saved_environment_goes_on_with_its_tightness():
    cfg = CurriculumCfg(tightening=TIGHTENING)
    env = make(cfg)
    update(env, WELL)
    state = env.state_dict()
    other = make(cfg)
    other.load_state_dict(state)
    assert other.stage == Stage(1.0, 0.25) and thresholds(other) == thresholds(env)

    plain = make(CurriculumCfg())
    plain.load_state_dict(state)
    assert plain.stage == Stage(), "a run that does not tighten asks for what success says"
    begun = make(cfg)
    begun.load_state_dict(plain.state_dict())
    assert begun.stage == Stage(1.0, 0.0), "a run that did not tighten had learned none of it"
