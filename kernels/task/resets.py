"""End of episodes, resets of the state and new goals.

Order in a control step: after the reward, :func:`episode_kernel` decides what ends, then
:func:`reset_kernel` acts on its masks. Masks are int32, 0 or 1; worlds outside them keep every bit.
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
    """Where the object starts; an array of length 1 in device memory.

    position: Mean start position of the object, world frame [m].
    noise: Half width of the uniform noise on each axis of it [m].
    """

    position: wp.vec3
    noise: float


@wp.struct
class GoalParams:
    """How goals are drawn; an array of length 1 in device memory.

    max_angle: Largest angle between the object's orientation and its goal [rad]; all of SO(3) at >= pi.
    about_vertical: 1 if goals only turn the object about the vertical, uniform in the angle; 0 for any axis.
    """

    max_angle: float
    about_vertical: int


@wp.kernel
def episode_kernel(
    # In:
    success_in: wp.array[int],
    fell_in: wp.array[int],
    max_steps: int,
    hold: int,
    # In/Out:
    step_count: wp.array[int],
    goal_steps: wp.array[int],
    counts: wp.array[float],
    # Out:
    timed_out_out: wp.array[int],
    done_out: wp.array[int],
    reset_out: wp.array[int],
    new_goal_out: wp.array[int],
):
    """Count the step and decide what ends with it. Launch: [N].

    The learner bootstraps values where ``timed_out`` is 1, so that is 0 where the last step also
    succeeded or fell: those are real ends.

    Args:
        success_in: 1 where the goal is reached, shape [N].
        fell_in: 1 where the object is lost, shape [N].
        max_steps: Length of an episode [control steps].
        hold: 0: a success gives a new goal and the episode goes on (training); 1: it ends the episode
            (evaluation).
        step_count: Control steps since the reset, shape [N].
        goal_steps: Control steps since the goal was given, shape [N].
        counts: Goals ended, goals reached and objects lost, over all environments, shape [3]; added to.
        timed_out_out: 1 where the episode ends only by its length, shape [N].
        done_out: 1 where the return ends for the learner: success, fall or time-out, shape [N].
        reset_out: 1 where the world is to be reset, shape [N].
        new_goal_out: 1 where only the goal is to be drawn anew, shape [N].
    """
    world = wp.tid()
    success = success_in[world] != 0
    fell = fell_in[world] != 0
    steps = step_count[world] + 1
    step_count[world] = steps
    goal_steps[world] = goal_steps[world] + 1

    at_end = steps >= max_steps
    reset = fell or at_end or (success and hold != 0)
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
    reset_q: wp.array[float],
    start_params: wp.array[StartParams],
    goal_params: wp.array[GoalParams],
    rest_poses: wp.array2d[wp.transform],
    # In:
    reset_in: wp.array[int],
    new_goal_in: wp.array[int],
    start_quat_in: wp.array[wp.quat],
    use_start_quat: int,
    given_goal_in: wp.array[wp.quat],
    use_given_goal: int,
    # In/Out:
    joint_q: wp.array2d[float],
    rng: wp.array[wp.uint32],
    # Out:
    joint_qd_out: wp.array2d[float],
    smoothed_out: wp.array2d[float],
    step_count_out: wp.array[int],
    goal_steps_out: wp.array[int],
    goal_quat_out: wp.array[wp.quat],
    previous_error_out: wp.array[float],
    env_mask_out: wp.array[wp.bool],
):
    """Reset the worlds of one mask; draw a goal for those of either mask. Launch: [N].

    A reset puts the hand to ``reset_q``, the object to position + U(-noise, noise) on each axis with a
    uniform random orientation, all velocities and counters to zero. Where poses at rest are given, the
    object starts in one of them instead, turned by a random angle about the vertical through its origin.
    A goal is uniform among the orientations within max_angle of the object's (or turns it about the
    vertical only); the smoothed action starts at zero with each goal. A goal that is drawn is less than half
    a turn from the object's quaternion, not from the other one of its orientation; of a given one the sign is
    chosen so.

    Args:
        reset_q: Hand joints after a reset [rad], shape [D].
        start_params: Start of the object, shape [1].
        goal_params: Draw of the goal, shape [1].
        rest_poses: Poses in which each world's object lies at rest, world frame, shape [N, K]; K = 0: none.
        reset_in: 1 where the world is reset, shape [N].
        new_goal_in: 1 where only the goal is drawn anew, shape [N].
        start_quat_in: Start orientation of the object, read if ``use_start_quat`` is not 0, shape [N] or [0].
        use_start_quat: Whether ``start_quat_in`` takes the place of the random orientation.
        given_goal_in: Goal orientation, read if ``use_given_goal`` is not 0, shape [N] or [0].
        use_given_goal: Whether ``given_goal_in`` takes the place of the random goal.
        joint_q: Hand joints [rad], object position [m] and quaternion, shape [N, D + 7].
        rng: Random stream of each world, shape [N].
        joint_qd_out: Velocities, shape [N, D + 6].
        smoothed_out: Smoothed action, shape [N, D].
        step_count_out: Control steps since the reset, shape [N].
        goal_steps_out: Control steps since the goal was given, shape [N].
        goal_quat_out: Goal orientation, shape [N].
        previous_error_out: Rotation error to the new goal [rad], shape [N].
        env_mask_out: Whether each environment is reset, as Newton wants it, shape [N + 1]; the last entry, of
            what is in no environment, stays.
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


@wp.kernel
def give_goal_kernel(
    # In:
    given_goal_in: wp.array[wp.quat],
    joint_q_in: wp.array2d[float],
    object_column: int,
    # Out:
    goal_quat_out: wp.array[wp.quat],
    goal_steps_out: wp.array[int],
):
    """Give goals from outside to worlds as they are. Launch: [N].

    Args:
        given_goal_in: Wanted orientations, shape [N].
        joint_q_in: Hand joints [rad], object position [m] and quaternion, shape [N, D + 7].
        object_column: Column of the object's quaternion.
        goal_quat_out: Goal orientation with the sign that :func:`reset_kernel` gives it, shape [N].
        goal_steps_out: Control steps since the goal was given: 0, shape [N].
    """
    world = wp.tid()
    orientation = read_quat(world, object_column, joint_q_in)
    goal_quat_out[world] = goal_beside(given_goal_in[world], orientation)
    goal_steps_out[world] = 0
