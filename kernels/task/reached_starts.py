"""Starts in states that the policy reached itself: kept of each world in a ring, and put back.

What a state consists of is rows of any numbers of 32 bits; they are copied bit by bit.
"""

import warp as wp

from vd.kernels.columns import read_vec3
from vd.kernels.rng import next_stream

wp.set_module_options({"enable_backward": False})


@wp.kernel
def choose_kept_kernel(
    # Model:
    share: float,  # of the states that qualify, those to keep
    speed: float,  # largest speed of an object that is held [m/s]
    spin: float,  # largest angular speed of it [rad/s]
    force: float,  # force on the table above which the object touches it [N]
    joints: int,  # joints of the hand, D
    # In:
    ended_in: wp.array[int],  # [N] not 0 where the episode has ended
    step_count_in: wp.array[int],  # [N] control steps since the reset
    table_steps_in: wp.array[int],  # [N] control steps for which the table stays
    table_force_in: wp.array[float],  # [N] the object's force on the table [N]
    failed_in: wp.array[int],  # [N] not 0 where the physics failed
    joint_qd_in: wp.array2d[float],  # [N, D + 6] joints, object [m/s], its spin [rad/s]
    slots: int,  # states of each world, K
    # In/Out:
    count: wp.array[int],  # [N] states kept so far
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    slot_out: wp.array[int],  # [N] where to keep the present state; -1: nowhere
):
    """Choose states in which the object is off a table that is there, and slow. Launch: [N]."""
    world = wp.tid()
    state = rng[world]
    drawn = wp.randf(state)
    rng[world] = next_stream(state, world)
    velocity = read_vec3(world, joints, joint_qd_in)
    rotation = read_vec3(world, joints + 3, joint_qd_in)
    held = (
        ended_in[world] == 0
        and failed_in[world] == 0
        and step_count_in[world] <= table_steps_in[world]
        and table_force_in[world] <= force
        and wp.length(velocity) <= speed
        and wp.length(rotation) <= spin
    )
    slot_out[world] = -1
    if held and drawn < share:
        slot_out[world] = count[world] % slots
        count[world] = count[world] + 1


@wp.kernel
def keep_rows_kernel(
    # In:
    slot_in: wp.array[int],  # [N] where to keep; -1: nowhere
    rows_in: wp.array2d[int],  # [N, C] the present state
    # Out:
    kept_out: wp.array3d[int],  # [N, K, C] kept states
):
    """Keep the present state of the chosen worlds. Launch: [N, C]."""
    world, column = wp.tid()
    slot = slot_in[world]
    if slot >= 0:
        kept_out[world, slot, column] = rows_in[world, column]


@wp.kernel
def choose_start_kernel(
    # Model:
    share: float,  # of the resets, those that begin in a kept state
    slots: int,  # states of each world, K
    # In:
    ended_in: wp.array[int],  # [N] not 0 where a new episode begins
    count_in: wp.array[int],  # [N] states kept so far
    # In/Out:
    new_goal: wp.array[int],  # [N] 1 where only the goal is drawn: where a state is put back, too
    step_count: wp.array[int],  # [N] control steps since the reset
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    slot_out: wp.array[int],  # [N] the state to begin in; -1: none
    reset_out: wp.array[int],  # [N] 1 where the world is reset as usual
):
    """Choose the episodes that begin in a kept state. Launch: [N]."""
    world = wp.tid()
    slot_out[world] = -1
    reset_out[world] = ended_in[world]
    if ended_in[world] == 0:
        return
    state = rng[world]
    drawn = wp.randf(state)
    there = wp.min(count_in[world], slots)
    if there > 0 and drawn < share:
        slot_out[world] = wp.randi(state, 0, there)
        reset_out[world] = 0
        new_goal[world] = 1
        step_count[world] = 0
    rng[world] = next_stream(state, world)


@wp.kernel
def put_rows_kernel(
    # In:
    slot_in: wp.array[int],  # [N] the state to put back; -1: none
    kept_in: wp.array3d[int],  # [N, K, C] kept states
    # In/Out:
    rows: wp.array2d[int],  # [N, C] the present state
):
    """Put a kept state back into the chosen worlds. Launch: [N, C]."""
    world, column = wp.tid()
    slot = slot_in[world]
    if slot >= 0:
        rows[world, column] = kept_in[world, slot, column]
