"""Arrays of torch or of NumPy, for code that serves both: a robot's computer then needs no torch.

NumPy 2 and torch name most functions alike, with ``axis`` and ``keepdims``. What differs is here.
"""

from typing import Any, TypeAlias

import numpy as np
import warp as wp

Array: TypeAlias = Any
"""A tensor of torch, or on a CPU an array of NumPy."""


def library_of(array: Array) -> Any:
    """The module whose functions take an array: numpy or torch."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def as_warp(array: Array, dtype: Any = None) -> wp.array:
    """The memory of an array for Warp, of ``dtype``, such as ``wp.vec3``.

    Where it has gaps, a copy's.
    """
    if isinstance(array, np.ndarray):
        return wp.array(np.ascontiguousarray(array), dtype=dtype or Any, copy=False, device="cpu")
    wp.init()  # which ``from_torch`` alone leaves out
    return wp.from_torch(array.contiguous(), dtype=dtype)
