"""Warp without lines that scroll everything else away, and gradients that nobody takes."""

import ctypes
import os
import sys
from contextlib import suppress


def quiet_warp() -> None:
    """Keep Warp to warnings and forward kernels.

    Without a GPU driver, start it without its warning of that.

    Backward kernels are a fifth of a first start's compilation. Modules take the setting when they
    are imported, so this comes before Newton.

    Without a driver there is no CUDA context that an early start could spoil. With one Warp starts
    when it is first used, as ever. Its library writes the warning past Python, so standard error
    itself is turned away meanwhile.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    wp.config.enable_backward = False
    if _has_driver():
        return
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _has_driver() -> bool:
    """Whether the CUDA driver's library loads, by the names that Warp tries."""
    for name in ("libcuda.so", "libcuda.so.1"):
        with suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False
