"""What joints told in the last control steps, the one sense of a policy that sees no object."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def push_history_kernel(
    # In:
    state_in: wp.array2d[float],  # [N, *] observation of the state
    position: int,  # column of the first joint position in it
    action: int,  # column of the first previous action
    joints: int,  # D
    steps: int,  # H
    fresh: wp.array[wp.int32],  # [N] 1 where the past begins with this step
    first: int,  # column of the first value of the history
    # In/Out:
    history: wp.array2d[float],  # [N, *] H steps of D positions and D actions, the oldest first
):
    """Drop the oldest step and append the present one; a fresh past is the present all along.

    The action is the one whose target the joints have followed since the step before: with the
    position then it tells that target. Launch: [N, 2 D].
    """
    world, value = wp.tid()
    column = wp.where(value < joints, position + value, action + value - joints)
    now = state_in[world, column]
    for step in range(steps):
        place = first + 2 * joints * step + value
        kept = now
        if step < steps - 1 and fresh[world] == 0:
            kept = history[world, place + 2 * joints]
        history[world, place] = kept
