"""Rollouts of chains: commands, delays, limits, friction and stops, by closed forms."""

import numpy as np
import pytest
from chain_rolls import (
    DT,
    excitation,
    one_joint,
    random_bodies,
    roll,
    rows_of,
)
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES

from vd.kernels.servo import actuators as servo
from vd.kernels.servo.chains import DIVERGED
from vd.kernels.servo.effects import EFFECTS, neutral_row

# --- Time ---


@EXAMPLES
@given(
    delay=st.floats(0.0, 0.2),
    read=st.floats(0.0, 0.2),
    seed=st.integers(0, 1000),
)
def test_delays_shift_in_time_by_any_fraction_of_a_step(device, delay, read, seed):
    rng = np.random.default_rng(seed)
    time = np.arange(0, 1.0, DT)
    command = np.where(time < 0.1, 0.0, rng.uniform(0.2, 1.0))
    rows = rows_of({servo.COMMAND_DELAY: delay, servo.READ_DELAY: read}, {})
    got, plain = one_joint(device, rows, time, command)
    expected = np.interp(time - delay - read, time, plain)
    assert np.abs(got - expected).max() < 2e-3


def test_commands_act_at_irregular_stamps(device):
    # A stiff massless-looking servo follows its command; the answer to a step is that of an exponential.
    kp, kd = 3.0, 0.3
    stamps = np.array([0.0, 0.1003, 0.1004, 0.25037, 0.6])
    command = np.array([0.0, 1.0, 0.5, -0.2, -0.2])
    rows = rows_of({servo.KP: kp, servo.KD: kd, servo.INERTIA: 1e-6, servo.VELOCITY_LIMIT: 1e6})
    got = one_joint(device, rows, stamps, command)[0]
    q, expected = 0.0, [0.0]
    for i in range(len(stamps) - 1):
        q = command[i] + (q - command[i]) * np.exp(-(stamps[i + 1] - stamps[i]) * kp / kd)
        expected.append(q)
    np.testing.assert_allclose(got, expected, atol=1e-3)


def test_jitter_delays_by_half_a_normal_on_average_and_is_smooth_in_its_size(device):
    time = np.arange(0, 20.0, 0.25)
    command = np.where(np.arange(len(time)) % 2 == 0, 0.0, 1.0)
    sigma = 0.03
    rows = rows_of({}, {servo.JITTER_SIGMA: sigma}, {servo.JITTER_SIGMA: 1.001 * sigma})
    many = roll(device, rows, time, np.tile(command[None, :, None], (50, 1, 1)), np.zeros((50, 1)))[..., 0]
    plain, jittered, nudged = many
    # Mean position at the next stamp, linearised: the delay of each command moves the answer back.
    shifted = one_joint(device, rows_of({servo.COMMAND_DELAY: sigma * np.sqrt(2 / np.pi)}), time, command)[0]
    np.testing.assert_allclose(jittered.mean(axis=0)[10:], shifted[10:], atol=0.015)
    assert np.abs(jittered - plain).max() > 0.03
    assert not np.allclose(jittered[0], jittered[1], atol=1e-3), "trajectories share their draws"
    assert np.abs(nudged - jittered).max() < 1e-3


def test_dropped_commands_leave_the_one_before_in_force(device):
    time = np.arange(0, 60.0, 1.0)
    command = np.arange(60) % 2 * 0.5
    p = 0.3
    got = one_joint(device, rows_of({servo.JITTER_DROP: p}), time, command, start=0.0)[0]
    # One second settles: the position before each stamp is the command in force, 0 or 0.5.
    np.testing.assert_allclose(got[1:], 0.5 * np.round(got[1:] / 0.5), atol=2e-3)
    wrong = np.mean(np.abs(got[1:] - command[:-1]) > 0.25)
    # The last write that was kept has the wrong parity with probability p / (1 + p).
    assert wrong == pytest.approx(p / (1 + p), abs=0.17)
    assert one_joint(device, rows_of({servo.JITTER_DROP: 1.0}), time, command).max() < 1e-6


# --- Bounds ---


def test_a_coupled_joint_follows_its_neighbour(device):
    time = np.arange(0, 2.0, 0.01)
    command = np.zeros((1, len(time), 2))
    command[0, :, 0] = 0.5
    rows = rows_of({}, n=2)
    rows[0, 1, servo.COUPLING_0] = 0.3
    got = roll(device, rows, time, command, np.zeros((1, 2)))[0, 0]
    np.testing.assert_allclose(got[-1], [0.5, 0.15], atol=1e-3)


@EXAMPLES
@given(seed=st.integers(0, 2**31), n=st.integers(1, 3))
def test_any_parameters_within_their_bounds_give_numbers(device, seed, n):
    rng = np.random.default_rng(seed)
    rows = np.tile(neutral_row(), (6, n, 1))
    for effect in EFFECTS.values():
        for p in effect.parameters:
            rows[:, :, p.column] = rng.choice([p.lower, p.upper, p.neutral, p.typical], (6, n))
    rows[:, :, servo.KP] = rng.choice([1e-3, 1e3], (6, n))
    rows[:, :, servo.KD] = rng.choice([1e-5, 1e2], (6, n))
    rows[:, :, servo.INERTIA] = rng.choice([0.0, 1e-6, 10.0], (6, n))
    rows[:, :, servo.VELOCITY_LIMIT] = rng.choice([0.05, 1e6], (6, n))
    time, command = excitation(rng, 0.5)
    commands = np.repeat(command[None, :, None], n, axis=2)
    bodies = random_bodies(rng, n) if rng.random() < 0.5 else None
    got = roll(device, rows, time, commands, np.zeros((1, n)), bodies=bodies)
    assert np.abs(got).max() < 2 * DIVERGED


def test_trajectories_and_sets_do_not_mix(device):
    rng = np.random.default_rng(4)
    time, _ = excitation(rng)
    commands = rng.uniform(-0.5, 0.5, (3, len(time), 2))
    rows = rows_of({}, {servo.KP: 1.0}, n=2)
    start = rng.uniform(-0.2, 0.2, (3, 2))
    together = roll(device, rows, time, commands, start)
    for c in range(2):
        for r in range(3):
            alone = roll(device, rows[c : c + 1], time, commands[r : r + 1], start[r : r + 1])[0, 0]
            np.testing.assert_array_equal(together[c, r], alone)
