"""Rollouts of one chain of revolute joints, one thread per trajectory and parameter set.

The joints carry the servos of :mod:`vd.kernels.servo.actuators`. Without bodies a joint is its own
inertia (a bare servo, a pendulum); with bodies the chain is a finger: mass matrix and bias forces
in 3-D (:mod:`vd.kernels.servo.chain_bodies`).

Each step ``dt`` is a leapfrog step: positions at whole steps, velocities half-way between, so the
error of smooth motion falls with dt^2. What makes a servo stiff is implicit: damping by
Crank-Nicolson as far as that does not ring, stiffness by average acceleration. Dry friction is an
impulse bounded by the friction torque, found by projected Gauss-Seidel sweeps: a joint that
friction can hold stands still exactly.

A command takes the share of a step that remains when it arrives, so the motion is a smooth function
of its delay. SI units, radians; times are whole steps and a fraction, exact over any duration.
"""

import functools
from typing import Any

import warp as wp

from vd.kernels.servo.actuators import (
    COMMAND_DELAY,
    COUPLING_0,
    ENCODER_BIAS,
    INERTIA,
    JITTER_DROP,
    JITTER_SIGMA,
    KP,
    LOAD_FRICTION,
    PARAMETER_COLUMNS,
    PAYLOAD_INERTIA,
    READ_DELAY,
    STATE_TIME,
    VELOCITY_LIMIT,
    drive_joint,
    rest_play,
    shape_command,
    start_servo,
)
from vd.kernels.servo.chain_bodies import chain_dynamics, links_of_size

SMALLEST_INERTIA = 1.0e-8
"""Least inertia on the diagonal [kg m^2], so that a search that asks for none divides by
something.
"""
FRICTION_SWEEPS = 3
"""Gauss-Seidel sweeps a step, started from the impulses of the step before."""
CENTRED = 0.5
"""Leapfrog: the torque of a step acts from half a step before its position to half a step after."""
DIVERGED = 100.0
"""Distance from the start [rad] at which a rollout stops to mean anything and is held."""


COMPILER = "-march=native" if wp.config.cpu_compiler_flags is None else wp.config.cpu_compiler_flags
wp.set_module_options({"enable_backward": False})
OPTIONS = {
    "enable_backward": False,
    # Everything that a step reads is in registers or on the stack: no write makes it be read again.
    "max_unroll": PARAMETER_COLUMNS,
    # Vectors of three fill no register of a CPU: packing them costs more than it saves.
    "optimization_level": 3,
    "cpu_compiler_flags": f"{COMPILER} -fno-slp-vectorize",
}
"""Of the module of each size of :func:`rollout_kernel`."""
INVERTED = 4
"""Rows of the largest matrix that Warp inverts itself."""


@wp.struct
class Samples:
    """Recorded trajectories, one after the other; S rows (time stamps) in all."""

    step: wp.array[int]  # [S] time stamp in whole steps; that of a piece does not begin at 0
    fraction: wp.array[float]  # [S] and the rest, in [0, 1]
    sent_step: wp.array[int]  # [S] when the command was sent, in whole steps
    sent_fraction: wp.array[float]  # [S] and the rest, in [0, 1]
    command: wp.array2d[float]  # [S, n] commanded positions [rad]
    power: wp.array2d[float]  # [S, n] factor on the controller's gains, 0 with the torque off


@wp.func
def implicitness(ratio: float) -> float:
    """Weight of the new velocity in the damping torque of a step, for dt damping / inertia = ``ratio``.

    One half is exact to second order; above a ratio of 2 more is needed for the velocity not to
    ring.
    """
    return wp.max(0.5, 1.0 - 1.0 / wp.max(ratio, 1.0))


@wp.func
def split_steps(step: int, fraction: float, shift: float):
    """The time ``step + fraction + shift`` as whole steps and a fraction in [0, 1)."""
    rest = fraction + shift
    whole = wp.floor(rest)
    return step + int(whole), rest - whole


@wp.func
def arrival(
    samples: Samples,
    write: int,
    stream: int,
    parameters: Any,
    row: int,
    dt: float,
):
    """When a command acts, and whether it does: ``(step, fraction, kept)``.

    The random numbers belong to the write, whatever the parameters. Joints share them: the commands
    of a hand go out together.
    """
    delay = parameters[row, COMMAND_DELAY]
    sigma = parameters[row, JITTER_SIGMA]
    drop = parameters[row, JITTER_DROP]
    kept = 1
    if sigma > 0.0 or drop > 0.0:
        rng = wp.rand_init(stream, write)
        if wp.randf(rng) < drop:
            kept = 0
        delay += sigma * wp.abs(wp.randn(rng))
    step, fraction = split_steps(
        samples.sent_step[write], samples.sent_fraction[write], CENTRED + delay / dt
    )
    return step, fraction, kept


@wp.func
def friction_impulses(wanted: Any, inverse: Any, bound: Any, before: Any, count: int):
    """Velocities under dry friction.

    ``(speed, impulse)`` of ``wanted`` ones [rad/s] and ``bound`` [N m s].

    ``inverse`` is that of the effective mass matrix; the search starts from the impulses
    ``before``. Joints whose impulse is within its bound stand still exactly.
    """
    impulse = type(wanted)(0.0)
    for i in range(len(wanted)):
        if i < count:
            impulse[i] = wp.clamp(before[i], -bound[i], bound[i])
    speed = wanted + inverse * impulse
    moved = wp.bool(True)
    for _sweep in range(FRICTION_SWEEPS):
        if moved:  # what a sweep leaves as it is the next would too
            moved = wp.bool(False)
            for i in range(len(wanted)):
                if i < count:
                    new = wp.clamp(impulse[i] - speed[i] / inverse[i, i], -bound[i], bound[i])
                    change = new - impulse[i]
                    moved = moved or change != 0.0
                    impulse[i] = new
                    for j in range(len(wanted)):
                        if j < count:
                            speed[j] += inverse[j, i] * change
    for i in range(len(wanted)):
        if i < count and wp.abs(impulse[i]) < bound[i]:
            speed[i] = 0.0
    return speed, impulse


@wp.func
def slip(speed: float, change: float):
    """A speed [rad/s] less what dry friction takes of it, ``change`` at most."""
    return speed - wp.sign(speed) * wp.min(change, wp.abs(speed))


@wp.func
def load_bounds(bound: Any, kick: float, motor: Any, loaded: Any, gained: Any):
    """Friction impulses [N m s] at the middle of a step, where ``bound`` has those of its beginning.

    Of the load friction ``motor`` [N m] in them, which falls by ``loaded`` [N m s/rad] with the
    speed ``gained`` [rad/s] over the ``kick`` [s].
    """
    result = bound
    for j in range(len(bound)):
        middle = wp.abs(motor[j] - 0.5 * loaded[j] * gained[j])
        result[j] = wp.max(bound[j] + kick * (middle - motor[j]), 0.0)
    return result


def inverse_of_size(size: int) -> Any:
    """The function that inverts positive definite matrices of ``size`` rows."""
    if size <= INVERTED:
        return wp.inverse

    @wp.func
    def inverse_of(matrix: Any):
        left = matrix
        right = wp.identity(n=size, dtype=float)
        for i in range(size):
            scale = 1.0 / left[i, i]
            left[i] = scale * left[i]
            right[i] = scale * right[i]
            for j in range(size):
                if j != i:
                    share = left[j, i]
                    left[j] = left[j] - share * left[i]
                    right[j] = right[j] - share * right[i]
        return right

    return inverse_of


@functools.cache
def rollout_kernel(size: int) -> wp.Kernel:
    """The kernel for chains of up to ``size`` joints."""
    Vector = wp.types.vector(length=size, dtype=float)
    Integers = wp.types.vector(length=size, dtype=int)
    Matrix = wp.types.matrix(shape=(size, size), dtype=float)
    Rows = wp.types.matrix(shape=(size, PARAMETER_COLUMNS), dtype=float)
    inverse_of = inverse_of_size(size)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def rollout(
        # In:
        samples: Samples,  # what was recorded
        first_sample: wp.array[int],  # [R] row of ``samples`` where a rollout's trajectory begins
        sample_count: wp.array[int],  # [R] rows of each trajectory
        first_output: wp.array[int],  # [R] row of ``predicted`` where each rollout begins
        stream: wp.array[int],  # [R] number of each trajectory's random stream
        start: wp.array2d[float],  # [R, n] positions measured at the start, at rest [rad]
        wanted: wp.array[int],  # [R] joint whose positions are kept, in column 0; -1: all
        slot: wp.array[int],  # [n] place of each joint in the finger: its column of coupling
        lower: wp.array[float],  # [n] lower stops [rad]
        upper: wp.array[float],  # [n] upper stops [rad]
        effort: wp.array[float],  # [n] largest torques of the drives [N m]
        bodies: int,  # 1 if the links have mass, 0 if each joint is its own inertia
        links: links_of_size(size),  # the links, if they have mass
        parameters: wp.array2d[float],  # [R n, PARAMETER_COLUMNS] rows by rollout and joint
        dt: float,  # time step [s]
        # Out:
        state: wp.array3d[float],  # [R, n, STATE_COLUMNS] working memory
        predicted: wp.array2d[float],  # [S', n] positions as the servo reports, or [S', 1] [rad]
    ):
        """Simulate trajectories with parameter sets. Launch: [R]."""
        run = wp.tid()
        count = slot.shape[0]
        base_row = run * count
        begin = first_sample[run]
        end = begin + sample_count[run]
        to_output = first_output[run] - begin
        only = wanted[run]
        memory = state[run]
        rows = Rows(0.0)
        coupling = Matrix(0.0)
        for j in range(size):
            if j < count:
                for column in range(PARAMETER_COLUMNS):
                    rows[j, column] = parameters[base_row + j, column]
                for i in range(size):
                    if i < count:
                        coupling[j, i] = parameters[base_row + j, COUPLING_0 + slot[i]]

        q = Vector(0.0)
        q_start = Vector(0.0)
        speed = Vector(0.0)
        impulse = Vector(0.0)
        # Per joint: the command in force, the write that comes next and when, the next sample and
        # when.
        held = Vector(0.0)
        held_power = Vector(0.0)
        write = Integers(begin)
        due_step = Integers(0)
        due_fraction = Vector(0.0)
        due_kept = Integers(1)
        read = Integers(begin)
        read_step = Integers(0)
        read_fraction = Vector(0.0)
        dry = wp.int32(0)  # typed: it changes in a loop
        for j in range(size):
            if j < count:
                q[j] = start[run, j] - rows[j, ENCODER_BIAS]
                q_start[j] = q[j]
                held[j] = samples.command[begin, j]
                held_power[j] = samples.power[begin, j]
                start_servo(held[j], q[j], j, memory)
                memory[j, STATE_TIME] = dt * float(samples.step[begin])
                step, fraction, kept = arrival(samples, begin, stream[run], rows, j, dt)
                due_step[j] = step
                due_fraction[j] = fraction
                due_kept[j] = kept
                step, fraction = split_steps(
                    samples.step[begin], samples.fraction[begin], -rows[j, READ_DELAY] / dt
                )
                read_step[j] = step
                read_fraction[j] = fraction
        weight = Vector(0.0)
        if bodies != 0:
            _resting, weight = chain_dynamics(q, Vector(0.0), links)
        for j in range(size):
            if j < count:
                # What coupled joints add to the reference is a load in the units of the drive.
                load = -weight[j]
                for i in range(size):
                    if i < count and i != j:
                        load += held_power[j] * rows[j, KP] * coupling[j, i] * q[i]
                rest_play(held[j], q[j], load, held_power[j], rows, j, memory)

        for k in range(samples.step[begin], samples.step[end - 1] + 1):
            # From rest at the first position to the velocity half a step later.
            kick = dt
            if k == samples.step[begin]:
                kick = CENTRED * dt
            torque = Vector(0.0)
            damping = Vector(0.0)
            bound = Vector(0.0)
            diagonal = Vector(1.0)
            stiffness = Vector(0.0)
            motor = Vector(0.0)
            loaded = Vector(0.0)
            for j in range(size):
                if j < count:
                    # Commands that arrive within the step divide it; the reference is the mean over
                    # it.
                    reference = wp.float32(0.0)
                    power = held_power[j]
                    done = wp.float32(0.0)
                    while due_step[j] <= k:
                        if due_kept[j] == 1:
                            part = wp.float32(0.0)
                            if due_step[j] == k:
                                part = due_fraction[j] - done
                            if part > 0.0:
                                reference += part * shape_command(
                                    held[j], part * dt, rows, j, memory
                                )
                                done += part
                            power += (1.0 - done) * (samples.power[write[j], j] - held_power[j])
                            held[j] = samples.command[write[j], j]
                            held_power[j] = samples.power[write[j], j]
                        write[j] = write[j] + 1
                        if write[j] < end:
                            step, fraction, kept = arrival(
                                samples, write[j], stream[run], rows, j, dt
                            )
                            # In order: no command overtakes the one before.
                            if step < due_step[j] or (
                                step == due_step[j] and fraction < due_fraction[j]
                            ):
                                step = due_step[j]
                                fraction = due_fraction[j]
                            due_step[j] = step
                            due_fraction[j] = fraction
                            due_kept[j] = kept
                        else:
                            due_step[j] = 2147483647
                    coupled = wp.float32(0.0)
                    if count > 1:
                        for i in range(size):
                            if i < count:
                                coupled += coupling[j, i] * q[i]
                    before = wp.float32(0.0)
                    if done > 0.0:
                        before = reference / done + coupled
                    part = 1.0 - done
                    reference += part * shape_command(held[j], part * dt, rows, j, memory) + coupled
                    drive = drive_joint(
                        reference,
                        before,
                        done,
                        q[j],
                        speed[j],
                        power,
                        dt,
                        effort[j],
                        rows,
                        j,
                        memory,
                    )
                    torque[j] = (
                        drive.stiffness * (drive.reference - q[j])
                        - drive.damping * speed[j]
                        + drive.torque
                    )
                    damping[j] = drive.damping
                    stiffness[j] = drive.stiffness
                    bound[j] = kick * drive.friction
                    motor[j] = rows[j, LOAD_FRICTION] * drive.motor
                    loaded[j] = rows[j, LOAD_FRICTION] * drive.motor_damping
                    if drive.friction > 0.0:
                        dry = 1
                    diagonal[j] = rows[j, INERTIA] + rows[j, PAYLOAD_INERTIA]

            mass = Matrix(0.0)
            if bodies == 1:
                mass, bias = chain_dynamics(q, speed, links)
                torque -= bias
            for j in range(size):
                inertia = wp.max(diagonal[j] + mass[j, j], SMALLEST_INERTIA)
                mass[j, j] = (
                    inertia
                    + kick * damping[j] * implicitness(kick * damping[j] / inertia)
                    + 0.25 * dt * dt * stiffness[j]
                )
            new_speed = Vector(0.0)
            if count == 1:
                free = speed[0] + kick * torque[0] / mass[0, 0]
                new_speed[0] = slip(free, bound[0] / mass[0, 0])
                if loaded[0] != 0.0:
                    bound = load_bounds(bound, kick, motor, loaded, new_speed - speed)
                    new_speed[0] = slip(free, bound[0] / mass[0, 0])
            else:
                inverse = inverse_of(mass)
                free_speed = speed + inverse * (kick * torque)
                new_speed = free_speed
                if dry == 1:
                    new_speed, impulse = friction_impulses(
                        free_speed, inverse, bound, impulse, count
                    )
                    if wp.dot(loaded, loaded) != 0.0:
                        bound = load_bounds(bound, kick, motor, loaded, new_speed - speed)
                        new_speed, impulse = friction_impulses(
                            free_speed, inverse, bound, impulse, count
                        )
            for j in range(size):
                if j < count:
                    limit = rows[j, VELOCITY_LIMIT]
                    v = wp.clamp(new_speed[j], -limit, limit)
                    last = q[j]
                    after = last + dt * v
                    if after < lower[j] or after > upper[j]:
                        # A start beyond a stop, as an encoder's bias makes it, is no reason to
                        # jump.
                        after = wp.clamp(after, wp.min(lower[j], last), wp.max(upper[j], last))
                        v = 0.0
                    if not (wp.abs(after - q_start[j]) < DIVERGED):
                        after = q_start[j] + DIVERGED
                        v = 0.0
                    q[j] = after
                    speed[j] = v
                    while read_step[j] <= k and read[j] < end:
                        share = 0.0
                        if read_step[j] == k:
                            share = read_fraction[j]
                        position = last + share * (after - last) + rows[j, ENCODER_BIAS]
                        if only < 0:
                            predicted[to_output + read[j], j] = position
                        elif only == j:
                            predicted[to_output + read[j], 0] = position
                        read[j] = read[j] + 1
                        if read[j] < end:
                            step, fraction = split_steps(
                                samples.step[read[j]],
                                samples.fraction[read[j]],
                                -rows[j, READ_DELAY] / dt,
                            )
                            read_step[j] = step
                            read_fraction[j] = fraction

    return rollout
