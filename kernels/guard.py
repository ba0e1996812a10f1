"""Detect, on the device, what would silently spoil a run: dropped contacts and non-finite states.

Launch order per control step: ``collect_overflow_kernel`` after every physics step,
``guard_kernel`` once at the end.
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
    bad: wp.array[wp.int32],
    dump_q: wp.array2d[float],
    dump_qd: wp.array2d[float],
    dump_target: wp.array2d[float],
):
    """Flag worlds whose state is not finite or faster than ``max_speed``; keep the last good start.

    The dump of a world is overwritten every control step as long as it is good, and frozen at the
    start of the control step that went bad, so that this step can be replayed.

    Args:
        joint_q: Positions after the step, shape [N, D + 7].
        joint_qd: Velocities after the step, shape [N, D + 6].
        start_q: Positions before the step, shape [N, D + 7].
        start_qd: Velocities before the step, shape [N, D + 6].
        target: Joint targets of the step, shape [N, T].
        max_speed: Speed [m/s or rad/s] that no joint or object reaches.
        bad: 1 where the state went bad (sticky), shape [N].
        dump_q: Positions before the bad step, shape [N, D + 7].
        dump_qd: Velocities before the bad step, shape [N, D + 6].
        dump_target: Joint targets of the bad step, shape [N, T].
    """
    world = wp.tid()
    if bad[world] != 0:
        return
    failed = wp.int32(0)
    for i in range(joint_q.shape[1]):
        if not wp.isfinite(joint_q[world, i]):
            failed = 1
    for i in range(joint_qd.shape[1]):
        if not wp.isfinite(joint_qd[world, i]) or wp.abs(joint_qd[world, i]) > max_speed:
            failed = 1
    bad[world] = failed
    for i in range(dump_q.shape[1]):
        dump_q[world, i] = start_q[world, i]
    for i in range(dump_qd.shape[1]):
        dump_qd[world, i] = start_qd[world, i]
    for i in range(dump_target.shape[1]):
        dump_target[world, i] = target[world, i]
