"""Small chains and their rollouts, for the tests of :mod:`vd.kernels.servo.chains`."""

import numpy as np
from kernel_oracle import launch

from vd.gap.rollout import links_of
from vd.kernels.servo import actuators as servo
from vd.kernels.servo.chain_bodies import Links
from vd.kernels.servo.chains import rollout_kernel
from vd.kernels.servo.effects import neutral_row

DT = 1 / 480
FINE = 10
"""The oracle's steps in one of the kernel's."""
PLAIN = {servo.KP: 3.0, servo.KD: 0.3, servo.VELOCITY_LIMIT: 50.0, servo.INERTIA: 2e-3}
GRAVITY = np.array([1.0, -2.0, 9.0])


def random_bodies(rng, n):
    """Axes, offsets, masses, centres of mass, inertias of a finger-sized chain."""
    axis = rng.normal(size=(n, 3))
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    moments = rng.uniform(5e-6, 1e-5, (n, 3)) + 5e-6
    return {
        "axis": axis / np.linalg.norm(axis, axis=1, keepdims=True),
        "offset": rng.uniform(-0.07, 0.07, (n, 3)),
        "mass": rng.uniform(0.02, 0.1, n),
        "com": rng.uniform(-0.05, 0.05, (n, 3)),
        "inertia": np.einsum("nij,nj,nkj->nik", turn, moments, turn),
    }


def rows_of(*settings, n=1):
    """Parameter rows [C, n, P] of the plain servo with settings by column."""
    rows = np.tile(neutral_row(), (len(settings), n, 1))
    for row, values in zip(rows, settings, strict=True):
        for column, value in {**PLAIN, **values}.items():
            row[:, column] = value
    return rows


def roll(device, rows, time, command, start, *, bodies=None, dt=DT, power=None, stops=1e6, effort=1e6):
    """Roll trajectories out; time [T], command [R, T, n], start [R, n]. Returns [C, R, T, n]."""
    runs, count, n = command.shape
    sets = len(rows)
    steps = np.tile(time / dt, runs)
    power = np.ones_like(command) if power is None else power
    step, fraction = np.floor(steps), steps - np.floor(steps)
    samples = {"step": step, "fraction": fraction, "sent_step": step, "sent_fraction": fraction}
    samples |= {"command": command.reshape(-1, n), "power": power.reshape(-1, n)}
    rolls = sets * runs
    run = np.tile(np.arange(runs), sets)
    inputs = [samples, run * count, np.full(rolls, count), np.arange(rolls) * count, run]
    inputs += [np.tile(start, (sets, 1))]
    inputs += [np.full(rolls, -1), np.arange(n), np.full(n, -stops), np.full(n, stops), np.full(n, effort)]
    inputs += [int(bodies is not None), Links() if bodies is None else links_of(**bodies, gravity=GRAVITY)]
    inputs += [np.repeat(rows[:, None], runs, axis=1).reshape(-1, servo.PARAMETER_COLUMNS), dt]
    shapes = [(rolls, n, servo.STATE_COLUMNS), (rolls * count, n)]
    _, predicted = launch(rollout_kernel, rolls, inputs, device, *shapes)
    result = predicted.astype(float)
    assert np.isfinite(result).all(), "a sample was not written, or is no number"
    return result.reshape(sets, runs, count, n)


def one_joint(device, rows, time, command, start=0.0, **options):
    """One joint, one trajectory: [C, T]."""
    return roll(device, rows, time, command[None, :, None], np.full((1, 1), start), **options)[:, 0, :, 0]


def excitation(rng, seconds=2.0):
    """Irregular stamps, and steps and a sine as command."""
    time = np.concatenate([[0.0], np.cumsum(rng.uniform(0.004, 0.03, int(seconds / 0.017)))])
    steps = rng.uniform(-0.5, 0.5, 8)[np.minimum((time / (seconds / 8)).astype(int), 7)]
    return time, np.where(time < 0.75 * seconds, steps, 0.4 * np.sin(2 * np.pi * 2.0 * time))
