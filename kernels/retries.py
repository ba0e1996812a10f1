"""Trying again: a hand that brings its object no nearer to where it is wanted opens and begins anew."""

import warp as wp

wp.set_module_options({"enable_backward": False})

ANY_DISTANCE = 100.0
"""A distance that every other one improves on [rad]."""


@wp.struct
class RetryParams:
    """Settings of retries; an array of length 1 in device memory.

    beyond: Distance from the goal above which a hand can be stuck [rad].
    progress: By how much the least distance has to fall to count as progress [rad].
    patience: Control steps without progress after which a hand is stuck.
    open_steps: Control steps for which it then opens.
    step_rad: Joint increment of an action of 1 [rad per control step].
    """

    beyond: float
    progress: float
    patience: int
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
    distance_in: wp.array[float],
    predicted_in: wp.array[float],
    step_count_in: wp.array[int],
    new_goal_in: wp.array[int],
    # In/Out:
    least: wp.array[float],
    waited: wp.array[int],
    opening: wp.array[int],
    # Out:
    action_out: wp.array2d[float],
):
    """Replace the actions of hands that are stuck by actions towards the open hand. Launch: [N].

    A hand is stuck once it has been farther than ``beyond`` from the goal for ``patience`` control steps in a
    row and its least distance has not fallen by ``progress`` meanwhile. It then opens for ``open_steps``,
    whatever happens, and begins anew, as it does with each episode and each goal.

    Args:
        open_q: Joint positions of the open hand [rad], shape [D].
        params: Settings, shape [1].
        action_in: Action of the policy, joints in the world's order, shape [N, D].
        joint_q_in: Joint positions as measured [rad], shape [N, *].
        distance_in: Angle to the goal [rad], shape [N].
        predicted_in: The same as a student predicts it, negative where there is no prediction: then
            ``distance_in`` counts, shape [N].
        step_count_in: Control steps since the reset, shape [N].
        new_goal_in: 1 where the goal is new, shape [N].
        least: Least distance since it began [rad], shape [N].
        waited: Control steps since that fell, shape [N].
        opening: Control steps for which the hand still opens, shape [N].
        action_out: Action to apply, shape [N, D].
    """
    world = wp.tid()
    settings = params[0]
    nearest = least[world]
    count = waited[world]
    left = opening[world]
    if step_count_in[world] == 0 or new_goal_in[world] != 0:
        nearest = ANY_DISTANCE
        count = 0
        left = 0
    if left == 0:
        distance = wp.where(predicted_in[world] >= 0.0, predicted_in[world], distance_in[world])
        count += 1
        if distance <= settings.beyond or distance <= nearest - settings.progress:
            nearest = distance
            count = 0
        if count >= settings.patience:
            nearest = ANY_DISTANCE
            count = 0
            left = settings.open_steps
    for joint in range(open_q.shape[0]):
        towards = (open_q[joint] - joint_q_in[world, joint]) / settings.step_rad
        action_out[world, joint] = wp.where(left > 0, wp.clamp(towards, -1.0, 1.0), action_in[world, joint])
    least[world] = nearest
    waited[world] = count
    opening[world] = wp.max(left - 1, 0)
