"""Replay recorded commands in the simulator, and sample its positions where the recording has them.

Order in a physics step: :func:`replay_command_kernel`, the servo and the solver's step, then
:func:`sample_position_kernel`, and the step is counted. Every world follows a trajectory: a track.
W worlds, D joints; samples of all trajectories one after the other. Times, delays and lost commands
are those of :mod:`vd.kernels.servo.chains`.
"""

import warp as wp

from vd.kernels.servo.actuators import (
    COUPLING_0,
    ENCODER_BIAS,
    KP,
    READ_DELAY,
    rest_play,
    shape_command,
)
from vd.kernels.servo.chains import Samples, arrival, split_steps
from vd.kernels.servo.joint_servo import coupled

wp.set_module_options({"enable_backward": False})


@wp.struct
class Tracks:
    """What each world follows."""

    column: wp.array[int]  # [D] recorded column of every hand joint, or -1
    first: wp.array[int]  # [W] first sample of the track
    last: wp.array[int]  # [W] sample after the last
    stream: wp.array[int]  # [W] random stream of the track's trajectory


@wp.kernel
def rest_play_kernel(
    # Model:
    parameters: wp.array2d[float],  # [W D, PARAMETER_COLUMNS] parameter rows
    first: wp.array[int],  # [D] first joint of each joint's finger
    # In:
    held_in: wp.array2d[float],  # [W, D] commands in force [rad]
    power_in: wp.array2d[float],  # [W, D] their power factors
    load_in: wp.array2d[float],  # [W, D] torques of gravity on the joints [N m]
    joint_q_in: wp.array2d[float],  # [W, *] joint positions [rad]
    # Out:
    state_out: wp.array2d[float],  # [W D, STATE_COLUMNS] state rows
):
    """Start the play of every servo where the joint rests. Launch: [W, D]."""
    world, joint = wp.tid()
    row = world * held_in.shape[1] + joint
    power = power_in[world, joint]
    pulled = coupled(joint, first, parameters, row, joint_q_in[world])
    own = parameters[row, COUPLING_0 + joint - first[joint]] * joint_q_in[world, joint]
    load = load_in[world, joint] + power * parameters[row, KP] * (pulled - own)
    rest_play(
        held_in[world, joint], joint_q_in[world, joint], load, power, parameters, row, state_out
    )


@wp.kernel
def replay_command_kernel(
    # Model:
    parameters: wp.array2d[float],  # [W D, PARAMETER_COLUMNS] parameter rows
    samples: Samples,  # the recording; columns are the recorded joints
    tracks: Tracks,  # what each world follows
    # In:
    dt: float,  # physics time step [s]
    step_in: wp.array[wp.int32],  # [1] number of the physics step
    # In/Out:
    write: wp.array2d[wp.int32],  # [W, D] the next command
    due_step: wp.array2d[wp.int32],  # [W, D] whole steps at which the one before arrived
    due_fraction: wp.array2d[float],  # [W, D] and the rest
    held: wp.array2d[float],  # [W, D] the command that arrived last [rad]
    held_power: wp.array2d[float],  # [W, D] its power factor
    state: wp.array2d[float],  # [W D, STATE_COLUMNS] state rows
    # Out:
    reference_out: wp.array2d[float],  # [W, D] mean references [rad]
    power_out: wp.array2d[float],  # [W, D] mean power factors
):
    """The mean reference of each servo over the coming physics step. Launch: [W, D].

    As in :func:`vd.kernels.servo.joint_servo.receive_command_kernel`, commands that arrive divide
    the step.
    """
    world, joint = wp.tid()
    column = tracks.column[joint]
    row = world * write.shape[1] + joint
    now = step_in[0]
    upcoming = write[world, joint]
    last = tracks.last[world]
    if column < 0:
        last = upcoming  # nothing recorded: the first command holds
    value = held[world, joint]
    value_power = held_power[world, joint]
    power = value_power
    reference = wp.float32(0.0)
    done = wp.float32(0.0)
    waiting = wp.bool(True)
    while waiting and upcoming < last:
        step, fraction, kept = arrival(samples, upcoming, tracks.stream[world], parameters, row, dt)
        late_step = due_step[world, joint]
        late_fraction = due_fraction[world, joint]
        if step < late_step or (step == late_step and fraction < late_fraction):
            step = late_step
            fraction = late_fraction
        if step <= now:
            if kept == 1:
                if step == now and fraction > done:
                    part = fraction - done
                    reference += part * shape_command(value, part * dt, parameters, row, state)
                    done += part
                power += (1.0 - done) * (samples.power[upcoming, column] - value_power)
                value = samples.command[upcoming, column]
                value_power = samples.power[upcoming, column]
            due_step[world, joint] = step
            due_fraction[world, joint] = fraction
            upcoming += 1
        else:
            waiting = wp.bool(False)
    write[world, joint] = upcoming
    held[world, joint] = value
    held_power[world, joint] = value_power
    rest = 1.0 - done
    reference += rest * shape_command(value, rest * dt, parameters, row, state)
    reference_out[world, joint] = reference
    power_out[world, joint] = power


@wp.kernel
def sample_position_kernel(
    # Model:
    parameters: wp.array2d[float],  # [W D, PARAMETER_COLUMNS] parameter rows
    samples: Samples,  # the recording; columns are the recorded joints
    tracks: Tracks,  # what each world follows
    # In:
    dt: float,  # physics time step [s]
    step_in: wp.array[wp.int32],  # [1] number of the physics step
    joint_q_prev_in: wp.array2d[float],  # [W, *] joint positions at the start of the step [rad]
    joint_q_in: wp.array2d[float],  # [W, *] joint positions at its end [rad]
    # In/Out:
    read: wp.array2d[wp.int32],  # [W, D] the next sample to take
    # Out:
    position_out: wp.array3d[float],  # [W, T, D] predicted positions [rad]
):
    """Positions as the recording would have them: linear in time, old by the read delay, biased.

    Launch: [W, D].
    """
    world, joint = wp.tid()
    column = tracks.column[joint]
    if column < 0:
        return
    row = world * read.shape[1] + joint
    now = step_in[0]
    before = joint_q_prev_in[world, joint]
    change = joint_q_in[world, joint] - before
    upcoming = read[world, joint]
    last = tracks.last[world]
    waiting = wp.bool(True)
    while waiting and upcoming < last:
        shift = -parameters[row, READ_DELAY] / dt
        step, fraction = split_steps(samples.step[upcoming], samples.fraction[upcoming], shift)
        if step <= now:
            if step < now:  # before the start of the recording
                fraction = 0.0
            position = before + fraction * change + parameters[row, ENCODER_BIAS]
            position_out[world, upcoming - tracks.first[world], joint] = position
            upcoming += 1
        else:
            waiting = wp.bool(False)
    read[world, joint] = upcoming
