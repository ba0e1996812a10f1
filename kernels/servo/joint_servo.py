"""The servo of every hand joint inside the simulator.

Commands in transit, the drive, what is measured.

Order in a control step: :func:`send_command_kernel` once; before every physics step
:func:`receive_command_kernel` and :func:`drive_joint_kernel`; after it :func:`finish_joint_kernel`;
:func:`measure_joint_kernel` once at the end. The model of a joint is that of
:mod:`vd.kernels.servo.actuators`; here its result goes where MuJoCo Warp reads it, per world and
physics step.

N worlds, D hand joints, which couple within their finger; joint ``j`` of world ``w`` has row
``w D + j`` of the parameters and states. Arrays ``[N, *]`` hold at least D columns, the hand joints
first. A world's clock is ``STATE_TIME``, zero at its reset.
"""

import warp as wp

from vd.kernels.rng import next_stream
from vd.kernels.servo.actuators import (
    COMMAND_DELAY,
    COUPLING_0,
    ENCODER_BIAS,
    INERTIA,
    JITTER_DROP,
    JITTER_SIGMA,
    LOAD_FRICTION,
    MAX_JOINTS,
    NO_EFFORT_LIMIT,
    PAYLOAD_INERTIA,
    READ_DELAY,
    STATE_TIME,
    VELOCITY_LIMIT,
    drive_joint,
    shape_command,
    start_servo,
)
from vd.kernels.servo.chains import CENTRED, implicitness

wp.set_module_options({"enable_backward": False})

MAX_JITTER_SIGMAS = 4.0
"""Longest extra delay of a command in standard deviations: it bounds the commands in transit."""
FRICTION_IMPEDANCE = wp.constant(0.999)
"""Impedance of the dry friction constraint. At MuJoCo's default of 0.9 a joint that friction holds
creeps by many milliradians a second, at 0.99 by one; at 0.9999 the solver does not converge in ten
iterations.
"""

vec5 = wp.types.vector(length=5, dtype=float)
vec10 = wp.types.vector(length=10, dtype=float)


@wp.kernel
def send_command_kernel(
    # Model:
    parameters: wp.array2d[float],  # [N D, PARAMETER_COLUMNS] parameter rows
    # In:
    dt: float,  # physics time step [s]
    command_in: wp.array2d[float],  # [N, *] commanded positions [rad]
    state_in: wp.array2d[float],  # [N D, STATE_COLUMNS] state rows
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    transit_head: wp.array2d[wp.int32],  # [N, D] index of the oldest command in transit
    transit_count: wp.array2d[wp.int32],  # [N, D] commands in transit
    transit_value: wp.array3d[float],  # [N, D, K] commands in transit [rad], a ring
    transit_time: wp.array3d[float],  # [N, D, K] when each arrives on the world's clock [s]
):
    """Send a command to every joint: it arrives after the delay and |N(0, sigma)| more, or never.

    Launch [N].

    The commands of a hand go out together, so its joints share one draw of the jitter and one of
    the loss. Commands arrive in the order in which they were sent. What a joint is told at a time
    acts from there on, which is the middle of a physics step: velocities are those between two
    positions.
    """
    world = wp.tid()
    joints = transit_count.shape[1]
    capacity = transit_value.shape[2]
    stream = rng[world]
    jitter = wp.min(wp.abs(wp.randn(stream)), wp.static(MAX_JITTER_SIGMAS))
    loss = wp.randf(stream)
    rng[world] = next_stream(stream, world)
    for joint in range(joints):
        row = world * joints + joint
        if loss >= parameters[row, JITTER_DROP]:
            delay = parameters[row, COMMAND_DELAY] + jitter * parameters[row, JITTER_SIGMA]
            arrival = state_in[row, STATE_TIME] + CENTRED * dt + delay
            head = transit_head[world, joint]
            count = transit_count[world, joint]
            if count > 0:
                last = (head + count - 1) % capacity
                arrival = wp.max(arrival, transit_time[world, joint, last])
            if count < capacity:
                count += 1
            slot = (head + count - 1) % capacity
            transit_value[world, joint, slot] = command_in[world, joint]
            transit_time[world, joint, slot] = arrival
            transit_count[world, joint] = count


@wp.kernel
def receive_command_kernel(
    # Model:
    parameters: wp.array2d[float],  # [N D, PARAMETER_COLUMNS] parameter rows
    # In:
    dt: float,  # physics time step [s]
    # In/Out:
    state: wp.array2d[float],  # [N D, STATE_COLUMNS] state rows
    transit_head: wp.array2d[wp.int32],  # as in :func:`send_command_kernel`
    transit_count: wp.array2d[wp.int32],  # as in :func:`send_command_kernel`
    transit_value: wp.array3d[float],  # as in :func:`send_command_kernel`
    transit_time: wp.array3d[float],  # as in :func:`send_command_kernel`
    held: wp.array2d[float],  # [N, D] the command that arrived last [rad]
    # Out:
    reference_out: wp.array2d[float],  # [N, D] mean reference of the step [rad]
):
    """The reference that a joint has during the coming physics step. Launch: [N, D].

    A command that arrives within the step divides it, so that the motion is a smooth function of
    the delay; the reference is the mean over the step.
    """
    world, joint = wp.tid()
    row = world * held.shape[1] + joint
    capacity = transit_value.shape[2]
    now = state[row, STATE_TIME]
    head = transit_head[world, joint]
    count = transit_count[world, joint]
    value = held[world, joint]
    reference = wp.float32(0.0)
    done = wp.float32(0.0)
    while count > 0 and transit_time[world, joint, head] < now + dt:
        part = (transit_time[world, joint, head] - now) / dt - done
        if part > 0.0:
            reference += part * shape_command(value, part * dt, parameters, row, state)
            done += part
        value = transit_value[world, joint, head]
        head = (head + 1) % capacity
        count -= 1
    transit_head[world, joint] = head
    transit_count[world, joint] = count
    held[world, joint] = value
    rest = 1.0 - done
    reference_out[world, joint] = reference + rest * shape_command(
        value, rest * dt, parameters, row, state
    )


@wp.func
def coupled(
    joint: int,
    first: wp.array[int],  # [D] first joint of each joint's finger
    parameters: wp.array2d[float],  # [N D, PARAMETER_COLUMNS] parameter rows
    row: int,
    joint_q: wp.array[float],  # [*] joint positions [rad]
) -> float:
    """What the joints of a finger add to the reference of one of them [rad]."""
    result = wp.float32(0.0)
    for slot in range(MAX_JOINTS):
        other = first[joint] + slot
        if other < first.shape[0] and first[other] == first[joint]:
            result += parameters[row, COUPLING_0 + slot] * joint_q[other]
    return result


@wp.kernel
def drive_joint_kernel(
    # Model:
    parameters: wp.array2d[float],  # [N D, PARAMETER_COLUMNS] parameter rows
    first: wp.array[int],  # [D] first joint of each joint's finger
    inverse_inertia: wp.array2d[float],  # [N, *] diagonal of the inverse inertia [1/(kg m^2)]
    effort: wp.array2d[float],  # [N, *] largest torques of the drives [N m], which the solver keeps
    actuator: wp.array[int],  # [D] each joint's of A actuators; -1 where it follows another
    # In:
    dt: float,  # physics time step [s]
    reference_in: wp.array2d[float],  # [N, D] mean reference of this step [rad]
    power_in: wp.array2d[float],  # [N, D] factor on the controller's gains, 0 with the torque off
    joint_q_in: wp.array2d[float],  # [N, *] joint positions [rad]
    joint_qd_in: wp.array2d[float],  # [N, *] joint velocities [rad/s]
    # In/Out:
    state: wp.array2d[float],  # [N D, STATE_COLUMNS] state rows
    # Out:
    reference_out: wp.array2d[float],  # [N, *] position to which the drive pulls [rad]
    joint_force_out: wp.array2d[float],  # [N, *] torque besides the drive's [N m]
    gain_out: wp.array2d[vec10],  # [N, A] MuJoCo's gain parameters of the actuators; (kp, ..)
    bias_out: wp.array2d[vec10],  # [N, A] MuJoCo's bias parameters; (0, -kp, -kd, ..)
    friction_out: wp.array2d[float],  # [N, *] MuJoCo's friction loss of the joints [N m]
    friction_solref_out: wp.array2d[wp.vec2],  # [N, *] its solref, (stiffness, damping) negated
    friction_solimp_out: wp.array2d[vec5],  # [N, *] its solimp
):
    """One time step of every servo, written to the solver's inputs. Launch: [N, D].

    The drive is MuJoCo's affine actuator. Its damping is integrated implicitly, an error of half a
    physics step; as in :mod:`vd.kernels.servo.chains` only the share of it that stability needs is
    left there, and the rest acts at the present velocity, through the reference, so that the effort
    limit sees it. With this a model identified at small steps moves the same at the simulator's.

    Dry friction is the solver's friction loss. That constraint asks for the acceleration -b v; with
    b = 1/dt + kd/m a joint within the bound of its friction stops in one step, the implicit damping
    included. (The default b, of a time constant of 20 ms, and 1/dt alone both let it slide on.)
    """
    world, joint = wp.tid()
    row = world * reference_in.shape[1] + joint
    speed = joint_qd_in[world, joint]
    drive = drive_joint(
        reference_in[world, joint] + coupled(joint, first, parameters, row, joint_q_in[world]),
        0.0,
        0.0,
        joint_q_in[world, joint],
        speed,
        power_in[world, joint],
        dt,
        NO_EFFORT_LIMIT,  # the solver keeps it
        parameters,
        row,
        state,
    )
    mobility = inverse_inertia[world, joint]
    damping = drive.damping * implicitness(dt * drive.damping * mobility)
    explicit = (drive.damping - damping) * speed
    reference = drive.reference
    torque = drive.torque
    if drive.stiffness > 0.0:
        reference -= explicit / drive.stiffness
    else:
        torque -= explicit
    reference_out[world, joint] = reference
    joint_force_out[world, joint] = torque
    column = actuator[joint]
    if column >= 0:
        gain_out[world, column][0] = drive.stiffness
        bias_out[world, column][1] = -drive.stiffness
        bias_out[world, column][2] = -damping
    # The load of load friction is what the drive can give, not what the controller wants of it.
    beyond = wp.max(drive.motor - effort[world, joint], 0.0)
    friction_out[world, joint] = wp.max(
        drive.friction - parameters[row, LOAD_FRICTION] * beyond, 0.0
    )
    stop = 1.0 / dt + damping * mobility
    friction_solref_out[world, joint] = wp.vec2(-1.0, -stop * FRICTION_IMPEDANCE)
    friction_solimp_out[world, joint] = vec5(
        FRICTION_IMPEDANCE, FRICTION_IMPEDANCE, 0.001, 0.5, 2.0
    )


@wp.kernel
def finish_joint_kernel(
    # Model:
    parameters: wp.array2d[float],  # [N D, PARAMETER_COLUMNS] parameter rows
    # In:
    dt: float,  # physics time step [s]
    joint_q_prev_in: wp.array2d[float],  # [N, *] joint positions before the step [rad]
    # In/Out:
    joint_q: wp.array2d[float],  # [N, *] joint positions after the step [rad]
    joint_qd: wp.array2d[float],  # [N, *] joint velocities after the step [rad/s]
    history_index: wp.array2d[wp.int32],  # [N, D] where in ``history`` the newest position is
    # Out:
    history: wp.array3d[float],  # [N, D, R] past positions [rad], one a physics step, a ring
    speed_history: wp.array3d[float],  # [N, D, R] past velocities [rad/s] likewise
):
    """Hold a joint to its velocity limit after a physics step, and remember its motion.

    Launch: [N, D].

    The limit acts as in :func:`vd.kernels.task.actions.limit_joint_velocity_kernel`, here per
    world.
    """
    world, joint = wp.tid()
    speed = joint_qd[world, joint]
    limit = parameters[world * history.shape[1] + joint, VELOCITY_LIMIT]
    if wp.abs(speed) > limit:
        limited = wp.sign(speed) * limit
        joint_qd[world, joint] = limited
        joint_q[world, joint] = joint_q_prev_in[world, joint] + limited * dt
    index = (history_index[world, joint] + 1) % history.shape[2]
    history_index[world, joint] = index
    history[world, joint, index] = joint_q[world, joint]
    speed_history[world, joint, index] = joint_qd[world, joint]


@wp.kernel
def measure_joint_kernel(
    # Model:
    parameters: wp.array2d[float],  # [N D, PARAMETER_COLUMNS] parameter rows
    # In:
    dt: float,  # physics time step [s]
    history_index_in: wp.array2d[wp.int32],  # [N, D] where in ``history_in`` the newest position is
    history_in: wp.array3d[float],  # [N, D, R] past positions [rad], one a physics step, a ring
    speed_history_in: wp.array3d[float],  # [N, D, R] past velocities [rad/s] likewise
    # Out:
    measured_q_out: wp.array2d[float],  # [N, D] measured positions [rad]
    measured_qd_out: wp.array2d[float],  # [N, D] measured velocities [rad/s]
):
    """What the servo reports: old by the read delay, positions off by the encoder's bias.

    Launch: [N, D].
    """
    world, joint = wp.tid()
    row = world * measured_q_out.shape[1] + joint
    length = history_in.shape[2]
    age = wp.clamp(parameters[row, READ_DELAY] / dt, 0.0, float(length - 2))
    whole = int(wp.floor(age))
    part = age - float(whole)
    newest = history_index_in[world, joint] + length
    slot = (newest - whole) % length
    value = history_in[world, joint, slot]
    speed = speed_history_in[world, joint, slot]
    if part > 0.0:
        slot = (newest - whole - 1) % length
        value += part * (history_in[world, joint, slot] - value)
        speed += part * (speed_history_in[world, joint, slot] - speed)
    measured_q_out[world, joint] = value + parameters[row, ENCODER_BIAS]
    measured_qd_out[world, joint] = speed


@wp.kernel
def reset_joint_kernel(
    # Model:
    parameters: wp.array2d[float],  # [N D, PARAMETER_COLUMNS] parameter rows
    # In:
    mask_in: wp.array[wp.int32],  # [N] 1 for the worlds to reset
    command_in: wp.array2d[float],  # [N, *] the command that every servo has had so far [rad]
    joint_q_in: wp.array2d[float],  # [N, *] joint positions [rad]
    # Out:
    state_out: wp.array2d[float],  # [N D, STATE_COLUMNS] state rows
    transit_head_out: wp.array2d[wp.int32],  # as in :func:`send_command_kernel`
    transit_count_out: wp.array2d[wp.int32],  # as in :func:`send_command_kernel`
    held_out: wp.array2d[float],  # [N, D] the command that arrived last [rad]
    history_out: wp.array3d[float],  # [N, D, R] past positions [rad]
    speed_history_out: wp.array3d[float],  # [N, D, R] past velocities [rad/s]
    measured_q_out: wp.array2d[float],  # [N, D] measured positions [rad]
    measured_qd_out: wp.array2d[float],  # [N, D] measured velocities [rad/s]
):
    """Start the servos of chosen worlds: at rest, with one command since long ago.

    Launch: [N, D].
    """
    world, joint = wp.tid()
    if mask_in[world] == 0:
        return
    row = world * held_out.shape[1] + joint
    position = joint_q_in[world, joint]
    start_servo(command_in[world, joint], position, row, state_out)
    transit_head_out[world, joint] = 0
    transit_count_out[world, joint] = 0
    held_out[world, joint] = command_in[world, joint]
    for k in range(history_out.shape[2]):
        history_out[world, joint, k] = position
        speed_history_out[world, joint, k] = 0.0
    measured_q_out[world, joint] = position + parameters[row, ENCODER_BIAS]
    measured_qd_out[world, joint] = 0.0


@wp.kernel
def joint_inertia_kernel(
    # Model:
    parameters: wp.array2d[float],
    # Out:
    armature_out: wp.array2d[float],
):
    """Inertia added to each joint [kg m^2], rotor and payload, into the first D columns, shape [N, *].

    Launch: [N, D].
    """
    world, joint = wp.tid()
    row = world * (parameters.shape[0] // armature_out.shape[0]) + joint
    armature_out[world, joint] = parameters[row, INERTIA] + parameters[row, PAYLOAD_INERTIA]
