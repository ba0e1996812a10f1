"""Success and fall by the paper's criteria.

World frame (z up, table top at z = 0), SI units, radians, quaternions xyzw.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3
from vd.kernels.transforms import rotation_angle, rotation_difference

wp.set_module_options({"enable_backward": False})


@wp.struct
class SuccessParams:
    """Thresholds of success and fall; an array of length 1 in device memory.

    A stillness threshold (joint_speed to action_norm) or fall_distance that is <= 0 asks for
    nothing; infinity does so too.
    """

    rotation: float  # largest rotation error [rad]; always asked for
    joint_speed: float  # largest norm of the joint velocities [rad/s]
    object_speed: float  # largest speed of the object [m/s]
    object_spin: float  # largest angular speed of the object [rad/s]
    action_norm: float  # largest norm of the smoothed action
    table_contact_force: float  # force on the table above which the object touches it [N]
    fall_distance: float  # distance of the object from fall_center at which it is lost [m]
    fall_center: wp.vec3  # centre of the space in which the object is held, world frame [m]


@wp.func
def within(value: float, limit: float) -> bool:
    """Whether ``value`` <= ``limit``, or the limit is switched off (<= 0)."""
    return limit <= 0.0 or value <= limit


@wp.kernel
def success_kernel(
    # Model:
    params: wp.array[SuccessParams],  # [1] thresholds
    # In:
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    joint_qd_in: wp.array2d[float],  # [N, D + 6] velocities: joints, object [m/s], its spin [rad/s]
    goal_quat_in: wp.array[wp.quat],  # [N] wanted orientation of the object
    smoothed_in: wp.array2d[float],  # [N, D] smoothed action
    table_force_in: wp.array[float],  # [N] magnitude of the object's force on the table [N]
    must_lift_in: wp.array[int],  # [N] 1 where the object must not touch the table for success
    # Out:
    rotation_error_out: wp.array[float],  # [N] angle between object and goal [rad]
    still_out: wp.array[int],  # [N] 1 where all of success holds but the rotation's threshold
    success_out: wp.array[int],  # [N] 1 where the goal is reached
    fell_out: wp.array[int],  # [N] 1 where the object is lost
):
    """Success and fall of the state after a control step. Launch: [N].

    Success: the rotation error and all speeds are at most their thresholds, without contact with
    the table where that is asked for. Fall: the object's distance from fall_center is at least
    fall_distance.
    """
    world = wp.tid()
    limits = params[0]
    joints = smoothed_in.shape[1]

    position = read_vec3(world, joints, joint_q_in)
    orientation = read_quat(world, joints + 3, joint_q_in)
    velocity = read_vec3(world, joints, joint_qd_in)
    spin = read_vec3(world, joints + 3, joint_qd_in)

    joint_speed = wp.float32(0.0)
    action_norm = wp.float32(0.0)
    for joint in range(joints):
        joint_speed += joint_qd_in[world, joint] * joint_qd_in[world, joint]
        action_norm += smoothed_in[world, joint] * smoothed_in[world, joint]

    error = rotation_angle(rotation_difference(orientation, goal_quat_in[world]))
    still = (
        within(wp.sqrt(joint_speed), limits.joint_speed)
        and within(wp.length(velocity), limits.object_speed)
        and within(wp.length(spin), limits.object_spin)
        and within(wp.sqrt(action_norm), limits.action_norm)
        and not (must_lift_in[world] != 0 and table_force_in[world] > limits.table_contact_force)
    )
    success = still and error <= limits.rotation
    fell = (
        limits.fall_distance > 0.0
        and wp.length(position - limits.fall_center) >= limits.fall_distance
    )

    rotation_error_out[world] = error
    still_out[world] = wp.where(still, 1, 0)
    success_out[world] = wp.where(success, 1, 0)
    fell_out[world] = wp.where(fell, 1, 0)
