"""What a policy sees late: the state after every physics step, kept in a ring, and read at an age.

A row of the ring holds what observations are made of, in this order: joints as the encoders report
them, their velocities, all positions, all velocities, and of each fingertip's link pose 7, velocity
6. The object comes from a camera, joints and fingertips from encoders: each have an age of their
own.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3, write_quat, write_vec3
from vd.kernels.rng import next_stream, uniform

wp.set_module_options({"enable_backward": False})


@wp.struct
class StateArrays:
    """What observations are made of."""

    measured_q: wp.array2d[float]  # [N, *] hand joints as their encoders report them [rad]
    measured_qd: wp.array2d[float]  # [N, *] velocities likewise [rad/s]
    joint_q: wp.array2d[float]  # [N, D + 7] hand joints [rad], object position [m] and quaternion
    joint_qd: wp.array2d[float]  # [N, D + 6] joints [rad/s], object linear and angular velocity
    body_q: wp.array2d[wp.transform]  # [N, B] link poses in the world frame
    body_qd: wp.array2d[wp.spatial_vector]  # [N, B] link velocities in the world frame


LINK_VALUES = 13
"""Values of a fingertip's link in a row: position 3, quaternion 4, linear 3 and angular velocity
3.
"""


def ring_columns(joints: int, positions: int, velocities: int, fingers: int) -> int:
    """Values in a row of the ring."""
    return 2 * joints + positions + velocities + LINK_VALUES * fingers


@wp.func
def write_state(
    row: int,
    world: int,
    joints: int,
    tip_body: wp.array[int],
    now: StateArrays,
    ring: wp.array2d[float],
):
    """Write a world's present state to a row of the ring."""
    for i in range(joints):
        ring[row, i] = now.measured_q[world, i]
        ring[row, joints + i] = now.measured_qd[world, i]
    column = 2 * joints
    for i in range(now.joint_q.shape[1]):
        ring[row, column + i] = now.joint_q[world, i]
    column += now.joint_q.shape[1]
    for i in range(now.joint_qd.shape[1]):
        ring[row, column + i] = now.joint_qd[world, i]
    column += now.joint_qd.shape[1]
    for finger in range(tip_body.shape[0]):
        pose = now.body_q[world, tip_body[finger]]
        twist = now.body_qd[world, tip_body[finger]]
        column = write_vec3(row, column, wp.transform_get_translation(pose), ring)
        column = write_quat(row, column, wp.transform_get_rotation(pose), ring)
        column = write_vec3(row, column, wp.spatial_top(twist), ring)
        column = write_vec3(row, column, wp.spatial_bottom(twist), ring)


@wp.kernel
def record_state_kernel(
    # Model:
    joints: int,  # joints of the hand, D
    slots: int,  # rows of each world, L
    tip_body: wp.array[int],  # [G] link of each fingertip, an index within a world
    # In:
    now: StateArrays,  # the present state
    # In/Out:
    head: wp.array[int],  # [N] slot written last
    # Out:
    ring_out: wp.array2d[float],  # [N L, C] past states, world by world
):
    """Remember the state after a physics step. Launch: [N]."""
    world = wp.tid()
    slot = (head[world] + 1) % slots
    head[world] = slot
    write_state(world * slots + slot, world, joints, tip_body, now, ring_out)


@wp.kernel
def begin_latency_kernel(
    # Model:
    joints: int,  # joints of the hand, D
    slots: int,  # rows of each world, L
    tip_body: wp.array[int],  # [G] link of each fingertip
    ranges: wp.array[wp.vec2],  # [2] range of the object's latency, of joints and fingertips' [s]
    # In:
    mask_in: wp.array[int],  # [N] 1 where an episode begins
    now: StateArrays,  # the present state
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    latency_out: wp.array[float],  # [N] how late the object is seen [s]
    encoder_latency_out: wp.array[float],  # [N] how late joints and fingertips are seen [s]
    ring_out: wp.array2d[float],  # [N L, C] past states
):
    """Draw the latencies of an episode that begins; its past is its first state. Launch: [N].

    Both are at the same share of their ranges, so that the one that a critic is told says both.
    """
    world = wp.tid()
    if mask_in[world] == 0:
        return
    state, share = uniform(rng[world], wp.vec2(0.0, 1.0))
    latency_out[world] = wp.lerp(ranges[0][0], ranges[0][1], share)
    encoder_latency_out[world] = wp.lerp(ranges[1][0], ranges[1][1], share)
    rng[world] = next_stream(state, world)
    for slot in range(slots):
        write_state(world * slots + slot, world, joints, tip_body, now, ring_out)


@wp.func
def aged_row(world: int, latency: float, physics_dt: float, slots: int, head: wp.array[int]) -> int:
    """Row of a world's state at an age, to the nearest physics step."""
    age = wp.clamp(int(wp.round(latency / physics_dt)), 0, slots - 1)
    return world * slots + (head[world] - age + slots) % slots


@wp.kernel
def recall_state_kernel(
    # Model:
    joints: int,  # joints of the hand, D
    slots: int,  # rows of each world, L
    tip_body: wp.array[int],  # [G] link of each fingertip; only their poses are written
    physics_dt: float,  # time between two rows [s]
    # In:
    latency_in: wp.array[float],  # [N] how late each object is seen [s], at most (L - 1) steps
    encoder_latency_in: wp.array[float],  # [N] how late joints and tips are seen [s], likewise
    head_in: wp.array[int],  # [N] slot written last
    ring_in: wp.array2d[float],  # [N L, C] past states
    # Out:
    seen_out: StateArrays,  # arrays to write
):
    """Object and hand as they were their latency ago, of the nearest physics step. Launch: [N]."""
    world = wp.tid()
    seen = aged_row(world, latency_in[world], physics_dt, slots, head_in)
    row = aged_row(world, encoder_latency_in[world], physics_dt, slots, head_in)
    for i in range(joints):
        seen_out.measured_q[world, i] = ring_in[row, i]
        seen_out.measured_qd[world, i] = ring_in[row, joints + i]
    column = 2 * joints
    for i in range(seen_out.joint_q.shape[1]):
        seen_out.joint_q[world, i] = ring_in[wp.where(i < joints, row, seen), column + i]
    column += seen_out.joint_q.shape[1]
    for i in range(seen_out.joint_qd.shape[1]):
        seen_out.joint_qd[world, i] = ring_in[wp.where(i < joints, row, seen), column + i]
    column += seen_out.joint_qd.shape[1]
    for finger in range(tip_body.shape[0]):
        body = tip_body[finger]
        seen_out.body_q[world, body] = wp.transform(
            read_vec3(row, column, ring_in), read_quat(row, column + 3, ring_in)
        )
        seen_out.body_qd[world, body] = wp.spatial_vector(
            read_vec3(row, column + 7, ring_in), read_vec3(row, column + 10, ring_in)
        )
        column += wp.static(LINK_VALUES)
