"""Detect, on the device, what would silently spoil a run: dropped contacts and non-finite states.

Launch order per control step: ``collect_overflow_kernel`` after every physics step,
``guard_kernel`` once at the end. Where a run may go on without the worlds that failed, ``put_back_kernel``
follows, and ``void_step_kernel`` after the reward.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def collect_overflow_kernel(
    # In:
    overflow_in: wp.array[wp.int32],
    mask: int,
    # In/Out:
    seen: wp.array[wp.int32],
):
    """Remember every overflow bit of ``mask`` that any physics step raised.

    Args:
        overflow_in: Bit mask of the latest physics step, shape [N].
        mask: Bits that mean lost contacts or constraint rows.
        seen: Bits raised since the last clearing, shape [N].
    """
    world = wp.tid()
    bits = overflow_in[world] & mask
    if bits != 0:
        seen[world] = seen[world] | bits


@wp.kernel
def guard_kernel(
    # In:
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    start_q: wp.array2d[float],
    start_qd: wp.array2d[float],
    target: wp.array2d[float],
    max_speed: float,
    # In/Out:
    failures: wp.array[wp.int32],
    dump_q: wp.array2d[float],
    dump_qd: wp.array2d[float],
    dump_target: wp.array2d[float],
    # Out:
    failed_out: wp.array[wp.int32],
):
    """Flag worlds whose state is not finite or faster than ``max_speed``; keep the last good start.

    The dump of a world is overwritten every control step as long as it is good, and frozen at the
    start of the first control step that failed, so that this step can be replayed.

    Args:
        joint_q: Positions after the step, shape [N, D + 7].
        joint_qd: Velocities after the step, shape [N, D + 6].
        start_q: Positions before the step, shape [N, D + 7].
        start_qd: Velocities before the step, shape [N, D + 6].
        target: Joint targets of the step, shape [N, T].
        max_speed: Speed [m/s or rad/s] that no joint or object reaches.
        failures: Steps that failed so far, shape [N].
        dump_q: Positions before the first step that failed, shape [N, D + 7].
        dump_qd: Velocities before it, shape [N, D + 6].
        dump_target: Joint targets of it, shape [N, T].
        failed_out: 1 where this step failed, shape [N].
    """
    world = wp.tid()
    failed = wp.int32(0)
    for i in range(joint_q.shape[1]):
        if not wp.isfinite(joint_q[world, i]):
            failed = 1
    for i in range(joint_qd.shape[1]):
        if not wp.isfinite(joint_qd[world, i]) or wp.abs(joint_qd[world, i]) > max_speed:
            failed = 1
    failed_out[world] = failed
    before = failures[world]
    failures[world] = before + failed
    if before != 0:
        return
    for i in range(dump_q.shape[1]):
        dump_q[world, i] = start_q[world, i]
    for i in range(dump_qd.shape[1]):
        dump_qd[world, i] = start_qd[world, i]
    for i in range(dump_target.shape[1]):
        dump_target[world, i] = target[world, i]


@wp.kernel
def put_back_kernel(
    # In:
    failed: wp.array[wp.int32],
    start_q: wp.array2d[float],
    last_step: int,
    # Out:
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    step_count: wp.array[wp.int32],
):
    """Put worlds that failed back to where the step began, at rest, in the last step of their episode.

    Args:
        failed: 1 where this step failed, shape [N].
        start_q: Positions before the step, shape [N, D + 7].
        last_step: Control steps of an episode before its last one.
        joint_q: Positions, shape [N, D + 7]; written where it failed, like those below.
        joint_qd: Velocities, shape [N, D + 6].
        step_count: Control steps since the reset, this one not counted, shape [N].
    """
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
    failed: wp.array[wp.int32],
    # Out:
    reward: wp.array[float],
    reward_terms: wp.array2d[float],
    still: wp.array[wp.int32],
    success: wp.array[wp.int32],
    fell: wp.array[wp.int32],
):
    """No reward, no success and no fall in worlds that failed, so that their episode only times out.

    Args:
        failed: 1 where this step failed, shape [N].
        reward: Reward, shape [N]; written where it failed, like those below.
        reward_terms: Its terms, shape [N, T].
        still: 1 where all of success held but the rotation's threshold, shape [N].
        success: 1 where the goal was reached, shape [N].
        fell: 1 where the object was lost, shape [N].
    """
    world = wp.tid()
    if failed[world] == 0:
        return
    reward[world] = 0.0
    for i in range(reward_terms.shape[1]):
        reward_terms[world, i] = 0.0
    still[world] = 0
    success[world] = 0
    fell[world] = 0
