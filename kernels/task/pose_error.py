"""An object that is believed to lie where it does not, all through an episode.

What tracking is wrong by.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3, write_quat, write_vec3
from vd.kernels.rng import next_stream

wp.set_module_options({"enable_backward": False})


@wp.kernel
def draw_pose_error_kernel(
    # Model:
    size: wp.array[wp.vec2],  # [1] length of the displacement [m], angle of the rotation [rad]
    # In:
    mask_in: wp.array[int],  # [N] 1 where a world is drawn anew
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    error_out: wp.array[wp.transform],  # [N] displacement, turn about the object's origin, world
):
    """Draw the error of the masked worlds, of uniform direction and axis. Launch: [N]."""
    world = wp.tid()
    if mask_in[world] == 0:
        return
    state = rng[world]
    direction = wp.sample_unit_sphere_surface(state)
    axis = wp.sample_unit_sphere_surface(state)
    turn = wp.quat_from_axis_angle(axis, size[0][1])
    error_out[world] = wp.transform(size[0][0] * direction, turn)
    rng[world] = next_stream(state, world)


@wp.kernel
def mistake_pose_kernel(
    # In:
    error_in: wp.array[wp.transform],  # [N] displacement d and rotation r of each object, world
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object position p [m], quaternion q
    # Out:
    joint_q_out: wp.array2d[float],  # [N, D + 7] the same as it is believed
):
    """Copy positions, the object's with its error: p + d, r * q. Launch: [N]."""
    world = wp.tid()
    joints = joint_q_in.shape[1] - 7
    for joint in range(joints):
        joint_q_out[world, joint] = joint_q_in[world, joint]
    position = read_vec3(world, joints, joint_q_in) + wp.transform_get_translation(error_in[world])
    turn = wp.transform_get_rotation(error_in[world])
    column = write_vec3(world, joints, position, joint_q_out)
    write_quat(world, column, turn * read_quat(world, column, joint_q_in), joint_q_out)
