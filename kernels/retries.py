"""Trying again: a hand that holds an object still, but not where it is wanted, opens and begins anew."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class RetryParams:
    """Settings of retries; an array of length 1 in device memory.

    beyond: Distance from the goal above which a hand that is still is stuck [rad].
    joint_speed: Norm of the joint velocities up to which a hand counts as still [rad/s].
    still_steps: Control steps in a row for which it has to be so.
    open_steps: Control steps for which it then opens.
    step_rad: Joint increment of an action of 1 [rad per control step].
    """

    beyond: float
    joint_speed: float
    still_steps: int
    open_steps: int
    step_rad: float


@wp.kernel
def retry_kernel(
    # Model:
    open_q: wp.array[float],
    params: wp.array[RetryParams],
    # In:
    action_in: wp.array2d[float],
    joint_q_in: wp.array2d[float],
    joint_qd_in: wp.array2d[float],
    distance_in: wp.array[float],
    predicted_in: wp.array[float],
    step_count_in: wp.array[int],
    # In/Out:
    still: wp.array[int],
    opening: wp.array[int],
    # Out:
    action_out: wp.array2d[float],
):
    """Replace the actions of hands that are stuck by actions towards the open hand. Launch: [N].

    A hand is stuck once it has been still for ``still_steps`` control steps in a row, each farther than
    ``beyond`` from the goal. It then opens for ``open_steps``, whatever happens, and acts again. Both counts
    begin anew with the episode.

    Args:
        open_q: Joint positions of the open hand [rad], shape [D].
        params: Settings, shape [1].
        action_in: Action of the policy, joints in the world's order, shape [N, D].
        joint_q_in: Joint positions as measured [rad], shape [N, *].
        joint_qd_in: Joint velocities as measured [rad/s], shape [N, *].
        distance_in: Angle to the goal [rad], shape [N].
        predicted_in: The same as a student predicts it, negative where there is no prediction: then
            ``distance_in`` counts, shape [N].
        step_count_in: Control steps since the reset, shape [N].
        still: Control steps for which the hand has been still and far, shape [N].
        opening: Control steps for which it still opens, shape [N].
        action_out: Action to apply, shape [N, D].
    """
    world = wp.tid()
    settings = params[0]
    joints = open_q.shape[0]
    waited = still[world]
    left = opening[world]
    if step_count_in[world] == 0:
        waited = 0
        left = 0
    if left == 0:
        square = wp.float32(0.0)
        for joint in range(joints):
            square += joint_qd_in[world, joint] * joint_qd_in[world, joint]
        distance = wp.where(predicted_in[world] >= 0.0, predicted_in[world], distance_in[world])
        stuck = distance > settings.beyond and square <= settings.joint_speed * settings.joint_speed
        waited = wp.where(stuck, waited + 1, 0)
        if waited >= settings.still_steps:
            waited = 0
            left = settings.open_steps
    for joint in range(joints):
        towards = (open_q[joint] - joint_q_in[world, joint]) / settings.step_rad
        action_out[world, joint] = wp.where(left > 0, wp.clamp(towards, -1.0, 1.0), action_in[world, joint])
    still[world] = waited
    opening[world] = wp.max(left - 1, 0)
