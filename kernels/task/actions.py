"""Actions of the policy to joint targets, and the actuator limits that the solver does not apply.

Order in a control step: :func:`apply_action_kernel` once, then :func:`limit_joint_velocity_kernel`
after every physics step, then :func:`joint_effort_kernel` once for the energy reward.
Arrays ``[N, *]`` hold at least D columns, the D hand joints first.
"""

import warp as wp

from vd.kernels.rng import next_stream

wp.set_module_options({"enable_backward": False})


@wp.struct
class ActionParams:
    """Settings of the action; an array of length 1 in device memory.

    alpha: Weight of the new action in the moving average, in (0, 1].
    step_rad: Joint increment of a smoothed action of 1 [rad per control step].
    noise_std: Standard deviation of the noise added to the action, in action units.
    """

    alpha: float
    step_rad: float
    noise_std: float


@wp.kernel
def apply_action_kernel(
    # Model:
    joint_lower: wp.array[float],
    joint_upper: wp.array[float],
    params: wp.array[ActionParams],
    # In:
    action_in: wp.array2d[float],
    action_offset_in: wp.array2d[float],
    joint_q_in: wp.array2d[float],
    # In/Out:
    smoothed: wp.array2d[float],
    rng: wp.array[wp.uint32],
    # Out:
    joint_target_out: wp.array2d[float],
):
    """Turn actions into joint position targets (paper, Methods, action space). Launch: [N].

    a = clip(action + N(0, noise_std) + offset, -1, 1); smoothed = alpha a + (1 - alpha) smoothed;
    target = clamp(q + smoothed step_rad, lower, upper), relative to the joint's present position.

    Args:
        joint_lower: Lower joint limits [rad], shape [D].
        joint_upper: Upper joint limits [rad], shape [D].
        params: Settings, shape [1].
        action_in: Action of the policy, shape [N, D].
        action_offset_in: Constant error of each actuator in action units, shape [N, D].
        joint_q_in: Joint positions as measured [rad], shape [N, *].
        smoothed: Moving average of the applied action, shape [N, D].
        rng: Random stream of each world, shape [N].
        joint_target_out: Joint position targets [rad], shape [N, *]; the first D columns are written.
    """
    world = wp.tid()
    settings = params[0]
    state = rng[world]
    for joint in range(joint_lower.shape[0]):
        action = action_in[world, joint] + action_offset_in[world, joint]
        if settings.noise_std > 0.0:
            action += settings.noise_std * wp.randn(state)
        action = wp.clamp(action, -1.0, 1.0)
        average = settings.alpha * action + (1.0 - settings.alpha) * smoothed[world, joint]
        smoothed[world, joint] = average
        joint_target_out[world, joint] = wp.clamp(
            joint_q_in[world, joint] + average * settings.step_rad, joint_lower[joint], joint_upper[joint]
        )
    rng[world] = next_stream(state, world)


@wp.kernel
def limit_joint_velocity_kernel(
    # Model:
    velocity_limit: wp.array[float],
    # In:
    dt: float,
    joint_q_prev_in: wp.array2d[float],
    # In/Out:
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
):
    """Hold hand joints to their velocity limits after one physics step. Launch: [N, D].

    Where norm(qd) > limit: qd = sign(qd) limit and q = q_prev + qd dt. The solver integrates
    q = q_prev + qd dt too, so the joint stops short on the way it was going and cannot leave its
    position limits by it. Other joints are untouched.

    Args:
        velocity_limit: Velocity limits [rad/s], shape [D].
        dt: Physics time step [s].
        joint_q_prev_in: Joint positions before the step [rad], shape [N, *].
        joint_q: Joint positions after the step [rad], shape [N, *].
        joint_qd: Joint velocities after the step [rad/s], shape [N, *].
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
    effort_limit: wp.array[float],
    kp_in: wp.array2d[float],
    kd_in: wp.array2d[float],
    # In:
    joint_target_in: wp.array2d[float],
    joint_q_in: wp.array2d[float],
    joint_qd_in: wp.array2d[float],
    # Out:
    effort_out: wp.array2d[float],
):
    """Torque of the position servo at the present state: clamp(kp (target - q) - kd qd, +-limit).

    Launch: [N, D].

    Args:
        effort_limit: Torque limits [N m], shape [D].
        kp_in: Stiffness [N m/rad], shape [N, D].
        kd_in: Damping [N m s/rad], shape [N, D].
        joint_target_in: Position targets [rad], shape [N, *].
        joint_q_in: Joint positions [rad], shape [N, *].
        joint_qd_in: Joint velocities [rad/s], shape [N, *].
        effort_out: Joint torques [N m], shape [N, D].
    """
    world, joint = wp.tid()
    error = joint_target_in[world, joint] - joint_q_in[world, joint]
    torque = kp_in[world, joint] * error - kd_in[world, joint] * joint_qd_in[world, joint]
    limit = effort_limit[joint]
    effort_out[world, joint] = wp.clamp(torque, -limit, limit)
