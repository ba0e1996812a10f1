"""End of episodes, resets of the state and new goals.

Order in a control step: after the reward, :func:`episode_kernel` decides what ends, then
:func:`reset_kernel` acts on the masks. Masks are int32, 0 or 1; worlds outside them keep every bit.
"""

import warp as wp

from vd.kernels.columns import read_quat
from vd.kernels.rng import next_stream
from vd.kernels.transforms import (
    PI,
    goal_beside,
    random_rotation,
    random_rotation_within,
    rotation_angle,
    rotation_difference,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class StartParams:
    """Where the object starts; an array of length 1 in device memory."""

    position: wp.vec3  # mean start position of the object, world frame [m]
    noise: float  # half width of the uniform noise on each axis of it [m]


@wp.struct
class GoalParams:
    """How goals are drawn; an array of length 1 in device memory."""

    max_angle: float  # largest angle between object and goal [rad]; all of SO(3) at >= pi
    about_vertical: int  # 1: goals turn it about the vertical, uniform in the angle; 0: any axis


@wp.kernel
def episode_kernel(
    # In:
    success_in: wp.array[int],  # [N] 1 where the goal is reached
    fell_in: wp.array[int],  # [N] 1 where the object is lost
    max_steps: int,  # length of an episode [control steps]
    ends: int,  # 1: a success ends the episode; 0: it goes on with a new goal
    # In/Out:
    step_count: wp.array[int],  # [N] control steps since the reset
    goal_steps: wp.array[int],  # [N] control steps since the goal was given
    counts: wp.array[float],  # [3] goals ended, goals reached, objects lost, of all; added to
    # Out:
    timed_out_out: wp.array[int],  # [N] 1 where the episode ends only by its length
    done_out: wp.array[int],  # [N] 1 where the return ends for the learner, time-outs too
    reset_out: wp.array[int],  # [N] 1 where the world is to be reset
    new_goal_out: wp.array[int],  # [N] 1 where only the goal is to be drawn anew
):
    """Count the step and decide what ends with it. Launch: [N].

    The learner bootstraps values where ``timed_out`` is 1, so that is 0 where the last step also
    succeeded or fell: those are real ends.
    """
    world = wp.tid()
    success = success_in[world] != 0
    fell = fell_in[world] != 0
    steps = step_count[world] + 1
    step_count[world] = steps
    goal_steps[world] = goal_steps[world] + 1

    at_end = steps >= max_steps
    reset = fell or at_end or (success and ends != 0)
    timed_out_out[world] = wp.where(at_end and not success and not fell, 1, 0)
    done_out[world] = wp.where(success or fell or at_end, 1, 0)
    if success or fell or at_end:
        wp.atomic_add(counts, 0, 1.0)
    if success:
        wp.atomic_add(counts, 1, 1.0)
    if fell:
        wp.atomic_add(counts, 2, 1.0)
    reset_out[world] = wp.where(reset, 1, 0)
    new_goal_out[world] = wp.where(success and not reset, 1, 0)


@wp.kernel
def reset_kernel(
    # Model:
    reset_q: wp.array[float],  # [D] hand joints after a reset [rad]
    start_params: wp.array[StartParams],  # [1] start of the object
    goal_params: wp.array[GoalParams],  # [1] draw of the goal
    rest_poses: wp.array2d[wp.transform],  # [N, K] poses at rest of a world's object; K = 0: none
    # In:
    reset_in: wp.array[int],  # [N] 1 where the world is reset
    new_goal_in: wp.array[int],  # [N] 1 where only the goal is drawn anew
    start_quat_in: wp.array[wp.quat],  # [N] start orientation; [0] if ``use_start_quat`` is 0
    use_start_quat: int,  # whether ``start_quat_in`` takes the place of the random orientation
    given_goal_in: wp.array[wp.quat],  # [N] goal orientation; [0] if ``use_given_goal`` is 0
    use_given_goal: int,  # whether ``given_goal_in`` takes the place of the random goal
    # In/Out:
    joint_q: wp.array2d[float],  # [N, D + 7] hand joints [rad], object position [m] and quaternion
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    joint_qd_out: wp.array2d[float],  # [N, D + 6] velocities
    smoothed_out: wp.array2d[float],  # [N, D] smoothed action
    step_count_out: wp.array[int],  # [N] control steps since the reset
    goal_steps_out: wp.array[int],  # [N] control steps since the goal was given
    goal_quat_out: wp.array[wp.quat],  # [N] goal orientation
    previous_error_out: wp.array[float],  # [N] rotation error to the new goal [rad]
    env_mask_out: wp.array[wp.bool],  # [N + 1] who is reset, for Newton; the last stays
):
    """Reset the worlds of one mask; draw a goal for those of either mask. Launch: [N].

    A reset puts the hand to ``reset_q``, the object to position + U(-noise, noise) on each axis
    with a uniform random orientation, all velocities and counters to zero. Where poses at rest are
    given, the object starts in one of them instead, turned by a random angle about the vertical
    through its origin. A goal is uniform among the orientations within max_angle of the object's
    (or turns it about the vertical only); the smoothed action starts at zero with each goal. A goal
    that is drawn is less than half a turn from the object's quaternion, not from the other one of
    its orientation; of a given one the sign is chosen so.
    """
    world = wp.tid()
    reset = reset_in[world] != 0
    env_mask_out[world] = reset
    if not reset and new_goal_in[world] == 0:
        return

    state = rng[world]
    joints = reset_q.shape[0]

    if reset:
        start = start_params[0]
        for joint in range(joints):
            joint_q[world, joint] = reset_q[joint]
        for axis in range(3):
            noise = wp.randf(state, -start.noise, start.noise)
            joint_q[world, joints + axis] = start.position[axis] + noise
        state, start_quat = random_rotation(state)
        if rest_poses.shape[1] > 0:
            rest = rest_poses[world, wp.randi(state, 0, rest_poses.shape[1])]
            for axis in range(3):
                joint_q[world, joints + axis] = wp.transform_get_translation(rest)[axis]
            yaw = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(state, -PI, PI))
            start_quat = wp.normalize(yaw * wp.transform_get_rotation(rest))
        if use_start_quat != 0:
            start_quat = start_quat_in[world]
        for i in range(4):
            joint_q[world, joints + 3 + i] = start_quat[i]
        for i in range(joints + 6):
            joint_qd_out[world, i] = 0.0
        step_count_out[world] = 0

    goal_steps_out[world] = 0
    for joint in range(joints):
        smoothed_out[world, joint] = 0.0
    orientation = read_quat(world, joints + 3, joint_q)
    draw = goal_params[0]
    state, turn = random_rotation_within(state, draw.max_angle)
    if draw.about_vertical != 0:
        angle = wp.randf(state, -draw.max_angle, draw.max_angle)
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle)
    goal = wp.normalize(turn * orientation)
    if use_given_goal != 0:
        goal = goal_beside(given_goal_in[world], orientation)
    goal_quat_out[world] = goal
    previous_error_out[world] = rotation_angle(rotation_difference(orientation, goal))
    rng[world] = next_stream(state, world)
