"""Actions of the policy to joint targets, and the actuator limits that the solver does not apply.

Order in a control step: :func:`apply_action_kernel` once, then :func:`limit_joint_velocity_kernel`
after every physics step, then :func:`joint_effort_kernel` once for the energy reward. Arrays ``[N,
*]`` hold at least D columns, the D hand joints first.
"""

import warp as wp

from vd.kernels.rng import next_stream

wp.set_module_options({"enable_backward": False})


@wp.struct
class ActionParams:
    """Settings of the action; an array of length 1 in device memory."""

    alpha: float  # weight of the new action in the moving average, in (0, 1]
    step_rad: float  # joint increment of a smoothed action of 1 [rad per control step]
    noise_std: float  # standard deviation of the noise added to the action, in action units


@wp.kernel
def apply_action_kernel(
    # Model:
    joint_lower: wp.array[float],  # [D] lower joint limits [rad]
    joint_upper: wp.array[float],  # [D] upper joint limits [rad]
    params: wp.array[ActionParams],  # [1] settings
    # In:
    action_in: wp.array2d[float],  # [N, D] action of the policy
    action_offset_in: wp.array2d[float],  # [N, D] constant error of each actuator in action units
    joint_q_in: wp.array2d[float],  # [N, *] joint positions as measured [rad]
    # In/Out:
    smoothed: wp.array2d[float],  # [N, D] moving average of the applied action
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    refused: wp.array[wp.int32],  # [N] actions so far that were not finite
    # Out:
    joint_target_out: wp.array2d[float],  # [N, *] position targets [rad], D columns are written
):
    """Turn actions into joint position targets (paper, Methods, action space). Launch: [N].

    a = clip(action + N(0, noise_std) + offset, -1, 1); smoothed = alpha a + (1 - alpha) smoothed;
    target = clamp(q + smoothed step_rad, lower, upper), relative to the joint's present position.
    An action that is not finite is refused as a whole, for a clip would make a number of it: the
    target is where the joint is, and the average stays.
    """
    world = wp.tid()
    settings = params[0]
    state = rng[world]
    finite = wp.bool(True)
    for joint in range(joint_lower.shape[0]):
        if not wp.isfinite(action_in[world, joint]):
            finite = False
    if not finite:
        refused[world] = refused[world] + 1
    for joint in range(joint_lower.shape[0]):
        action = action_in[world, joint] + action_offset_in[world, joint]
        if settings.noise_std > 0.0:
            action += settings.noise_std * wp.randn(state)
        action = wp.clamp(action, -1.0, 1.0)
        average = settings.alpha * action + (1.0 - settings.alpha) * smoothed[world, joint]
        step = average * settings.step_rad
        if finite:
            smoothed[world, joint] = average
        else:
            step = 0.0
        joint_target_out[world, joint] = wp.clamp(
            joint_q_in[world, joint] + step,
            joint_lower[joint],
            joint_upper[joint],
        )
    rng[world] = next_stream(state, world)


@wp.kernel
def limit_joint_velocity_kernel(
    # Model:
    velocity_limit: wp.array[float],  # [D] velocity limits [rad/s]
    # In:
    dt: float,  # physics time step [s]
    joint_q_prev_in: wp.array2d[float],  # [N, *] joint positions before the step [rad]
    # In/Out:
    joint_q: wp.array2d[float],  # [N, *] joint positions after the step [rad]
    joint_qd: wp.array2d[float],  # [N, *] joint velocities after the step [rad/s]
):
    """Hold hand joints to their velocity limits after one physics step. Launch: [N, D].

    Where norm(qd) > limit: qd = sign(qd) limit and q = q_prev + qd dt. The solver integrates
    q = q_prev + qd dt too, so the joint stops short on the way it was going and cannot leave its
    position limits by it. Other joints are untouched.
    """
    world, joint = wp.tid()
    speed = joint_qd[world, joint]
    limit = velocity_limit[joint]
    if wp.abs(speed) > limit:
        limited = wp.sign(speed) * limit
        joint_qd[world, joint] = limited
        joint_q[world, joint] = joint_q_prev_in[world, joint] + limited * dt


@wp.kernel
def joint_effort_kernel(
    # Model:
    effort_limit: wp.array[float],  # [D] torque limits [N m]
    kp_in: wp.array2d[float],  # [N, D] stiffness [N m/rad]
    kd_in: wp.array2d[float],  # [N, D] damping [N m s/rad]
    # In:
    joint_target_in: wp.array2d[float],  # [N, *] position targets [rad]
    joint_q_in: wp.array2d[float],  # [N, *] joint positions [rad]
    joint_qd_in: wp.array2d[float],  # [N, *] joint velocities [rad/s]
    # Out:
    effort_out: wp.array2d[float],  # [N, D] joint torques [N m]
):
    """Torque of the position servo at the present state: clamp(kp (target - q) - kd qd, +-limit).

    Launch: [N, D].
    """
    world, joint = wp.tid()
    error = joint_target_in[world, joint] - joint_q_in[world, joint]
    torque = kp_in[world, joint] * error - kd_in[world, joint] * joint_qd_in[world, joint]
    limit = effort_limit[joint]
    effort_out[world, joint] = wp.clamp(torque, -limit, limit)
