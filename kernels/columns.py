"""Vectors and quaternions in consecutive columns of a row.

How joint states and observations are laid out.
"""

from itertools import accumulate

import warp as wp

wp.set_module_options({"enable_backward": False})


def consecutive(sizes: dict[str, int]) -> dict[str, slice]:
    """Columns of parts of so many values each, one after the other from 0 on."""
    ends = accumulate(sizes.values())
    return {
        name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)
    }


@wp.func
def read_vec3(row: int, column: int, values: wp.array2d[float]) -> wp.vec3:
    """Three values from ``values[row, column:]``."""
    return wp.vec3(values[row, column], values[row, column + 1], values[row, column + 2])


@wp.func
def read_quat(row: int, column: int, values: wp.array2d[float]) -> wp.quat:
    """A quaternion xyzw from ``values[row, column:]``."""
    return wp.quat(
        values[row, column],
        values[row, column + 1],
        values[row, column + 2],
        values[row, column + 3],
    )


@wp.func
def write_vec3(row: int, column: int, value: wp.vec3, out: wp.array2d[float]) -> int:
    """Write three values to ``out[row, column:]``; returns the next free column."""
    for i in range(3):
        out[row, column + i] = value[i]
    return column + 3


@wp.func
def write_quat(row: int, column: int, value: wp.quat, out: wp.array2d[float]) -> int:
    """Write xyzw to ``out[row, column:]``; returns the next free column."""
    for i in range(4):
        out[row, column + i] = value[i]
    return column + 4
