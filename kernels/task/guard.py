"""Detect, on the device, what would silently spoil a run: dropped contacts and non-finite states.

Launch order per control step: ``collect_overflow_kernel`` after every physics step,
``guard_kernel`` once at the end. Where a run may go on without the worlds that failed,
``put_back_kernel`` follows, and ``void_step_kernel`` after the reward.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def collect_overflow_kernel(
    # In:
    overflow_in: wp.array[wp.int32],  # [N] bit mask of the latest physics step
    mask: int,  # bits that mean lost contacts or constraint rows
    # In/Out:
    seen: wp.array[wp.int32],  # [N] bits raised since the last clearing
):
    """Remember every overflow bit of ``mask`` that any physics step raised."""
    world = wp.tid()
    bits = overflow_in[world] & mask
    if bits != 0:
        seen[world] = seen[world] | bits


@wp.kernel
def guard_kernel(
    # In:
    joint_q: wp.array2d[float],  # [N, D + 7] positions after the step
    joint_qd: wp.array2d[float],  # [N, D + 6] velocities after the step
    max_speed: float,  # speed [m/s or rad/s] that no joint or object reaches
    # In/Out:
    failures: wp.array[wp.int32],  # [N] steps that failed so far
    # Out:
    failed_out: wp.array[wp.int32],  # [N] 1 where this step failed
):
    """Flag worlds whose state is not finite or faster than ``max_speed``."""
    world = wp.tid()
    failed = wp.int32(0)
    for i in range(joint_q.shape[1]):
        if not wp.isfinite(joint_q[world, i]):
            failed = 1
    for i in range(joint_qd.shape[1]):
        if not wp.isfinite(joint_qd[world, i]) or wp.abs(joint_qd[world, i]) > max_speed:
            failed = 1
    failed_out[world] = failed
    failures[world] = failures[world] + failed


@wp.kernel
def put_back_kernel(
    # In:
    failed: wp.array[wp.int32],  # [N] 1 where this step failed
    start_q: wp.array2d[float],  # [N, D + 7] positions before the step
    last_step: int,  # control steps of an episode before its last one
    # Out:
    joint_q: wp.array2d[float],  # [N, D + 7] positions; written where it failed, like those below
    joint_qd: wp.array2d[float],  # [N, D + 6] velocities
    step_count: wp.array[wp.int32],  # [N] control steps since the reset, this one not counted
):
    """Put worlds that failed back to where the step began, at rest, in the last step of their episode."""
    world = wp.tid()
    if failed[world] == 0:
        return
    for i in range(joint_q.shape[1]):
        joint_q[world, i] = start_q[world, i]
    for i in range(joint_qd.shape[1]):
        joint_qd[world, i] = 0.0
    step_count[world] = last_step


@wp.kernel
def void_step_kernel(
    # In:
    failed: wp.array[wp.int32],  # [N] 1 where this step failed
    # Out:
    reward: wp.array[float],  # [N] reward; written where it failed, like those below
    reward_terms: wp.array2d[float],  # [N, T] its terms
    still: wp.array[wp.int32],  # [N] 1 where all of success held but the rotation's threshold
    success: wp.array[wp.int32],  # [N] 1 where the goal was reached
    fell: wp.array[wp.int32],  # [N] 1 where the object was lost
):
    """No reward, no success and no fall in worlds that failed, so that their episode only times out."""
    world = wp.tid()
    if failed[world] == 0:
        return
    reward[world] = 0.0
    for i in range(reward_terms.shape[1]):
        reward_terms[world, i] = 0.0
    still[world] = 0
    success[world] = 0
    fell[world] = 0
