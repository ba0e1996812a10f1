"""Symmetry frames: a hand with evenly spaced fingers looks the same after a turn from finger to finger.

World frame (z up), quaternions xyzw. V frames: frame k < F is the environment turned about the
vertical by k / F of a full turn, with the F fingers renamed. A policy that always takes the frame
in which the axis of the wanted rotation lies in the same sector has an F-th of the goals to learn.
A hand that is its own mirror image has as many frames in the mirror: half of that.
"""

import warp as wp

from vd.kernels.columns import read_quat
from vd.kernels.transforms import rotation_difference

wp.set_module_options({"enable_backward": False})


@wp.kernel
def choose_frame_kernel(
    # Model:
    sector: wp.array[wp.vec3],  # [V] the fixed direction as each frame turns it back
    object_column: int,  # column of the object's position in ``joint_q_in``; its quaternion follows
    # In:
    reset_in: wp.array[int],  # [N] 1 where the world was reset
    new_goal_in: wp.array[int],  # [N] 1 where only the goal is new
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    goal_quat_in: wp.array[wp.quat],  # [N] wanted orientation of the object
    # In/Out:
    frame: wp.array[int],  # [N] symmetry frame of each environment
):
    """Choose the frame of every environment that has a new goal, and keep it until the next.

    Launch: [N].

    It is the frame that turns the axis of the rotation to the goal nearest to one fixed direction.
    Chosen once for a goal: an axis of small rotations wanders, and fingers would change their parts
    with it.
    """
    world = wp.tid()
    if reset_in[world] == 0 and new_goal_in[world] == 0:
        return
    turn = rotation_difference(goal_quat_in[world], read_quat(world, object_column + 3, joint_q_in))
    axis = wp.vec3(turn[0], turn[1], turn[2])
    if turn[3] < 0.0:
        axis = -axis
    best = wp.int32(0)
    for k in range(1, sector.shape[0]):
        if wp.dot(sector[k], axis) > wp.dot(sector[best], axis):
            best = k
    frame[world] = best


@wp.kernel
def frame_observation_kernel(
    # Model:
    source: wp.array3d[int],  # [V, O, T] values of the world frame that make each value of a frame
    factor: wp.array3d[float],  # [V, O, T] their factors
    offset: wp.array2d[float],  # [V, O] what is added to their sum
    # In:
    frame_in: wp.array[int],  # [N] symmetry frame of each environment
    world_in: wp.array2d[float],  # [N, O] observation in the world frame
    # Out:
    observation_out: wp.array2d[float],  # [N, O] observation in the frame
):
    """Observations as the frames show them. Launch: [N, O]."""
    world, column = wp.tid()
    k = frame_in[world]
    value = offset[k, column]
    for term in range(source.shape[2]):
        value += factor[k, column, term] * world_in[world, source[k, column, term]]
    observation_out[world, column] = value


@wp.kernel
def world_action_kernel(
    # Model:
    source: wp.array2d[int],  # [V, D] joint of the frame that is each joint of the world
    sign: wp.array2d[float],  # [V, D] -1 where that joint turns the other way, else 1
    # In:
    frame_in: wp.array[int],  # [N] symmetry frame of each environment
    action_in: wp.array2d[float],  # [N, *] action in the frame
    # Out:
    action_out: wp.array2d[float],  # [N, D] action in the world; not ``action_in``
):
    """Actions of frames, by the fingers' names in the world. Launch: [N, D]."""
    world, joint = wp.tid()
    k = frame_in[world]
    action_out[world, joint] = sign[k, joint] * action_in[world, source[k, joint]]
