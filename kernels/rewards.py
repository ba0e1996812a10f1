"""Reward terms of equations 1-5, 7 and 8, with success and fall of the paper's criteria.

World frame (z up, table top at z = 0), SI units, radians, quaternions xyzw.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3
from vd.kernels.transforms import rotation_angle, rotation_difference

wp.set_module_options({"enable_backward": False})

REWARD_TERMS = (
    "success",
    "rotation",
    "fingertip",
    "energy",
    "fall",
    "table_contact",
    "fingertip_height",
    "progress",
    "lift",
)
"""Columns of the reward terms."""

FINGERTIP_SQUARED_SUM = 0
"""``RewardParams.fingertip_form``: sum over fingers of squared distances (paper, eq. 3)."""
FINGERTIP_MEAN = 1
"""``RewardParams.fingertip_form``: mean over fingers of distances (released code)."""


@wp.struct
class RewardParams:
    """Coefficients of the reward; an array of length 1 in device memory.

    success: c1, on reaching the goal (eq. 1).
    rotation: c2, on 1 / (error + rotation_epsilon) (eq. 2) [rad].
    rotation_epsilon: epsilon_theta [rad].
    fingertip: c3, on the distance of fingertips to the object (eq. 3) [1/m^2, or 1/m].
    fingertip_form: FINGERTIP_SQUARED_SUM or FINGERTIP_MEAN.
    energy: c4, on the mechanical power of the joints (eq. 4) [1/W].
    energy_clip: Largest power counted [W]; none if <= 0.
    fall: c5, on losing the object (eq. 5).
    table_contact: c6, on touching the table (eq. 7).
    table_contact_force: Force on the table above which the object touches it [N].
    fingertip_height: c7, on each fingertip above height_limit (eq. 8).
    height_limit: World z above which a fingertip is too high [m].
    progress: Coefficient on the decrease of the rotation error since the last step [1/rad]; not in the paper.
    lift: Coefficient on the object's clearance over ``lift_height``, at most 1; not in the paper.
    lift_height: Clearance of the object's lowest point from which more is worth nothing [m].
    scale: Factor on the sum of all terms.
    """

    success: float
    rotation: float
    rotation_epsilon: float
    fingertip: float
    fingertip_form: int
    energy: float
    energy_clip: float
    fall: float
    table_contact: float
    table_contact_force: float
    fingertip_height: float
    height_limit: float
    progress: float
    lift: float
    lift_height: float
    scale: float


@wp.struct
class SuccessParams:
    """Thresholds of success and fall; an array of length 1 in device memory.

    A stillness threshold (joint_speed to action_norm) or fall_distance that is <= 0 asks for nothing;
    infinity does so too.

    rotation: Largest rotation error [rad]; always asked for.
    joint_speed: Largest norm of the joint velocities [rad/s].
    object_speed: Largest speed of the object [m/s].
    object_spin: Largest angular speed of the object [rad/s].
    action_norm: Largest norm of the smoothed action.
    fall_distance: Distance of the object from fall_center at which it is lost [m].
    fall_center: Centre of the space in which the object is held, world frame [m].
    """

    rotation: float
    joint_speed: float
    object_speed: float
    object_spin: float
    action_norm: float
    fall_distance: float
    fall_center: wp.vec3


@wp.func
def within(value: float, limit: float) -> bool:
    """Whether ``value`` <= ``limit``, or the limit is switched off (<= 0)."""
    return limit <= 0.0 or value <= limit


@wp.kernel
def reward_kernel(
    # Model:
    params: wp.array[RewardParams],
    success_params: wp.array[SuccessParams],
    # In:
    joint_q_in: wp.array2d[float],
    joint_qd_in: wp.array2d[float],
    tip_pos_in: wp.array2d[wp.vec3],
    effort_in: wp.array2d[float],
    goal_quat_in: wp.array[wp.quat],
    smoothed_in: wp.array2d[float],
    table_force_in: wp.array[float],
    clearance_in: wp.array[float],
    must_lift_in: wp.array[int],
    # In/Out:
    previous_error: wp.array[float],
    # Out:
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
    rotation_error_out: wp.array[float],
    success_out: wp.array[int],
    fell_out: wp.array[int],
):
    """Reward, success and fall of the state after a control step. Launch: [N].

    reward = scale * (c1 [success] + c2 / (error + epsilon) + c3 sum_i norm(tip_i - object)^2
    + c4 sum_j abs(qd_j tau_j) + c5 [fell] + c6 [table force > limit]
    + c7 sum_i [tip_i.z > height_limit] + progress (previous_error - error)
    + lift clamp(clearance / lift_height, 0, 1)).
    Success: the rotation error and all speeds are at most their thresholds, without contact with the table
    where that is asked for. Fall: the object's distance
    from fall_center is at least fall_distance. ``previous_error`` becomes the present error; the reset
    kernel starts it anew with each goal.

    Args:
        params: Coefficients, shape [1].
        success_params: Thresholds, shape [1].
        joint_q_in: Hand joints [rad], object position [m] and quaternion, shape [N, D + 7].
        joint_qd_in: Hand joints [rad/s], object linear [m/s] and angular [rad/s] velocity, shape [N, D + 6].
        tip_pos_in: Fingertip positions, world frame [m], shape [N, G].
        effort_in: Joint torques [N m], shape [N, D].
        goal_quat_in: Wanted orientation of the object, shape [N].
        smoothed_in: Smoothed action, shape [N, D].
        table_force_in: Magnitude of the object's force on the table [N], shape [N].
        clearance_in: Height of the object's lowest point above the table's top [m], shape [N].
        must_lift_in: 1 where the object must not touch the table for success, shape [N].
        previous_error: Rotation error of the last step [rad], shape [N].
        reward_out: Reward, shape [N].
        terms_out: Terms with their coefficients, without scale, columns REWARD_TERMS, shape [N, 9].
        rotation_error_out: Angle between object and goal [rad], shape [N].
        success_out: 1 where the goal is reached, shape [N].
        fell_out: 1 where the object is lost, shape [N].
    """
    world = wp.tid()
    weights = params[0]
    limits = success_params[0]
    joints = effort_in.shape[1]
    fingers = tip_pos_in.shape[1]

    position = read_vec3(world, joints, joint_q_in)
    orientation = read_quat(world, joints + 3, joint_q_in)
    velocity = read_vec3(world, joints, joint_qd_in)
    spin = read_vec3(world, joints + 3, joint_qd_in)

    power = wp.float32(0.0)
    joint_speed = wp.float32(0.0)
    action_norm = wp.float32(0.0)
    for joint in range(joints):
        speed = joint_qd_in[world, joint]
        power += wp.abs(speed * effort_in[world, joint])
        joint_speed += speed * speed
        action_norm += smoothed_in[world, joint] * smoothed_in[world, joint]
    joint_speed = wp.sqrt(joint_speed)
    action_norm = wp.sqrt(action_norm)
    if weights.energy_clip > 0.0:
        power = wp.min(power, weights.energy_clip)

    reach = wp.float32(0.0)
    high_tips = wp.float32(0.0)
    for finger in range(fingers):
        tip = tip_pos_in[world, finger]
        if weights.fingertip_form == wp.static(FINGERTIP_MEAN):
            reach += wp.length(tip - position) / float(fingers)
        else:
            reach += wp.length_sq(tip - position)
        if tip[2] > weights.height_limit:
            high_tips += 1.0

    error = rotation_angle(rotation_difference(orientation, goal_quat_in[world]))
    touches = table_force_in[world] > weights.table_contact_force
    success = (
        error <= limits.rotation
        and within(joint_speed, limits.joint_speed)
        and within(wp.length(velocity), limits.object_speed)
        and within(wp.length(spin), limits.object_spin)
        and within(action_norm, limits.action_norm)
        and not (must_lift_in[world] != 0 and touches)
    )
    fell = limits.fall_distance > 0.0 and wp.length(position - limits.fall_center) >= limits.fall_distance

    success_term = wp.where(success, weights.success, 0.0)
    rotation_term = weights.rotation / (error + weights.rotation_epsilon)
    fingertip_term = weights.fingertip * reach
    energy_term = weights.energy * power
    fall_term = wp.where(fell, weights.fall, 0.0)
    table_term = wp.where(touches, weights.table_contact, 0.0)
    height_term = weights.fingertip_height * high_tips
    progress_term = weights.progress * (previous_error[world] - error)
    lift_term = weights.lift * wp.clamp(clearance_in[world] / weights.lift_height, 0.0, 1.0)

    terms_out[world, 0] = success_term
    terms_out[world, 1] = rotation_term
    terms_out[world, 2] = fingertip_term
    terms_out[world, 3] = energy_term
    terms_out[world, 4] = fall_term
    terms_out[world, 5] = table_term
    terms_out[world, 6] = height_term
    terms_out[world, 7] = progress_term
    terms_out[world, 8] = lift_term
    total = success_term + rotation_term + fingertip_term + energy_term
    total += fall_term + table_term + height_term + progress_term + lift_term
    reward_out[world] = weights.scale * total
    rotation_error_out[world] = error
    success_out[world] = wp.where(success, 1, 0)
    fell_out[world] = wp.where(fell, 1, 0)
    previous_error[world] = error
