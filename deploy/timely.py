"""Running in time: before other programs, and without pauses of the interpreter."""

import contextlib
import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

TURN_S = 1e-4
"""Longest turn of a thread of this process while another one waits: less than what a packet
takes.
"""


@contextlib.contextmanager
def undisturbed(before_all: bool) -> Iterator[bool]:
    """Run without the garbage collector and long turns of other threads, before other programs.

    The collector pauses for a second where there is much; a run makes little. A thread that waits
    for the interpreter, as after every packet, waits for whoever has it: 5 ms by default. Before
    all ordinary programs run all threads, those that begin later too, where the system permits it
    (root, ``ulimit -r 1``): the watchdog must not wait for other programs. The loop mostly sleeps.

    Args:
        before_all: Whether to try that.

    Yields:
        Whether it does.
    """
    turn_s = sys.getswitchinterval()
    sys.setswitchinterval(TURN_S)
    gc.collect()
    gc.freeze()
    gc.disable()
    before: dict[int, tuple[int, os.sched_param]] = {}
    if before_all:
        # Not Linux, or not permitted.
        with contextlib.suppress(AttributeError, FileNotFoundError, PermissionError):
            priority = os.sched_param(os.sched_get_priority_min(os.SCHED_RR))
            for entry in Path("/proc/self/task").iterdir():
                thread = int(entry.name)
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    usual = os.sched_getscheduler(thread), os.sched_getparam(thread)
                    os.sched_setscheduler(thread, os.SCHED_RR, priority)
                    before[thread] = usual
    try:
        yield bool(before)
    finally:
        for thread, usual in before.items():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(thread, *usual)
        sys.setswitchinterval(turn_s)
        gc.enable()
        gc.unfreeze()
