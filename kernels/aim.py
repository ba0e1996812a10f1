"""Goals as a policy is told of them: past the goal, while the object is near it."""

import warp as wp

from vd.kernels.columns import read_quat
from vd.kernels.transforms import PI, rotation_angle, rotation_difference

wp.set_module_options({"enable_backward": False})

ALIGNED_RAD = wp.constant(1e-3)
"""Below this angle [rad] a rotation has no axis that its single-precision quaternion could tell."""


@wp.kernel
def aim_kernel(
    # Model:
    past: float,
    within: float,
    object_column: int,
    # In:
    pose_in: wp.array2d[float],
    goal_quat_in: wp.array[wp.quat],
    # Out:
    aimed_quat_out: wp.array[wp.quat],
):
    """Move goals on along the rotation that is left to them. Launch: [N].

    Where the object's angle to its goal is below ``within`` the aimed orientation is ``past`` farther about
    the same axis, at most half a turn away; elsewhere, and where the object is at its goal, it is the goal.

    Args:
        past: How far past the goal [rad].
        within: Angle to the goal below which it is moved [rad].
        object_column: Column of the object's quaternion in ``pose_in``.
        pose_in: Rows with the object's orientation, xyzw, shape [N, *].
        goal_quat_in: Wanted orientation of the object, shape [N].
        aimed_quat_out: Orientation to aim at, shape [N].
    """
    world = wp.tid()
    orientation = read_quat(world, object_column, pose_in)
    goal = goal_quat_in[world]
    left = rotation_difference(orientation, goal)
    angle = rotation_angle(left)
    aimed = goal
    if angle < within and angle > ALIGNED_RAD:
        # Of the two quaternions of that orientation the one beside the goal's: no leap for who reads it.
        sign = wp.where(left[3] < 0.0, -1.0, 1.0)
        axis = sign * wp.normalize(wp.vec3(left[0], left[1], left[2]))
        aimed = sign * wp.quat_from_axis_angle(axis, -wp.min(angle + past, PI)) * orientation
    aimed_quat_out[world] = aimed
