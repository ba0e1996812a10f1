"""What a policy remembers of its own observations.

World frame (z up), quaternions xyzw. A frame is told by how the scene differed from the present one, so that
it needs neither the goal nor the axes of the object's file, and small changes are of order one: joint
positions D, smoothed action D, object position 3, rotation 3; H = 2 D + 6 values.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3, write_quat, write_vec3
from vd.kernels.transforms import canonical, rotation_difference

wp.set_module_options({"enable_backward": False})

JOINT_UNIT = 0.1
"""Unit of a change of an observed joint position (ours): a control step at full speed is 0.1 to 0.3."""
POSITION_UNIT_M = 0.01
"""Unit of the object's way [m] (ours): a control step at the speed of 0.1 m/s."""
ROTATION_UNIT_RAD = 0.1
"""Unit of the object's rotation [rad] (ours): a control step at 1.2 rad/s."""
POSE_VALUES = 6
"""Values of the object in a frame: the way 3 and the rotation 3."""


def frame_size(joints: int) -> int:
    """Values of one frame of the history, H."""
    return 2 * joints + POSE_VALUES


@wp.func
def small_rotation(q: wp.quat, q_from: wp.quat) -> wp.vec3:
    """Twice the vector part of the rotation from ``q_from`` to ``q``, with w >= 0 [rad, small]."""
    turn = canonical(rotation_difference(q, q_from))
    return 2.0 * wp.vec3(turn[0], turn[1], turn[2])


@wp.func
def seen_rotation(world: int, column: int, observation: wp.array2d[float], goal: wp.quat) -> wp.quat:
    """Orientation of the object as the observed rotation to the goal, in ``column``, tells it."""
    return wp.normalize(read_quat(world, column, observation)) * goal


@wp.kernel
def remember_kernel(
    # Model:
    joints: int,  # joints of the hand, D; their positions are observed in the first columns
    position_column: int,  # column of the object's position
    rotation_column: int,  # column of its rotation from the goal
    action_column: int,  # column of the previous (smoothed) action
    frames: int,  # rows of each world, K
    # In:
    observation_in: wp.array2d[float],  # [N, *] observation in the world frame
    goal_quat_in: wp.array[wp.quat],  # [N] the goal as it was observed
    # In/Out:
    head: wp.array[int],  # [N] row written last
    count: wp.array[int],  # [N] rows that hold something
    # Out:
    past_out: wp.array2d[float],  # [N K, 2 D + 7] past observations, world by world
):
    """Remember the present observation. Launch: [N].

    A row holds joint positions D and smoothed action D as observed, object position 3 and orientation 4.
    """
    world = wp.tid()
    slot = (head[world] + 1) % frames
    head[world] = slot
    count[world] = wp.min(count[world] + 1, frames)
    row = world * frames + slot
    for joint in range(joints):
        past_out[row, joint] = observation_in[world, joint]
        past_out[row, joints + joint] = observation_in[world, action_column + joint]
    column = write_vec3(row, 2 * joints, read_vec3(world, position_column, observation_in), past_out)
    seen = seen_rotation(world, rotation_column, observation_in, goal_quat_in[world])
    write_quat(row, column, seen, past_out)


@wp.kernel
def forget_kernel(
    # In:
    mask_in: wp.array[int],  # [N] 1 where an episode begins
    # Out:
    count_out: wp.array[int],  # [N] rows of the past that hold something
):
    """Forget the past of the masked worlds. Launch: [N]."""
    world = wp.tid()
    if mask_in[world] != 0:
        count_out[world] = 0


@wp.kernel
def history_kernel(
    # Model:
    joints: int,  # joints of the hand, D
    position_column: int,  # column of the object's position
    rotation_column: int,  # column of its rotation from the goal
    action_column: int,  # column of the previous (smoothed) action
    frames: int,  # rows of each world, K
    column: int,  # first column of the history
    # In:
    goal_quat_in: wp.array[wp.quat],  # [N] the goal as it is observed
    head_in: wp.array[int],  # [N] row written last
    count_in: wp.array[int],  # [N] rows that hold something
    past_in: wp.array2d[float],  # [N K, 2 D + 7] past observations
    # In/Out:
    observation: wp.array2d[float],  # [N, *] observation in the world frame, written from ``column`` on
):
    """Write the past frames, newest first; before the first one the oldest repeats. Launch: [N, K]."""
    world, frame = wp.tid()
    out = column + frame * (2 * joints + wp.static(POSE_VALUES))
    filled = count_in[world]
    if filled == 0:
        for i in range(2 * joints + wp.static(POSE_VALUES)):
            observation[world, out + i] = 0.0
        for joint in range(joints):
            observation[world, out + joints + joint] = observation[world, action_column + joint]
        return
    row = world * frames + (head_in[world] - wp.min(frame, filled - 1) + frames) % frames
    for joint in range(joints):
        change = past_in[row, joint] - observation[world, joint]
        observation[world, out + joint] = change / wp.static(JOINT_UNIT)
        observation[world, out + joints + joint] = past_in[row, joints + joint]
    way = read_vec3(row, 2 * joints, past_in) - read_vec3(world, position_column, observation)
    seen = seen_rotation(world, rotation_column, observation, goal_quat_in[world])
    turn = small_rotation(read_quat(row, 2 * joints + 3, past_in), seen)
    out = write_vec3(world, out + 2 * joints, way / wp.static(POSITION_UNIT_M), observation)
    write_vec3(world, out, turn / wp.static(ROTATION_UNIT_RAD), observation)
