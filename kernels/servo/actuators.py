"""The servo of one joint and everything that can be missing from its model, one function per stage.

The plain model is the paper's: torque = kp (command - q) - kd qd, a velocity limit, the drive's
armature. Every effect of :data:`vd.kernels.servo.effects.EFFECTS` changes one stage of it and is
off at its neutral value; with all off, the command itself is the reference, with kp, kd, no
friction and no torque, bit for bit. The same functions run in the gap workflow's rollouts and in
the simulator: both apply ``stiffness (reference - q) - damping qd + torque`` with the damping
treated implicitly, and ``friction`` as the bound of a dry friction force, so that a light joint
holds still at coarse steps. Filter and profile give their mean over the step, as does a command
that arrives within it.

Parameters and states are rows of columns (``PARAMETER_*``, ``STATE_*``) of one joint in one world;
the parameters' are in an array, or in a matrix that a kernel has read once. SI units, radians; time
in seconds since the joint was switched on.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_JOINTS = 6
"""Joints of a finger at most."""

# Columns of a parameter row. The baseline first; neutral values are in vd.kernels.servo.effects.
KP = 0
KD = 1
VELOCITY_LIMIT = 2
INERTIA = 3
COMMAND_DELAY = 4
READ_DELAY = 5
JITTER_SIGMA = 6
JITTER_DROP = 7
FILTER_TAU = 8
ACCELERATION_LIMIT = 9
TORQUE_LIMIT = 10
STALL_TORQUE = 11
NO_LOAD_SPEED = 12
SATURATION_TORQUE = 13
SUPPLY_SAG = 14
THERMAL_RATE = 15
COULOMB_TORQUE = 16
STRIBECK_STATIC = 17
STRIBECK_SLIDING = 18
STRIBECK_SPEED = 19
LOAD_FRICTION = 20
FRICTION_PLUS = 21
FRICTION_MINUS = 22
BACKLASH_WIDTH = 23
DEAD_ZONE_WIDTH = 24
INTEGRAL_GAIN = 25
ENCODER_BIAS = 26
GRAVITY_TORQUE = 27
GRAVITY_PHASE = 28
PAYLOAD_INERTIA = 29
ELASTIC_STIFFNESS = 30
ELASTIC_DAMPING = 31
ELASTIC_INERTIA = 32
COUPLING_0 = 33  # and so on, one for each joint of a finger
OFF_DAMPING = 39
PARAMETER_COLUMNS = 40

# Columns of a state row.
STATE_FILTERED = 0
STATE_PROFILE = 1
STATE_PROFILE_SPEED = 2
STATE_PLAY = 3
STATE_INTEGRAL = 4
STATE_ELASTIC = 5
STATE_ELASTIC_SPEED = 6
STATE_TIME = 7
STATE_COLUMNS = 8

NO_EFFORT_LIMIT = wp.constant(1.0e9)
"""A torque [N m] that no drive reaches."""
LEAST_SLOPE = 0.02
"""Least share of the stiffness that a motor at its limit keeps: it keeps the reference within
reach.
"""
SMALLEST_SPEED = 1.0e-3
"""Least speed scale [rad/s] of a parameter that divides, far below the bounds of any."""


@wp.struct
class Servo:
    """What the servo asks of the joint in one time step."""

    reference: float  # position that the drive pulls to [rad]
    stiffness: float  # stiffness of the drive [N m/rad]
    damping: float  # damping of the drive [N m s/rad]
    torque: float  # torque besides the drive's [N m]
    friction: float  # bound of the dry friction torque [N m]
    motor: float  # mean size of the motor's torque, which load friction follows [N m]
    motor_damping: float  # how that torque falls with speed, signed as it pulls [N m s/rad]


@wp.func
def low_pass(value: float, target: float, tau: float, dt: float) -> wp.vec2:
    """First-order low-pass, exact over a step in which ``target`` is constant.

    Tau = 0 passes through.

    Returns its value at the end of the step and its mean over the step.
    """
    if tau <= 0.0:
        return wp.vec2(target, target)
    decay = wp.exp(-dt / tau)
    error = value - target
    return wp.vec2(target + error * decay, target + error * (1.0 - decay) * tau / dt)


@wp.func
def accelerate(position: float, speed: float, target: float, limit: float, dt: float) -> wp.vec2:
    """One step of a profile to ``target`` with an acceleration up to ``limit``, braking in time.

    Returns the new position and speed of the profile; the acceleration is constant over the step.
    """
    error = target - position
    side = wp.sign(error)
    # The speed at the end of the step from which the rest of the way is just enough to stop:
    # |error| - (speed + wanted) dt / 2 = wanted^2 / (2 limit).
    step = 0.5 * limit * dt
    rest = step * step + 2.0 * limit * wp.abs(error) - limit * dt * side * speed
    # The last steps aim at the target itself: the speed that stops there exactly would alternate.
    wanted = side * wp.min(wp.sqrt(wp.max(rest, 0.0)) - step, wp.abs(error) / dt)
    new_speed = speed + wp.clamp(wanted - speed, -limit * dt, limit * dt)
    return wp.vec2(position + 0.5 * (speed + new_speed) * dt, new_speed)


@wp.func
def play(value: float, target: float, width: float) -> float:
    """Backlash: ``value`` follows ``target`` only when the play of ``width`` [rad] is used up."""
    return wp.clamp(value, target - 0.5 * width, target + 0.5 * width)


@wp.func
def dead_zone(error: float, width: float) -> float:
    """The error beyond a zone of ``width`` [rad] around zero that the controller ignores."""
    return error - wp.clamp(error, -0.5 * width, 0.5 * width)


@wp.func
def motor_torque(
    wanted: float, speed: float, time: float, effort: float, parameters: Any, row: int
) -> wp.vec3:
    """What the motor gives when the controller wants ``wanted`` [N m] at ``speed`` [rad/s].

    In the order of the signal: supply sag (tau / (1 + r |tau|): voltage falls with current),
    warming (exp(-rate t)), soft loss (tau_s tanh(tau / tau_s)), hard limit, and the torque-speed
    line tau_stall (1 - |speed| / omega_0), which bounds driving, not braking; beyond omega_0
    nothing drives.

    Returns the torque [N m], its slope by the torque wanted, and how much of it the torque-speed
    line takes per speed [N m s/rad]. ``effort`` is the largest torque of the drive [N m], ``time``
    [s] since it is on.
    """
    torque = wanted
    slope = wp.float32(1.0)
    sag = parameters[row, SUPPLY_SAG]
    if sag > 0.0:
        share = 1.0 / (1.0 + sag * wp.abs(torque))
        torque *= share
        slope *= share * share
    rate = parameters[row, THERMAL_RATE]
    if rate > 0.0:
        cool = wp.exp(-rate * time)
        torque *= cool
        slope *= cool
    soft = parameters[row, SATURATION_TORQUE]
    if soft > 0.0:
        bent = wp.tanh(torque / soft)
        torque = soft * bent
        slope *= 1.0 - bent * bent
    limit = effort
    if parameters[row, TORQUE_LIMIT] > 0.0:
        limit = wp.min(limit, parameters[row, TORQUE_LIMIT])
    if wp.abs(torque) > limit:
        torque = wp.clamp(torque, -limit, limit)
        slope = 0.0
    stall = parameters[row, STALL_TORQUE]
    fall = wp.float32(0.0)
    if stall > 0.0:
        bound = stall
        steep = wp.float32(0.0)
        if torque * speed > 0.0:
            line = stall / wp.max(parameters[row, NO_LOAD_SPEED], SMALLEST_SPEED)
            bound = stall - line * wp.abs(speed)
            steep = line
            if bound <= 0.0:
                bound = 0.0
                steep = 0.0
        if wp.abs(torque) > bound:
            torque = wp.clamp(torque, -bound, bound)
            slope = 0.0
            fall = steep
    return wp.vec3(torque, slope, fall)


@wp.func
def dry_friction(motor: float, speed: float, parameters: Any, row: int) -> wp.vec2:
    """Friction torque [N m]: Coulomb, Stribeck, load-dependent and asymmetric, added up.

    Friction F+ against positive motion and F- against negative motion is, in motion and at rest, a
    bound of (F+ + F-) / 2 and a constant torque of -(F+ - F-) / 2; so no direction has to be
    guessed. Returns both. Of the ``motor`` torque [N m], which the transmission carries, the size
    counts.
    """
    friction = parameters[row, COULOMB_TORQUE] + parameters[row, LOAD_FRICTION] * wp.abs(motor)
    sliding = parameters[row, STRIBECK_SLIDING]
    static = parameters[row, STRIBECK_STATIC]
    if static > 0.0 or sliding > 0.0:
        ratio = speed / wp.max(parameters[row, STRIBECK_SPEED], SMALLEST_SPEED)
        friction += sliding + (static - sliding) * wp.exp(-ratio * ratio)
    plus = parameters[row, FRICTION_PLUS]
    minus = parameters[row, FRICTION_MINUS]
    return wp.vec2(wp.max(friction + 0.5 * (plus + minus), 0.0), 0.5 * (minus - plus))


@wp.func
def elastic_load(
    position: float,
    speed: float,
    dt: float,
    parameters: Any,
    row: int,
    state: wp.array2d[float],
) -> wp.vec2:
    """Advance the second mass behind its spring by one step.

    A leapfrog step, which has no damping of its own, with the mass increased as average
    acceleration asks: stable with any spring. The joint's side gets the same as a damping that acts
    on the change of its velocity only: ``dt k / 2`` implicitly, less its torque at the present
    velocity.

    Returns:
        The torque on the joint [N m] and the damping [N m s/rad], to be treated implicitly.
    """
    stiffness = parameters[row, ELASTIC_STIFFNESS]
    if stiffness <= 0.0:
        return wp.vec2(0.0, 0.0)
    damping = parameters[row, ELASTIC_DAMPING]
    angle = state[row, STATE_ELASTIC]
    rate = state[row, STATE_ELASTIC_SPEED]
    spring = stiffness * (angle - position)
    inertia = parameters[row, ELASTIC_INERTIA] + 0.5 * dt * damping + 0.25 * dt * dt * stiffness
    new_rate = rate - dt * (spring + damping * (rate - speed)) / inertia
    state[row, STATE_ELASTIC_SPEED] = new_rate
    state[row, STATE_ELASTIC] = angle + dt * new_rate
    stabiliser = 0.5 * dt * stiffness
    torque = spring + damping * 0.5 * (rate + new_rate) + stabiliser * speed
    return wp.vec2(torque, damping + stabiliser)


@wp.func
def start_servo(command: float, position: float, row: int, state: wp.array2d[float]):
    """Reset a joint's state.

    Profile and filter at the command, the second mass at rest on the joint.
    """
    state[row, STATE_FILTERED] = command
    state[row, STATE_PROFILE] = command
    state[row, STATE_PROFILE_SPEED] = 0.0
    state[row, STATE_PLAY] = command
    state[row, STATE_INTEGRAL] = 0.0
    state[row, STATE_ELASTIC] = position
    state[row, STATE_ELASTIC_SPEED] = 0.0
    state[row, STATE_TIME] = 0.0


@wp.func
def rest_play(
    command: float,  # command in force [rad]
    position: float,  # position at which the joint rests [rad]
    load: float,  # torque on the joint besides the drive's and :func:`drive_joint`'s own gravity load [N m]
    power: float,  # as in :func:`drive_joint`; with the torque off the play stays at the command
    parameters: Any,  # [R, PARAMETER_COLUMNS] parameter rows
    row: int,  # the joint's row
    state: wp.array2d[float],  # [R, STATE_COLUMNS] state rows; the joint's play is written
):
    """Put the play where a joint at rest has it, which depends on how it came there.

    Dry friction aside, a joint rests where its drive carries its load; without friction and dead
    zone nothing but the play says how far that is from the command.
    """
    stiffness = power * parameters[row, KP]
    if stiffness > 0.0:
        weight = parameters[row, GRAVITY_TORQUE] * wp.sin(position + parameters[row, GRAVITY_PHASE])
        reference = position + (weight - load) / stiffness
        state[row, STATE_PLAY] = play(reference, command, parameters[row, BACKLASH_WIDTH])


@wp.func
def shape_command(
    command: float, dt: float, parameters: Any, row: int, state: wp.array2d[float]
) -> float:
    """The reference that firmware and transmission make of a command: filter, profile, backlash.

    Returns its mean over ``dt`` [rad], for which the command is constant; a step in which a command
    arrives can be taken in two parts. The joint's row of the state is advanced.
    """
    filtered = low_pass(state[row, STATE_FILTERED], command, parameters[row, FILTER_TAU], dt)
    state[row, STATE_FILTERED] = filtered[0]
    reference = filtered[1]
    limit = parameters[row, ACCELERATION_LIMIT]
    if limit > 0.0:
        before = state[row, STATE_PROFILE]
        profile = accelerate(before, state[row, STATE_PROFILE_SPEED], reference, limit, dt)
        state[row, STATE_PROFILE] = profile[0]
        state[row, STATE_PROFILE_SPEED] = profile[1]
        reference = 0.5 * (before + profile[0])
    reference = play(state[row, STATE_PLAY], reference, parameters[row, BACKLASH_WIDTH])
    state[row, STATE_PLAY] = reference
    return reference


@wp.func
def drive_joint(
    reference: float,  # mean over the step of :func:`shape_command` and what coupled joints add [rad]
    before: float,  # its mean over the first ``share`` of the step, until a command arrived [rad]
    share: float,  # that share of the step; 0 if no command arrived within it
    position: float,  # true joint position [rad]
    speed: float,  # joint velocity [rad/s]
    power: float,  # factor on the controller's position and integral gains, 0 with the torque off
    dt: float,  # time step [s]
    effort: float,  # largest torque of the drive [N m]; ``NO_EFFORT_LIMIT`` where somebody else keeps it
    parameters: Any,  # [R, PARAMETER_COLUMNS] parameter rows
    row: int,  # the joint's row
    state: wp.array2d[float],  # [R, STATE_COLUMNS] state rows; the joint's row is advanced
) -> Servo:
    """One time step of the control loop, the motor and the load of a joint.

    What limits the motor sees the jump of ``before``: the limit of a mean would let it act a part
    of a step early. ``power`` leaves the damping as it is, but with the torque off the damping,
    mostly back-EMF, goes too, since the terminals are open; friction stays, and of the damping the
    gears' (``OFF_DAMPING``).
    """
    result = Servo()
    time = state[row, STATE_TIME]
    state[row, STATE_TIME] = time + dt

    width = parameters[row, DEAD_ZONE_WIDTH]
    parts = share > 0.0 and share < 1.0
    first = before
    second = reference
    if parts:
        second = (reference - share * before) / (1.0 - share)
    if width > 0.0:
        if parts:
            first = position + dead_zone(first - position, width)
            second = position + dead_zone(second - position, width)
            reference = share * first + (1.0 - share) * second
        else:
            reference = position + dead_zone(reference - position, width)
    integral = 0.0
    if parameters[row, INTEGRAL_GAIN] > 0.0 and power > 0.0:
        integral = state[row, STATE_INTEGRAL] + (reference - position) * dt
        state[row, STATE_INTEGRAL] = integral
    steady = power * parameters[row, INTEGRAL_GAIN] * integral
    kp = power * parameters[row, KP]
    damping = parameters[row, KD]
    open_damping = wp.float32(0.0)
    if power <= 0.0:
        damping = 0.0
        open_damping = parameters[row, OFF_DAMPING]
    wanted = kp * (reference - position) - damping * speed + steady
    motor = motor_torque(wanted, speed, time, effort, parameters, row)
    carried = wp.abs(motor[0])
    if parts:
        early = wanted + kp * (first - reference)
        late = wanted + kp * (second - reference)
        motor_early = motor_torque(early, speed, time, effort, parameters, row)
        motor_late = motor_torque(late, speed, time, effort, parameters, row)
        if motor_early[0] != early or motor_late[0] != late:
            motor = share * motor_early + (1.0 - share) * motor_late
        carried = share * wp.abs(motor_early[0]) + (1.0 - share) * wp.abs(motor_late[0])
    if motor[0] != wanted:
        # Stiffness and damping are the slopes at this torque, so that an implicit step takes
        # nothing of a torque at its limit, which no motion changes; the reference is where they
        # pull that torque from.
        damping = motor[1] * damping + motor[2]
        kp *= wp.max(motor[1], LEAST_SLOPE)
        steady = motor[0] + damping * speed
        if kp > 0.0:
            reference = position + steady / kp
            steady = 0.0
    friction = dry_friction(carried, speed, parameters, row)
    load = elastic_load(position, speed, dt, parameters, row, state)
    result.reference = reference
    result.stiffness = kp
    result.damping = damping + open_damping + load[1]
    weight = parameters[row, GRAVITY_TORQUE]
    if weight != 0.0:
        weight *= wp.sin(position + parameters[row, GRAVITY_PHASE])
    result.torque = steady - weight + load[0] + friction[1]
    result.friction = friction[0]
    result.motor = carried
    result.motor_damping = wp.sign(motor[0]) * damping
    return result
