"""Running in time: before other programs, and without pauses of the interpreter."""

import contextlib
import gc
import os
from collections.abc import Iterator
from typing import Literal

Priority = Literal["auto", "on", "off"]
"""Real-time priority: where it is permitted, always, or never."""


@contextlib.contextmanager
def real_time(wanted: Priority, *, level: int = 0) -> Iterator[bool]:
    """Run before all ordinary programs, as loop and twin need it on a busy machine; both mostly sleep.

    Args:
        wanted: Whether to.
        level: Above the lowest real-time priority. A twin's is higher than the loop's, as motors' processors
            do not wait for ours.

    Yields:
        Whether it does.

    Raises:
        OSError: It is wanted, but the system does not have it, or does not permit it.
    """
    try:
        if wanted == "off":
            raise PermissionError("off")
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        priority = os.sched_param(os.sched_get_priority_min(os.SCHED_RR) + level)
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, priority)
    except (AttributeError, PermissionError) as error:
        if wanted == "on":
            raise OSError(
                f"no real-time priority ({error}); on Linux allow it with `ulimit -r 1`, or leave it out"
            ) from error
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, *before)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Without the garbage collector, which pauses for a second where there is much; a run makes little."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
