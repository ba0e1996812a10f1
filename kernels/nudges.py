"""Randomness where a policy is caught: nudges where its object stands still, noise while its goal is far."""

import warp as wp

from vd.kernels.rng import next_stream

wp.set_module_options({"enable_backward": False})

UNKNOWN = -1.0
"""A distance that is none [rad]."""


@wp.struct
class NudgeParams:
    """Settings of nudges; an array of length 1 in device memory.

    beyond: Distance from the goal above which an object that stands still is stuck [rad].
    still: Change of the distance up to which it stands still [rad per control step].
    still_steps: Control steps in a row for which it has to.
    nudge_steps: Control steps for which the hand is then moved.
    std: Standard deviation of the action by which it is moved.
    """

    beyond: float
    still: float
    still_steps: int
    nudge_steps: int
    std: float


@wp.kernel
def nudge_kernel(
    # Model:
    params: wp.array[NudgeParams],
    # In:
    action_in: wp.array2d[float],
    distance_in: wp.array[float],
    predicted_in: wp.array[float],
    step_count_in: wp.array[int],
    new_goal_in: wp.array[int],
    # In/Out:
    last: wp.array[float],
    waited: wp.array[int],
    left: wp.array[int],
    kick: wp.array2d[float],
    rng: wp.array[wp.uint32],
    # Out:
    action_out: wp.array2d[float],
):
    """Replace the actions of hands that are stuck by random ones. Launch: [N].

    A hand is stuck once its object has been farther than ``beyond`` from the goal and has stood still for
    ``still_steps`` control steps in a row. One action, N(0, std) for each joint and clipped, then takes the
    policy's place for ``nudge_steps``, whatever happens. Both counts begin anew with each episode and goal.

    Args:
        params: Settings, shape [1].
        action_in: Action of the policy, shape [N, D].
        distance_in: Angle to the goal [rad], shape [N].
        predicted_in: The same as a student predicts it, negative where there is no prediction: then
            ``distance_in`` counts, shape [N].
        step_count_in: Control steps since the reset, shape [N].
        new_goal_in: 1 where the goal is new, shape [N].
        last: Distance at the last control step [rad], ``UNKNOWN`` before the first, shape [N].
        waited: Control steps for which the hand has been stuck, shape [N].
        left: Control steps of the nudge that are left, shape [N].
        kick: Action of the latest nudge, shape [N, D].
        rng: Random stream of each world, shape [N].
        action_out: Action to apply, shape [N, D].
    """
    world = wp.tid()
    settings = params[0]
    distance = wp.where(predicted_in[world] >= 0.0, predicted_in[world], distance_in[world])
    before = last[world]
    count = waited[world]
    nudges = left[world]
    if step_count_in[world] == 0 or new_goal_in[world] != 0:
        before = UNKNOWN
        count = 0
        nudges = 0
    if nudges == 0:
        still = before >= 0.0 and wp.abs(distance - before) <= settings.still
        count = wp.where(still and distance > settings.beyond, count + 1, 0)
        if count >= settings.still_steps:
            count = 0
            nudges = settings.nudge_steps
            state = rng[world]
            for joint in range(action_in.shape[1]):
                kick[world, joint] = wp.clamp(settings.std * wp.randn(state), -1.0, 1.0)
            rng[world] = next_stream(state, world)
    for joint in range(action_in.shape[1]):
        action_out[world, joint] = wp.where(nudges > 0, kick[world, joint], action_in[world, joint])
    last[world] = distance
    waited[world] = count
    left[world] = wp.max(nudges - 1, 0)


@wp.kernel
def explore_kernel(
    # Model:
    beyond: float,
    std: float,
    # In:
    action_in: wp.array2d[float],
    distance_in: wp.array[float],
    predicted_in: wp.array[float],
    # In/Out:
    rng: wp.array[wp.uint32],
    # Out:
    action_out: wp.array2d[float],
):
    """Add noise to the actions of hands whose goal is far. Launch: [N].

    N(0, std) for each joint, and clipped to [-1, 1]; other actions stay as they are.

    Args:
        beyond: Distance from the goal above which it is far [rad].
        std: Standard deviation of the noise.
        action_in: Action of the policy, shape [N, D].
        distance_in: Angle to the goal [rad], shape [N].
        predicted_in: The same as a student predicts it, negative where there is no prediction: then
            ``distance_in`` counts, shape [N].
        rng: Random stream of each world, shape [N].
        action_out: Action to apply, shape [N, D]; may be ``action_in``.
    """
    world = wp.tid()
    distance = wp.where(predicted_in[world] >= 0.0, predicted_in[world], distance_in[world])
    state = rng[world]
    for joint in range(action_in.shape[1]):
        action = action_in[world, joint]
        if distance > beyond:
            action = wp.clamp(action + std * wp.randn(state), -1.0, 1.0)
        action_out[world, joint] = action
    rng[world] = next_stream(state, world)
