"""Chains of recordings, and what their rollouts make of conditions, subsets and the hand's bodies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.assets_usd.hands import load_hand
from vd.gap.chain import GRAVITY_M_S2, chains
from vd.gap.rollout import Rollouts
from vd.kernels.servo import actuators as servo
from vd.logs.recording import Recording, Trajectory


def trajectory(
    name, command, *, conditions=None, time=None, position=None, joints=None, enabled=None
):
    """A trajectory of command [T, J]; the position only matters at the start."""
    command = np.asarray(command, float)
    time = np.arange(len(command)) * 0.02 if time is None else time
    position = np.zeros_like(command) if position is None else position
    enabled = np.ones(command.shape, bool) if enabled is None else enabled
    return Trajectory(
        f"{name}.csv", name, joints, conditions or {}, time, command, position, enabled
    )


def recording(model, joints, *trajectories):
    """A recording in memory."""
    filled = tuple(t if t.joints else replace(t, joints=tuple(joints)) for t in trajectories)
    return Recording(Path("memory"), model, tuple(joints), {}, 1.5e-3, filled)


def wave(seconds=2.0, joints=1, phase=0.0):
    """Commands [T, J] every 20 ms."""
    t = np.arange(0, seconds, 0.02)[:, None]
    return 0.4 * np.sin(2 * np.pi * (0.5 + 0.3 * np.arange(joints)) * t + phase)


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


def test_a_pendulum_hangs_from_its_load():
    load = {"payload_kg": 0.49, "arm_length_m": 0.1}
    (chain,) = chains(recording("pendulum", ("p",), trajectory("a", wave(), conditions=load)))
    assert chain.start_row[0, servo.GRAVITY_TORQUE] == pytest.approx(0.49 * 9.81 * 0.1)
    assert chain.start_row[0, servo.INERTIA] > 0.49 * 0.1**2
    assert "tau_g_nm" in chain.baseline_free


def test_each_trajectory_has_its_own_load(device):
    heavy, light = ({"payload_kg": m, "arm_length_m": 0.1} for m in (0.5, 0.2))
    data = recording(
        "pendulum",
        ("p",),
        trajectory("a", wave(), conditions=light),
        trajectory("b", wave(), conditions=heavy),
    )
    (chain,) = chains(data)
    got = Rollouts(chain, data, device=device).predict(chain.start_row[None], [0])
    row = chain.start_row.copy()
    row[0, servo.GRAVITY_TORQUE] = 0.2 * GRAVITY_M_S2 * 0.1
    row[0, servo.INERTIA] -= 0.3 * 0.1**2
    plain = replace(chain, reference_load=None)
    expected = Rollouts(plain, data, device=device).predict(row[None], [0])
    np.testing.assert_allclose(got, expected, atol=1e-6)
    assert np.abs(got - Rollouts(plain, data).predict(chain.start_row[None], [0])).max() > 1e-2


def test_trajectories_come_in_the_order_asked_for():
    data = recording(
        "servo", ("j", "k"), *(trajectory(f"t{i}", wave(1.0 + i, 2, phase=i)) for i in range(3))
    )
    chain = chains(data)[1]
    rollouts = Rollouts(chain, data)
    assert rollouts.measured.shape == (300, 1)
    rows = np.repeat(chain.start_row[None], 2, axis=0)
    rows[1, 0, servo.KP] *= 0.5
    everything = rollouts.predict(rows)
    parts = [everything[:, rollouts.sample_trajectory == t] for t in (2, 0)]
    np.testing.assert_array_equal(rollouts.predict(rows, [2, 0]), np.concatenate(parts, axis=1))
    keep = np.array([[True, False], [True, True]])
    some = rollouts.predict(rows, [2, 0], joint=0, keep=keep)
    simulated = np.repeat(keep, [part.shape[1] for part in parts], axis=1)
    np.testing.assert_array_equal(
        some, np.where(simulated, np.concatenate(parts, axis=1)[..., 0], 0.0)
    )
    assert rollouts.predict(rows[:0]).shape == (0, 300, 1)


@pytest.mark.parametrize(
    ("sent_s", "delay_s", "same_as"), [(0.007, 0.0, 0.007), (-0.003, 0.003, 0.0)]
)
def test_commands_act_from_when_they_were_sent(hand, device, sent_s, delay_s, same_as):
    """Sent after the rows' stamps they act as delayed ones.

    Sent before them and late, as at the stamps.
    """
    plain = recording("dclaw3", hand.joint_names[:3], trajectory("a", 0.2 * wave(joints=3)))
    (motion,) = plain.trajectories
    sent = replace(plain, trajectories=(replace(motion, command_time=motion.time + sent_s),))
    (chain,) = chains(plain, hand)

    def positions(data, delay):
        row = chain.start_row.copy()
        row[:, servo.COMMAND_DELAY] = delay
        return Rollouts(chain, data, device=device).predict(row[None])[0]

    np.testing.assert_allclose(positions(sent, delay_s), positions(plain, same_as), atol=1e-5)
    assert np.abs(positions(sent, delay_s) - positions(plain, delay_s)).max() > 1e-3


def test_play_begins_where_the_joint_rests():
    """Between the ends of its play a joint stays where it is.

    From beyond them its drive takes it to one.
    """
    start = np.array([0.18, 0.21, 0.3])
    motions = [
        trajectory(str(i), np.full((200, 1), 0.2), position=np.full((200, 1), at))
        for i, at in enumerate(start)
    ]
    data = recording("servo", ("j",), *motions)
    (chain,) = chains(data)
    row = chain.start_row.copy()
    row[0, servo.BACKLASH_WIDTH] = 0.06
    got = Rollouts(chain, data).predict(row[None])[0, :, 0].reshape(3, 200)
    np.testing.assert_allclose(got[:2], np.repeat(start[:2, None], 200, axis=1), atol=1e-6)
    assert got[2, -1] == pytest.approx(0.23, abs=1e-4)
    # A load moves the ends: the same holds for where the drive carries it.
    row[0, servo.GRAVITY_TORQUE], row[0, servo.GRAVITY_PHASE] = 0.04 * row[0, servo.KP], 0.5 * np.pi
    got = Rollouts(chain, data).predict(row[None])[0, :, 0].reshape(3, 200)
    droop = 0.04 * np.cos(got[:, -1])
    np.testing.assert_allclose(got[0], start[0], atol=1e-6)
    np.testing.assert_allclose(got[1:, -1] + droop[1:], 0.23, atol=1e-4)


def test_a_finger_droops_as_its_weight_asks(hand):
    """In rest the springs carry the weight.

    The gradient of the potential energy by the hand's kinematics.
    """
    names = ("f1_j3", "f1_j1", "f1_j2")  # columns in another order than the finger's
    target = np.array([-0.7, 0.3, 0.5])
    data = recording(
        "dclaw3",
        names,
        trajectory("a", np.tile(target, (200, 1)), position=np.tile(target, (200, 1))),
    )
    (chain,) = chains(data, hand)
    assert chain.joints == ("f1_j1", "f1_j2", "f1_j3") and list(chain.columns) == [1, 2, 0]
    rest = Rollouts(chain, data).predict(chain.start_row[None])[0, -1]
    down = Rotation.from_quat(hand.mount[3:]).inv().apply([0.0, 0.0, -1.0])

    def potential(q):
        full = np.zeros(hand.num_joints)
        full[3:6] = q
        poses = hand.forward_kinematics(full)[4:7]
        centres = poses[:, :3] + Rotation.from_quat(poses[:, 3:]).apply(hand.link_com[4:7])
        return -9.81 * hand.link_mass[4:7] @ (centres @ down)

    step = 1e-5 * np.eye(3)
    weight = np.array([(potential(rest + d) - potential(rest - d)) / 2e-5 for d in step])
    spring = hand.kp[3:6] * (target[list(chain.columns)] - rest)
    np.testing.assert_allclose(spring, weight, atol=2e-4)
    assert np.abs(weight).max() > 0.01


def test_unrecorded_joints_stand_still(hand):
    names = tuple(hand.joint_names[:3])
    command = np.zeros((200, 3))
    command[:, 1] = wave(4.0)[:, 0]
    whole = recording("dclaw3", names, trajectory("a", command))
    part = recording("dclaw3", names[1:2], trajectory("a", command[:, 1:2]))
    (chain,), (alone,) = chains(whole, hand), chains(part, hand)
    rows = chain.start_row.copy()
    rows[[0, 2], servo.KP] = 1e4
    expected = Rollouts(chain, whole, dt=1 / 1920).predict(rows[None])[0, :, 1]
    got = Rollouts(alone, part, dt=1 / 1920).predict(alone.start_row[None])[0, :, 0]
    np.testing.assert_allclose(got, expected, atol=1e-3)
    assert alone.inertia_scale(0) == pytest.approx(chain.inertia_scale(1))


def test_bad_input_says_what_to_do(hand):
    data = recording("dclaw3", ("f0_j1",), trajectory("a", wave()))
    with pytest.raises(ValueError, match="needs its hand"):
        chains(data)
    with pytest.raises(ValueError, match="f9_j1"):
        chains(recording("dclaw3", ("f9_j1",), trajectory("a", wave())), hand)
    (chain,) = chains(data, hand)
    with pytest.raises(ValueError, match="time step"):
        Rollouts(chain, data, dt=0.0)
    with pytest.raises(ValueError, match="shape"):
        Rollouts(chain, data).predict(chain.start_row)


@pytest.mark.parametrize(("rate", "samples"), [(480.0, 411), (2400.0, 1171)])
def test_every_sample_is_predicted_wherever_its_stamp_falls_within_a_step(rate, samples):
    """4.1 s and 11.7 s are whole numbers of steps only up to rounding."""
    time = np.arange(samples) / 100.0
    command = 0.1 * np.ones((len(time), 1))
    found = recording("servo", ("a",), trajectory("a", command, time=time, position=command))
    (chain,) = chains(found)
    for garbage in (np.nan, 1e9, -5.0):
        left = [np.full(len(time), garbage, np.float32) for _ in range(50)]
        del left  # memory that the predictions are likely to get
        predicted = Rollouts(chain, found, dt=1.0 / rate).predict(chain.start_row[None])
        np.testing.assert_allclose(predicted, 0.1, atol=1e-5)
