"""Rollouts of chains against MuJoCo's C engine, a finer NumPy integration, and closed forms."""

from functools import cache
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, launch

from vd.gap.rollout import links_of
from vd.kernels.servo import actuators as servo
from vd.kernels.servo.chain_bodies import chain_dynamics, links_of_size, room_for
from vd.kernels.servo.chains import DIVERGED, rollout_kernel
from vd.kernels.servo.effects import EFFECTS, neutral_row

DT = 1 / 480
FINE = 40
"""The oracle's steps in one of the kernel's. It is of first order: with ten of them it is itself
off by 0.8 mrad where friction falls with speed, with these by 0.1."""
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


def roll(
    device, rows, time, command, start, *, bodies=None, dt=DT, power=None, stops=1e6, effort=1e6
):
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
    inputs += [
        np.full(rolls, -1),
        np.arange(n),
        np.full(n, -stops),
        np.full(n, stops),
        np.full(n, effort),
    ]
    links = (
        links_of_size(room_for(n))()
        if bodies is None
        else links_of(SimpleNamespace(**bodies, gravity=GRAVITY))
    )
    inputs += [int(bodies is not None), links]
    inputs += [np.repeat(rows[:, None], runs, axis=1).reshape(-1, servo.PARAMETER_COLUMNS), dt]
    shapes = [(rolls, n, servo.STATE_COLUMNS), (rolls * count, n)]
    _, predicted = launch(rollout_kernel(room_for(n)), rolls, inputs, device, *shapes)
    result = predicted.astype(float)
    assert np.isfinite(result).all(), "a sample was not written, or is no number"
    return result.reshape(sets, runs, count, n)


def one_joint(device, rows, time, command, start=0.0, **options):
    """One joint, one trajectory: [C, T]."""
    return roll(device, rows, time, command[None, :, None], np.full((1, 1), start), **options)[
        :, 0, :, 0
    ]


def excitation(rng, seconds=2.0):
    """Irregular stamps, and steps and a sine as command."""
    time = np.concatenate([[0.0], np.cumsum(rng.uniform(0.004, 0.03, int(seconds / 0.017)))])
    steps = rng.uniform(-0.5, 0.5, 8)[np.minimum((time / (seconds / 8)).astype(int), 7)]
    return time, np.where(time < 0.75 * seconds, steps, 0.4 * np.sin(2 * np.pi * 2.0 * time))


# --- Bodies ---


@cache
def dynamics_kernel(size):
    vector, matrix = wp.types.vector(size, float), wp.types.matrix((size, size), float)

    @wp.kernel(module="unique", enable_backward=False)
    def dynamics(
        q: wp.array[vector],
        speed: wp.array[vector],
        links: links_of_size(size),
        mass_out: wp.array[matrix],
        bias_out: wp.array[vector],
    ):
        i = wp.tid()
        mass, bias = chain_dynamics(q[i], speed[i], links)
        mass_out[i] = mass
        bias_out[i] = bias

    return dynamics


def mujoco_chain(bodies, gravity, armature=0.0, damping=0.0, friction=0.0):
    """The chain in MuJoCo, torque-driven, implicit damping."""

    def text(values):
        return " ".join(repr(float(v)) for v in np.ravel(values))

    xml = ""
    for i in range(len(bodies["mass"])):
        inertia = bodies["inertia"][i]
        full = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        xml += (
            f'<body pos="{text(bodies["offset"][i])}"><joint name="j{i}" axis="{text(bodies["axis"][i])}" '
            f'armature="{armature}" damping="{damping}" frictionloss="{friction}" '
            'solreffriction="0.0005 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"/>'
            f'<inertial pos="{text(bodies["com"][i])}" mass="{bodies["mass"][i]}" '
            f'fullinertia="{text(full)}"/>'
        )
    xml += "</body>" * len(bodies["mass"])
    option = f'<option gravity="{text(gravity)}" timestep="{DT / FINE}" integrator="implicitfast"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/>{option}<worldbody>{xml}</worldbody></mujoco>'
    )
    return model, mujoco.MjData(model)


@EXAMPLES
@given(seed=st.integers(0, 2**31), n=st.integers(1, 6))
def test_mass_matrix_and_bias_are_mujocos(device, seed, n):
    rng = np.random.default_rng(seed)
    bodies = random_bodies(rng, n)
    size = room_for(n)
    q, speed = rng.uniform(-3, 3, (5, size)), rng.uniform(-6, 6, (5, size))
    inputs = [q, speed, links_of(SimpleNamespace(**bodies, gravity=GRAVITY))]
    mass, bias = launch(dynamics_kernel(size), 5, inputs, device, 5, 5)
    model, data = mujoco_chain(bodies, GRAVITY)
    for i in range(5):
        data.qpos[:], data.qvel[:] = q[i, :n], speed[i, :n]
        mujoco.mj_forward(model, data)
        full = np.zeros((n, n))
        mujoco.mj_fullM(model, full, data.qM) if hasattr(data, "qM") else mujoco.mj_fullM(
            model, data, full
        )
        scale = np.abs(full).max()
        np.testing.assert_allclose(mass[i, :n, :n], full, atol=1e-5 * scale)
        np.testing.assert_allclose(bias[i, :n], data.qfrc_bias, atol=2e-6)
        assert not mass[i, n:].any() and not bias[i, n:].any()


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.parametrize("friction", [0.0, 0.08])
def test_finger_follows_mujoco(device, n, friction):
    rng = np.random.default_rng(n)
    bodies = random_bodies(rng, n)
    time, _ = excitation(rng)
    command = np.stack(
        [excitation(np.random.default_rng(10 + i))[1][: len(time)] for i in range(n)], axis=1
    )
    time = time[: len(command)]
    rows = rows_of({servo.INERTIA: 1e-3, servo.COULOMB_TORQUE: friction}, n=n)
    start = rng.uniform(-0.3, 0.3, n)
    got = roll(device, rows, time, command[None], start[None], bodies=bodies)[0, 0]

    model, data = mujoco_chain(bodies, GRAVITY, 1e-3, PLAIN[servo.KD], friction)
    data.qpos[:] = start
    expected = [start]
    fine = DT / FINE
    for k in range(int(np.ceil(time[-1] / fine))):
        last = np.searchsorted(time, k * fine + 1e-9, side="right") - 1
        data.qfrc_applied[:] = PLAIN[servo.KP] * (command[last] - data.qpos)
        mujoco.mj_step(model, data)
        expected.append(data.qpos.copy())
    grid = np.arange(len(expected)) * fine
    expected = np.stack([np.interp(time, grid, np.array(expected)[:, j]) for j in range(n)], axis=1)
    # MuJoCo's step is of first order: most of the difference is its own.
    assert np.abs(got - expected).max() < 1.7e-3
    assert np.sqrt(np.mean((got - expected) ** 2)) < 4e-4


# --- One joint: every effect against a finer integration that shares no code ---


def integrate(rows, time, command, start, dt, stops=np.inf):
    """Semi-implicit Euler in float64, C joints [C, P] at once; positions [C, T] at the stamps."""
    names = [
        name for name, value in vars(servo).items() if type(value) is int and "STATE" not in name
    ]
    p = {name: rows[:, getattr(servo, name)] for name in names if name != "PARAMETER_COLUMNS"}
    q = start - p["ENCODER_BIAS"]
    v, work = np.zeros_like(q), np.zeros_like(q)
    smooth, profile = (np.full_like(q, command[0]) for _ in range(2))
    profile_speed = np.zeros_like(q)
    # The play is where the joint rests, unless that is more than its width from the command.
    played = q + p["GRAVITY_TORQUE"] * np.sin(q + p["GRAVITY_PHASE"]) / p["KP"]
    other, other_speed = q.copy(), np.zeros_like(q)
    history = [q]
    mass = p["INERTIA"] + p["PAYLOAD_INERTIA"]
    on = {name: p[name] > 0 for name in p}
    for k in range(int(np.ceil(time[-1] / dt)) + 1):
        t = k * dt
        write = np.searchsorted(time, t + 0.5 * dt - p["COMMAND_DELAY"], side="right") - 1
        reference = command[np.maximum(write, 0)]
        tau = np.where(on["FILTER_TAU"], p["FILTER_TAU"], 1.0)
        smooth = smooth + dt / tau * (reference - smooth)
        reference = np.where(on["FILTER_TAU"], smooth, reference)
        a = np.where(on["ACCELERATION_LIMIT"], p["ACCELERATION_LIMIT"], 1.0)
        to_go, part = np.abs(reference - profile), 0.5 * a * dt
        # Of n steps that each take a * dt from the speed: to_go is a * dt^2 * n (n + 1) / 2.
        target_speed = np.minimum(np.sqrt(part**2 + 2 * a * to_go) - part, to_go / dt)
        target_speed = np.copysign(target_speed, reference - profile)
        profile_speed = profile_speed + np.clip(target_speed - profile_speed, -a * dt, a * dt)
        profile = profile + dt * profile_speed
        reference = np.where(on["ACCELERATION_LIMIT"], profile, reference)
        played = np.clip(
            played, reference - p["BACKLASH_WIDTH"] / 2, reference + p["BACKLASH_WIDTH"] / 2
        )
        error = played - q
        half = p["DEAD_ZONE_WIDTH"] / 2
        error = np.sign(error) * np.maximum(np.abs(error) - half, 0.0)
        work = work + error * dt
        torque = p["KP"] * error + p["INTEGRAL_GAIN"] * work - p["KD"] * v
        torque = torque / (1 + p["SUPPLY_SAG"] * np.abs(torque)) * np.exp(-p["THERMAL_RATE"] * t)
        soft = np.where(on["SATURATION_TORQUE"], p["SATURATION_TORQUE"], 1.0)
        torque = np.where(on["SATURATION_TORQUE"], soft * np.tanh(torque / soft), torque)
        hard = np.where(on["TORQUE_LIMIT"], p["TORQUE_LIMIT"], np.inf)
        torque = np.clip(torque, -hard, hard)
        no_load = np.where(on["STALL_TORQUE"], p["NO_LOAD_SPEED"], 1.0)
        line = p["STALL_TORQUE"] * np.maximum(
            1 - np.where(torque * v > 0, np.abs(v), 0) / no_load, 0
        )
        line = np.where(on["STALL_TORQUE"], line, np.inf)
        torque = np.clip(torque, -line, line)
        stribeck = p["STRIBECK_SLIDING"] + (p["STRIBECK_STATIC"] - p["STRIBECK_SLIDING"]) * np.exp(
            -((v / p["STRIBECK_SPEED"]) ** 2)
        )
        dry = p["COULOMB_TORQUE"] + p["LOAD_FRICTION"] * np.abs(torque) + stribeck
        between = p["ELASTIC_STIFFNESS"] * (other - q) + p["ELASTIC_DAMPING"] * (other_speed - v)
        between = np.where(on["ELASTIC_STIFFNESS"], between, 0.0)
        torque = torque + between - p["GRAVITY_TORQUE"] * np.sin(q + p["GRAVITY_PHASE"])
        free = v + dt * torque / mass
        brake = dt / mass * (dry + np.where(free > 0, p["FRICTION_PLUS"], p["FRICTION_MINUS"]))
        v = np.sign(free) * np.maximum(np.abs(free) - brake, 0.0)
        v = np.clip(v, -p["VELOCITY_LIMIT"], p["VELOCITY_LIMIT"])
        other_speed = other_speed - dt * between / p["ELASTIC_INERTIA"]
        other = other + dt * other_speed
        q = q + dt * v
        v = np.where(np.abs(q) > stops, 0.0, v)
        q = np.clip(q, -stops, stops)
        history.append(q)
    grid = np.arange(len(history)) * dt
    past = np.array(history)
    return np.stack(
        [
            np.interp(time - rows[c, servo.READ_DELAY], grid, past[:, c])
            + rows[c, servo.ENCODER_BIAS]
            for c in range(len(rows))
        ]
    )


DETERMINISTIC = [name for name in EFFECTS if name not in ("command_jitter", "joint_coupling")]
DRAWS = 6
SIZES = {
    "thermal_drift.rate_per_s": 0.2,
    "gravity_load.phase_rad": 0.5,
    "torque_speed_limit.tau_stall_nm": 0.4,
}
"""Sizes in place of the typical ones, to be seen in two seconds."""


@pytest.fixture(scope="module")
def effects_reference():
    """Rows with each effect at random sizes, the motion, and the oracle's answer.

    Plain rows first.
    """
    rng = np.random.default_rng(5)
    rows = np.tile(rows_of({})[:, 0], ((1 + len(DETERMINISTIC)) * DRAWS, 1))
    rows[:, servo.KP] *= rng.uniform(0.5, 2.0, len(rows))
    rows[:, servo.KD] *= rng.uniform(0.3, 1.5, len(rows))
    for i, name in enumerate(DETERMINISTIC):
        block = rows[(i + 1) * DRAWS : (i + 2) * DRAWS]
        for parameter in EFFECTS[name].parameters:
            size = SIZES.get(f"{name}.{parameter.name}", parameter.typical)
            block[:, parameter.column] = size * rng.uniform(0.5, 2.0, DRAWS)
            if parameter.signed:
                block[:, parameter.column] *= rng.choice([-1.0, 1.0], DRAWS)
    time, command = excitation(rng)
    return (
        rows,
        time,
        command,
        integrate(rows.astype(np.float32).astype(float), time, command, 0.1, DT / FINE),
    )


@pytest.mark.parametrize("effect", ["none", *DETERMINISTIC])
def test_an_effect_follows_a_finer_integration(device, effects_reference, effect):
    rows, time, command, expected = effects_reference
    index = ["none", *DETERMINISTIC].index(effect)
    block = slice(index * DRAWS, (index + 1) * DRAWS)
    got = one_joint(device, rows[block, None], time, command, 0.1)
    error = np.sqrt(np.mean((got - expected[block]) ** 2, axis=1))
    assert error.max() < 1.5e-3, f"rms {error}"
    if effect != "none":
        plain = rows[block].copy()
        for parameter in EFFECTS[effect].parameters:
            plain[:, parameter.column] = parameter.neutral
        without = one_joint(device, plain[:, None], time, command, 0.1)
        assert np.sqrt(np.mean((got - without) ** 2, axis=1)).max() > 3 * error.max(), (
            "too small an effect to be told from the error"
        )


def test_the_error_falls_with_the_square_of_the_step(device):
    time = np.arange(0, 1.5, 0.05)
    command = 0.3 * np.sin(2 * np.pi * np.arange(0, 1.5, 0.05))
    rows = rows_of(
        {servo.ELASTIC_STIFFNESS: 3.0, servo.ELASTIC_DAMPING: 5e-3, servo.ELASTIC_INERTIA: 2e-3}
    )
    truth = one_joint(device, rows, time, command, dt=1 / 7680)
    errors = [
        np.abs(one_joint(device, rows, time, command, dt=dt) - truth).max()
        for dt in (1 / 240, 1 / 480)
    ]
    assert errors[1] < 1e-3 and errors[0] / errors[1] > 3.0, errors


def test_a_drive_gives_no_more_than_its_effort(device):
    rng = np.random.default_rng(3)
    time, command = excitation(rng)
    limit = 0.25
    plain = rows_of({})
    got = one_joint(device, plain, time, command, effort=limit)
    expected = one_joint(device, rows_of({servo.TORQUE_LIMIT: limit}), time, command)
    np.testing.assert_array_equal(got, expected)
    fine = integrate(
        rows_of({servo.TORQUE_LIMIT: limit})[:, 0], time, command, np.zeros(1), DT / FINE
    )
    assert np.sqrt(np.mean((got - fine) ** 2)) < 1.5e-3
    free = one_joint(device, plain, time, command)
    assert np.abs(free - got).max() > 0.02, "the limit does nothing"
    # The smaller of the two counts.
    both = one_joint(
        device, rows_of({servo.TORQUE_LIMIT: 4.0 * limit}), time, command, effort=limit
    )
    np.testing.assert_array_equal(both, got)


def test_stops_and_speed_limits_bound_the_motion(device):
    rng = np.random.default_rng(6)
    time, command = excitation(rng)
    stops, limit = 0.25, 2.0
    rows = rows_of({servo.VELOCITY_LIMIT: limit})
    got = one_joint(device, rows, time, command, stops=stops)
    fine = integrate(rows[:, 0], time, command, np.zeros(1), DT / FINE, stops)
    assert np.sqrt(np.mean((got - fine) ** 2)) < 1.5e-3
    assert np.abs(got).max() == pytest.approx(stops, abs=1e-6)
    assert np.abs(np.diff(got) / np.diff(time)).max() == pytest.approx(limit, rel=1e-3)
    for without in (
        one_joint(device, rows, time, command),
        one_joint(device, rows_of({}), time, command, stops=stops),
    ):
        assert np.abs(without - got).max() > 0.02, "a bound does nothing"


def test_a_joint_that_is_switched_off_swings_out_by_what_damping_is_left(device):
    """Small swings of a pendulum: exp(-c t / 2 I) cos(w t), w^2 = g / I - (c / 2 I)^2."""
    inertia, weight, damping = 5e-3, 0.4, 0.01
    rows = rows_of(
        {servo.INERTIA: inertia, servo.GRAVITY_TORQUE: weight, servo.OFF_DAMPING: damping},
        {servo.INERTIA: inertia, servo.GRAVITY_TORQUE: weight},
    )
    time = np.arange(0.0, 2.0, 0.02)
    off = np.zeros((1, len(time), 1))
    got = roll(device, rows, time, off, np.array([[0.02]]), power=off)[:, 0, :, 0]
    for swing, c in zip(got, (damping, 0.0), strict=True):
        rate = c / (2.0 * inertia)
        turn = np.sqrt(weight / inertia - rate**2)
        expected = (
            0.02 * np.exp(-rate * time) * (np.cos(turn * time) + rate / turn * np.sin(turn * time))
        )
        np.testing.assert_allclose(swing, expected, atol=2e-4)
    # With the torque on, the drive's damping is all there is.
    on = roll(device, rows, time, off, np.array([[0.02]]))[:, 0, :, 0]
    np.testing.assert_array_equal(on[0], on[1])


# --- Friction ---


def test_a_joint_held_by_friction_stays_while_its_neighbours_move(device):
    n = 3
    bodies = random_bodies(np.random.default_rng(1), n)
    time = np.arange(0, 2, 0.01)
    command = np.zeros((1, len(time), n))
    command[0, :, 1:] = 0.4 * np.sin(4.0 * time)[:, None]
    rows = rows_of({}, n=n)
    rows[:, 0, servo.COULOMB_TORQUE] = 2.0
    rows[:, 1:, servo.COULOMB_TORQUE] = 0.02
    got = roll(device, rows, time, command, np.zeros((1, n)), bodies=bodies)[0, 0]
    np.testing.assert_array_equal(got[:, 0], 0.0)
    assert np.ptp(got[:, 1:], axis=0).min() > 0.3


# --- Commands ---


def test_jitter_delays_by_half_a_normal_on_average_and_is_smooth_in_its_size(device):
    time = np.arange(0, 20.0, 0.25)
    command = np.where(np.arange(len(time)) % 2 == 0, 0.0, 1.0)
    sigma = 0.03
    rows = rows_of({}, {servo.JITTER_SIGMA: sigma}, {servo.JITTER_SIGMA: 1.001 * sigma})
    many = roll(device, rows, time, np.tile(command[None, :, None], (50, 1, 1)), np.zeros((50, 1)))[
        ..., 0
    ]
    plain, jittered, nudged = many
    # Mean position at the next stamp, linearised: the delay of each command moves the answer back.
    shifted = one_joint(
        device, rows_of({servo.COMMAND_DELAY: sigma * np.sqrt(2 / np.pi)}), time, command
    )[0]
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
