"""Reward terms of equations 1-5, 7 and 8.

World frame (z up, table top at z = 0), SI units, radians, quaternions xyzw.
"""

import warp as wp

from vd.kernels.columns import read_vec3

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
    """Coefficients of the reward; an array of length 1 in device memory."""

    success: float  # c1, on reaching the goal (eq. 1)
    rotation: float  # c2, on 1 / (error + rotation_epsilon) (eq. 2) [rad]
    rotation_epsilon: float  # epsilon_theta [rad]
    fingertip: float  # c3, on the distance of fingertips to the object (eq. 3) [1/m^2, or 1/m]
    fingertip_form: int  # FINGERTIP_SQUARED_SUM or FINGERTIP_MEAN
    energy: float  # c4, on the mechanical power of the joints (eq. 4) [1/W]
    energy_clip: float  # largest power counted [W]; none if <= 0
    fall: float  # c5, on losing the object (eq. 5)
    table_contact: float  # c6, on touching the table (eq. 7)
    table_contact_force: float  # force on the table above which the object touches it [N]
    fingertip_height: float  # c7, on each fingertip above height_limit (eq. 8)
    height_limit: float  # world z above which a fingertip is too high [m]
    progress: float  # coefficient on the decrease of the rotation error [1/rad]; not in the paper
    lift: float  # coefficient on the object's clearance over ``lift_height``, at most 1; not in the paper
    lift_height: float  # clearance of its lowest point from which more is worth nothing [m]
    scale: float  # factor on the sum of all terms


@wp.kernel
def reward_kernel(
    # Model:
    params: wp.array[RewardParams],  # [1] coefficients
    # In:
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    joint_qd_in: wp.array2d[float],  # [N, D + 6] velocities: joints, object [m/s], its spin [rad/s]
    tip_pos_in: wp.array2d[wp.vec3],  # [N, G] fingertip positions, world frame [m]
    effort_in: wp.array2d[float],  # [N, D] joint torques [N m]
    table_force_in: wp.array[float],  # [N] magnitude of the object's force on the table [N]
    clearance_in: wp.array[float],  # [N] height of the object's lowest point over the table [m]
    rotation_error_in: wp.array[float],  # [N] angle between object and goal [rad]
    success_in: wp.array[int],  # [N] 1 where the goal is reached
    fell_in: wp.array[int],  # [N] 1 where the object is lost
    # In/Out:
    previous_error: wp.array[float],  # [N] rotation error of the last step [rad]
    # Out:
    reward_out: wp.array[float],  # [N] reward
    terms_out: wp.array2d[float],  # [N, 9] terms times coefficients, without scale: REWARD_TERMS
):
    """Reward of the state after a control step. Launch: [N], after the success kernel.

    reward = scale * (c1 [success] + c2 / (error + epsilon) + c3 sum_i norm(tip_i - object)^2
    + c4 sum_j abs(qd_j tau_j) + c5 [fell] + c6 [table force > limit]
    + c7 sum_i [tip_i.z > height_limit] + progress (previous_error - error)
    + lift clamp(clearance / lift_height, 0, 1)).
    ``previous_error`` becomes the present error; the reset kernel starts it anew with each goal.
    """
    world = wp.tid()
    weights = params[0]
    joints = effort_in.shape[1]
    fingers = tip_pos_in.shape[1]

    position = read_vec3(world, joints, joint_q_in)
    power = wp.float32(0.0)
    for joint in range(joints):
        power += wp.abs(joint_qd_in[world, joint] * effort_in[world, joint])
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

    error = rotation_error_in[world]
    success_term = wp.where(success_in[world] != 0, weights.success, 0.0)
    rotation_term = weights.rotation / (error + weights.rotation_epsilon)
    fingertip_term = weights.fingertip * reach
    energy_term = weights.energy * power
    fall_term = wp.where(fell_in[world] != 0, weights.fall, 0.0)
    table_term = wp.where(
        table_force_in[world] > weights.table_contact_force, weights.table_contact, 0.0
    )
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
    previous_error[world] = error
