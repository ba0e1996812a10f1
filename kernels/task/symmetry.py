"""Symmetry frames: a hand with evenly spaced fingers looks the same after a turn from finger to finger.

World frame (z up), quaternions xyzw. V frames: frame k < F is the environment turned about the vertical by
k / F of a full turn, with the F fingers renamed. A policy that always takes the frame in which the axis of
the wanted rotation lies in the same sector has an F-th of the goals to learn. A hand that is its own mirror
image has as many frames in the mirror: half of that.
"""

import warp as wp

from vd.kernels.columns import read_quat
from vd.kernels.transforms import rotation_difference

wp.set_module_options({"enable_backward": False})


@wp.kernel
def choose_frame_kernel(
    # Model:
    sector: wp.array[wp.vec3],
    object_column: int,
    # In:
    reset_in: wp.array[int],
    new_goal_in: wp.array[int],
    joint_q_in: wp.array2d[float],
    goal_quat_in: wp.array[wp.quat],
    # In/Out:
    frame: wp.array[int],
):
    """Choose the frame of every environment that has a new goal, and keep it until the next. Launch: [N].

    It is the frame that turns the axis of the rotation to the goal nearest to one fixed direction. Chosen
    once for a goal: an axis of small rotations wanders, and fingers would change their parts with it.

    Args:
        sector: The fixed direction as each frame turns it back, shape [V].
        object_column: Column of the object's position in ``joint_q_in``; its quaternion follows.
        reset_in: 1 where the world was reset, shape [N].
        new_goal_in: 1 where only the goal is new, shape [N].
        joint_q_in: Hand joints [rad], object position [m] and quaternion, shape [N, D + 7].
        goal_quat_in: Wanted orientation of the object, shape [N].
        frame: Symmetry frame of each environment, shape [N].
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
    source: wp.array3d[int],
    factor: wp.array3d[float],
    offset: wp.array2d[float],
    # In:
    frame_in: wp.array[int],
    world_in: wp.array2d[float],
    # Out:
    observation_out: wp.array2d[float],
):
    """Observations as the frames show them. Launch: [N, O].

    Args:
        source: Values of the world frame that make each value of a frame, shape [V, O, T].
        factor: Their factors, shape [V, O, T].
        offset: What is added to their sum, shape [V, O].
        frame_in: Symmetry frame of each environment, shape [N].
        world_in: Observation in the world frame, shape [N, O].
        observation_out: Observation in the frame, shape [N, O].
    """
    world, column = wp.tid()
    k = frame_in[world]
    value = offset[k, column]
    for term in range(source.shape[2]):
        value += factor[k, column, term] * world_in[world, source[k, column, term]]
    observation_out[world, column] = value


@wp.kernel
def world_action_kernel(
    # Model:
    source: wp.array2d[int],
    sign: wp.array2d[float],
    # In:
    frame_in: wp.array[int],
    action_in: wp.array2d[float],
    # Out:
    action_out: wp.array2d[float],
):
    """Actions of frames, by the fingers' names in the world. Launch: [N, D].

    Args:
        source: Joint of the frame that is each joint of the world, shape [V, D].
        sign: -1 where that joint turns the other way, else 1, shape [V, D].
        frame_in: Symmetry frame of each environment, shape [N].
        action_in: Action in the frame, shape [N, D].
        action_out: Action in the world, shape [N, D]; not ``action_in``.
    """
    world, joint = wp.tid()
    k = frame_in[world]
    action_out[world, joint] = sign[k, joint] * action_in[world, source[k, joint]]
