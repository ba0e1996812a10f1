"""The teacher's observation: state of hand and object, goal, previous action, with sensor noise.

World frame (z up), metres, radians, quaternions xyzw. G fingers, D joints; O = 3 D + 13 G + 21
values: of the paper's hands, with three joints a finger, 19 G + 21 and the previous action.
"""

import warp as wp

from vd.kernels.columns import consecutive, read_quat, read_vec3, write_quat, write_vec3
from vd.kernels.rng import next_stream
from vd.kernels.transforms import canonical, rotation_difference

wp.set_module_options({"enable_backward": False})

FINGERTIP_VALUES = 13
"""Position 3, quaternion 4, linear velocity 3, angular velocity 3."""


def teacher_observation_slices(fingers: int, joints: int) -> dict[str, slice]:
    """Columns of each part of the observation, in order, for a hand of so many fingers and joints in all."""
    sizes = {
        "joint_position": joints,
        "joint_velocity": joints,
        "object_position": 3,
        "object_orientation": 4,
        "object_velocity": 3,
        "object_spin": 3,
        "goal_orientation": 4,
        "relative_orientation": 4,
        "fingertips": FINGERTIP_VALUES * fingers,
        "previous_action": joints,
    }
    return consecutive(sizes)


def teacher_observation_size(fingers: int, joints: int) -> int:
    """Number of values in the observation: 3 D + 13 G + 21."""
    return teacher_observation_slices(fingers, joints)["previous_action"].stop


@wp.struct
class ObservationParams:
    """Settings of the observation; an array of length 1 in device memory."""

    velocity_scale: float  # factor on joint velocities and on the object's angular velocity
    noise_mean: float  # mean of the noise on measured values, in their units
    noise_std: float  # standard deviation of that noise, independent in every value and step
    file_axes: float  # 1: orientations in the axes of the object's file are seen; 0: zeros
    canonical: float  # whether orientations and the rotation between them are canonical: 1 or 0


@wp.func
def fingertip_pose(body_q: wp.transform, tip_offset: wp.transform) -> wp.transform:
    """Pose of a fingertip frame in the world frame."""
    return wp.transform_multiply(body_q, tip_offset)


@wp.kernel
def fingertip_kernel(
    # Model:
    tip_body: wp.array[int],  # [G] link of each fingertip, an index within a world
    tip_offset: wp.array[wp.transform],  # [G] fingertip frame in the frame of its link
    # In:
    body_q_in: wp.array2d[wp.transform],  # [N, B] link poses in the world frame
    # Out:
    tip_pos_out: wp.array2d[wp.vec3],  # [N, G] fingertip positions [m]
):
    """Positions of the fingertips in the world frame. Launch: [N, G]."""
    world, finger = wp.tid()
    tip = fingertip_pose(body_q_in[world, tip_body[finger]], tip_offset[finger])
    tip_pos_out[world, finger] = wp.transform_get_translation(tip)


@wp.kernel
def teacher_observation_kernel(
    # Model:
    joint_lower: wp.array[float],  # [D] lower joint limits [rad]
    joint_upper: wp.array[float],  # [D] upper joint limits [rad]
    tip_body: wp.array[int],  # [G] link of each fingertip, an index within a world
    tip_offset: wp.array[wp.transform],  # [G] fingertip frame in the frame of its link
    body_com: wp.array[wp.vec3],  # [B] centre of mass of each link in its frame [m]
    params: wp.array[ObservationParams],  # [1] settings
    # In:
    measured_q_in: wp.array2d[float],  # [N, *] positions of the hand's joints as reported [rad]
    measured_qd_in: wp.array2d[float],  # [N, *] velocities of the hand's joints likewise [rad/s]
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    joint_qd_in: wp.array2d[float],  # [N, D + 6] velocities: joints, object [m/s], its spin [rad/s]
    body_q_in: wp.array2d[wp.transform],  # [N, B] link poses in the world frame
    body_qd_in: wp.array2d[wp.spatial_vector],  # [N, B] link velocities: mass centre, angular
    goal_quat_in: wp.array[wp.quat],  # [N] wanted orientation of the object
    smoothed_in: wp.array2d[float],  # [N, D] previous (smoothed) action
    observation_offset_in: wp.array2d[float],  # [N, O] constant error of each measured value
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    observation_out: wp.array2d[float],  # [N, O] observation
):
    """Observation of the teacher, columns as in :func:`teacher_observation_slices`. Launch: [N].

    Joint positions are mapped from [lower, upper] to [-1, 1]; the relative orientation is
    q_object * conj(q_goal). Every measured value gets N(noise_mean, noise_std) + offset; the goal
    and the previous action are known exactly and get neither. Without ``file_axes`` the
    orientations of object and goal are zeros, without noise. With ``canonical`` the three do not
    tell a quaternion q from -q, the same rotation (:func:`vd.kernels.transforms.canonical`, before
    noise).
    """
    world = wp.tid()
    settings = params[0]
    joints = joint_lower.shape[0]

    for joint in range(joints):
        span = joint_upper[joint] - joint_lower[joint]
        above = measured_q_in[world, joint] - joint_lower[joint]
        observation_out[world, joint] = 2.0 * above / span - 1.0
        observation_out[world, joints + joint] = (
            settings.velocity_scale * measured_qd_in[world, joint]
        )

    position = read_vec3(world, joints, joint_q_in)
    orientation = read_quat(world, joints + 3, joint_q_in)
    velocity = read_vec3(world, joints, joint_qd_in)
    spin = read_vec3(world, joints + 3, joint_qd_in)
    goal = goal_quat_in[world]
    turn = rotation_difference(orientation, goal)
    if settings.canonical != 0.0:
        orientation = canonical(orientation)
        goal = canonical(goal)
        turn = canonical(turn)

    column = write_vec3(world, 2 * joints, position, observation_out)
    object_begin = column
    column = write_quat(world, column, orientation, observation_out)
    column = write_vec3(world, column, velocity, observation_out)
    column = write_vec3(world, column, settings.velocity_scale * spin, observation_out)
    goal_begin = column
    column = write_quat(world, column, goal, observation_out)
    goal_end = column
    column = write_quat(world, column, turn, observation_out)

    for finger in range(tip_body.shape[0]):
        body = tip_body[finger]
        pose = body_q_in[world, body]
        twist = body_qd_in[world, body]
        tip = fingertip_pose(pose, tip_offset[finger])
        tip_position = wp.transform_get_translation(tip)
        angular = wp.spatial_bottom(twist)
        arm = tip_position - wp.transform_point(pose, body_com[body])
        linear = wp.spatial_top(twist) + wp.cross(angular, arm)
        column = write_vec3(world, column, tip_position, observation_out)
        column = write_quat(world, column, wp.transform_get_rotation(tip), observation_out)
        column = write_vec3(world, column, linear, observation_out)
        column = write_vec3(world, column, angular, observation_out)

    measured_end = column
    for joint in range(joints):
        observation_out[world, measured_end + joint] = smoothed_in[world, joint]

    state = rng[world]
    for i in range(measured_end):
        if i < goal_begin or i >= goal_end:
            error = settings.noise_mean + observation_offset_in[world, i]
            if settings.noise_std > 0.0:
                error += settings.noise_std * wp.randn(state)
            observation_out[world, i] = observation_out[world, i] + error
    if settings.file_axes == 0.0:
        write_quat(world, object_begin, wp.quat(0.0, 0.0, 0.0, 0.0), observation_out)
        write_quat(world, goal_begin, wp.quat(0.0, 0.0, 0.0, 0.0), observation_out)
    rng[world] = next_stream(state, world)
