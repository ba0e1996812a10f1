"""Identified servos in the environment.

Effects act, are drawn per world, and end with an episode.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from test_envs_reorient import run

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.hand_layer import write_layer
from vd.assets_usd.hand_model import read_hand
from vd.assets_usd.hands import hand_usd
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.envs.servo import needs_servo, servo_ranges
from vd.kernels.servo import actuators
from vd.kernels.task.observations import teacher_observation_slices
from vd.sim.cfg import SimCfg

WORLDS = 4
STILL = RandomisationCfg(enabled=False)
# Gains and servos only: nothing else is drawn, so that what is seen comes from them.
SERVOS = RandomisationCfg(
    action_noise_std=0.0,
    observation_noise_mean=0.0,
    observation_noise_std=0.0,
    force_probability=0.0,
)
JOINTS = [f"f{finger}_j{joint}" for finger in range(3) for joint in (1, 2, 3)]


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return read_hand(hand_usd("dclaw3"))


@pytest.fixture
def layer(hand, tmp_path):
    """Write a layer: the baseline by joint, the same effects in every joint; returns its path."""

    def write(baseline=None, **effects) -> str:
        path = tmp_path / f"identified_{len(list(tmp_path.iterdir()))}.usda"
        everywhere = dict.fromkeys(JOINTS, effects)
        write_layer(
            path, hand, baseline=baseline or {}, effects=everywhere, tool="test", recording="none"
        )
        return str(path)

    return write


def make(hand_layer: str | None = None, **changes) -> ReorientEnv:
    cfg = ReorientCfg(hand="dclaw3", hand_layer=hand_layer, num_envs=WORLDS, randomisation=STILL)
    return ReorientEnv(dataclasses.replace(cfg, **changes), "cpu")


def rows(env: ReorientEnv) -> np.ndarray:
    """Servo parameters of every world and joint, [N, D, P]."""
    assert env.sim.servo is not None
    return env.sim.servo.parameters.numpy().reshape(env.num_envs, env.num_actions, -1).copy()


def joints(env: ReorientEnv) -> np.ndarray:
    return env.sim.joint_q.numpy()[:, : env.num_actions].copy()


def test_identified_gains_reach_the_solver_without_a_servo(layer):
    env = make(layer({"f1_j2": {"kp": 1.25, "kd": 0.1}}))
    assert env.sim.servo is None
    model = env.sim.solver.mjw_model
    joint = JOINTS.index("f1_j2")
    assert model.actuator_gainprm.numpy()[:, joint, 0] == pytest.approx(1.25)
    assert model.actuator_biasprm.numpy()[:, joint, 1:3] == pytest.approx(
        np.tile([-1.25, -0.1], (WORLDS, 1))
    )


def test_the_policy_sees_and_acts_on_what_the_encoder_reports(layer):
    step = SimCfg().control_dt
    env = make(layer(encoder_bias={"bias_rad": 0.05}, read_delay={"delay_s": step}))
    column = teacher_observation_slices(3, 9)["joint_position"]
    lower, upper = env.hand.lower, env.hand.upper
    past = [joints(env)]
    for _ in range(4):
        env.action.fill_(0.5)
        env.step(env.action)
        past.append(joints(env))
        seen = (env.observation.numpy()[:, column] + 1.0) / 2.0 * (upper - lower) + lower
        np.testing.assert_allclose(seen, past[-2] + 0.05, atol=1e-5)
    env.smoothed.zero_()
    env.action.zero_()
    env._apply_action()
    np.testing.assert_allclose(env.sim.target.numpy()[:, :9], past[-2] + 0.05, atol=1e-5)


def test_worlds_draw_from_the_identified_intervals(layer):
    path = layer(
        {"f0_j1": {"kp": (2.0, 1.95, 2.05)}, "f2_j3": {"velocity_limit": (3.0, 2.5, 3.5)}},
        backlash={"width_rad": (0.03, 0.02, 0.05)},
        coulomb_friction={"tau_c_nm": 0.04},
    )
    env = make(path, num_envs=24, randomisation=SERVOS)
    drawn = rows(env)
    width = drawn[:, :, actuators.BACKLASH_WIDTH]
    assert len(np.unique(width)) == width.size and width.min() >= 0.02 and width.max() <= 0.05
    assert np.ptp(width) > 0.02, "they fill the interval"
    assert drawn[:, :, actuators.COULOMB_TORQUE] == pytest.approx(0.04), "no interval, no draw"
    speed = drawn[:, :, actuators.VELOCITY_LIMIT]
    assert np.ptp(speed[:, -1]) > 0.3 and np.ptp(speed[:, :-1], axis=0).max() == 0.0
    kp = drawn[:, :, actuators.KP]
    assert np.array_equal(kp, env.randomiser.kp.numpy())
    assert kp[:, 0].min() >= 1.95 and kp[:, 0].max() <= 2.05, "the interval in the place of 20 %"
    ratio = kp[:, 1:] / env.hand.kp[1:]
    assert 0.8 <= ratio.min() < 0.85 and 1.15 < ratio.max() <= 1.2
    still = rows(make(path))
    assert still == pytest.approx(np.broadcast_to(env.hand.servo, still.shape), rel=1e-6)


def test_servos_are_drawn_anew_and_started_anew_with_their_world_alone(layer):
    path = layer(backlash={"width_rad": (0.03, 0.02, 0.05)}, command_delay={"delay_s": 0.1})
    env = make(path, episode_s=0.5, randomisation=SERVOS)
    gains = env.randomiser.kp.numpy().copy()
    env.step_count.assign(np.array([0, 3, 0, 0], dtype=np.int32))
    before = rows(env)
    run(env, 3)
    assert env.timed_out.numpy().tolist() == [0, 1, 0, 0]
    others = [0, 2, 3]
    after = rows(env)
    assert np.array_equal(before[others], after[others])
    assert (before[1, :, actuators.BACKLASH_WIDTH] != after[1, :, actuators.BACKLASH_WIDTH]).all()
    assert np.array_equal(env.randomiser.kp.numpy(), gains), "which the solver holds, for longer"
    clock = env.sim.servo.state.numpy().reshape(WORLDS, 9, -1)[:, :, actuators.STATE_TIME]
    assert (clock[1] == 0.0).all() and clock[others] == pytest.approx(3 * env.cfg.sim.control_dt)
    # The command that was under way when the episode ended does not arrive in the next one.
    held = joints(env)[1]
    env.action.zero_()
    env.smoothed.zero_()
    env.step(env.action)
    assert np.abs(joints(env)[1] - held).max() < 0.05
    assert np.array_equal(env.measured_q.numpy()[1], joints(env)[1])


def test_a_torque_limit_bounds_the_torque_that_costs_energy(layer):
    env = make(layer(torque_limit={"tau_max_nm": 0.02}))
    plain = make()
    largest = [0.0, 0.0]
    for _ in range(6):
        for index, world in enumerate((env, plain)):
            world.action.fill_(1.0)
            world.step(world.action)
            largest[index] = max(largest[index], float(np.abs(world.fingers.effort.numpy()).max()))
    assert largest[0] <= 0.02 * (1 + 1e-5) and largest[1] > 0.04


def test_saved_state_continues_exactly_and_other_servos_are_refused(layer):
    path = layer(command_delay={"delay_s": (0.05, 0.04, 0.06)}, command_jitter={"sigma_s": 0.01})
    env = make(path, randomisation=SERVOS, episode_s=0.5)
    run(env, 4, seed=1)
    state = env.state_dict()
    expected = run(env, 5, seed=2)
    other = make(path, randomisation=SERVOS, episode_s=0.5)
    run(other, 3, seed=9)
    other.load_state_dict(state)
    assert np.array_equal(run(other, 5, seed=2), expected)
    with pytest.raises(ValueError, match=r"resume with hand_layer"):
        make().load_state_dict(state)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        (
            {"command_delay": (0.0, 0.1)},
            "no parameter 'command_delay'; one of command_delay.delay_s",
        ),
        ({"command_delay.delay_s": (0.1, 0.0)}, "the low end comes first"),
        ({"command_delay.delay_s": (0.0, 9.0)}, "between 0 and 0.3 s"),
        (
            {"torque_speed_limit.tau_stall_nm": (0.5, 1.0)},
            "but not torque_speed_limit.omega_0_rad_s",
        ),
    ],
)
def test_wrong_effects_are_refused(effects, message):
    with pytest.raises(ValueError, match=message.replace(".", r"\.")):
        make(randomisation=RandomisationCfg(effects=effects))


def test_an_interval_of_stiffness_alone_needs_no_servo(hand, layer):
    changed = read_hand(hand_usd("dclaw3"), layer=Path(layer({"f0_j1": {"kp": (2.0, 1.9, 2.1)}})))
    assert not needs_servo(servo_ranges(changed, SERVOS)) and not needs_servo(
        servo_ranges(hand, SERVOS)
    )
    changed = read_hand(
        hand_usd("dclaw3"), layer=Path(layer({"f0_j1": {"inertia": (2e-3, 1e-3, 3e-3)}}))
    )
    assert needs_servo(servo_ranges(changed, SERVOS)) and not needs_servo(
        servo_ranges(changed, STILL)
    )
