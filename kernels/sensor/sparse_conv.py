"""What sparse convolutions read: rows of neighbouring cells, and what points a voxel holds.

A cell of level l is a cube of 2^l voxels a side. Its key is that of its first voxel
(:mod:`vd.kernels.sensor.voxels`), the last 3 l bits zero. So keys of all levels sort alike, their
coordinates count voxels, and one kernel makes every map between levels.
"""

from typing import Any

import warp as wp

from vd.kernels.sensor.voxels import CLOUD_SHIFT, key_coordinates, voxel_key

wp.set_module_options({"enable_backward": False})

KERNEL = 27
"""Weights of a 3x3x3 kernel; offset k is (k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1)."""

_KERNEL = wp.constant(KERNEL)
_MORTON_MASK = wp.constant(wp.int64((1 << CLOUD_SHIFT) - 1))
_CLOUD_SHIFT = wp.constant(wp.int64(CLOUD_SHIFT))


@wp.kernel
def kernel_map_kernel(
    # In:
    output_key_in: wp.array[wp.int64],  # [M] keys of the cells for which rows are looked up
    input_key_in: wp.array[wp.int64],  # [F] keys of the cells that are read, each once, ascending
    step: int,  # voxels between the offsets of the kernel
    # Out:
    table_out: wp.array2d[int],  # [M, 27] row of the cell at each offset, F where there is none
):
    """Find the cells under a 3x3x3 kernel about each cell. Launch: [M].

    Of one level and itself with the level's step: a convolution of stride 1 (submanifold). Of a
    coarse level reading a fine one with the fine step: stride 2, input = 2 output + offset. The
    other way round with the same step: the outputs of that at each input, offsets reversed.
    """
    row = wp.tid()
    count = input_key_in.shape[0]
    for k in range(_KERNEL):
        table_out[row, k] = count
    key = output_key_in[row]
    cell = key_coordinates(key & _MORTON_MASK)
    # The kernel lies in eight blocks of two steps a side, and keys of a block are neighbours.
    side = 2 * step
    size = wp.int64(side * side * side)
    low = wp.vec3i(0)
    for axis in range(3):
        low[axis] = (cell[axis] - step) & -side
    for block in range(8):
        x = low[0] + side * (block & 1)
        y = low[1] + side * ((block >> 1) & 1)
        z = low[2] + side * (block >> 2)
        start = voxel_key(key >> _CLOUD_SHIFT, x, y, z)
        if start >= wp.int64(0):
            place = wp.lower_bound(input_key_in, start)
            while place < count and input_key_in[place] < start + size:
                offset = key_coordinates(input_key_in[place] & _MORTON_MASK) - cell
                if wp.max(wp.abs(offset)) <= step:
                    offset = offset / step
                    tap = 9 * offset[0] + 3 * offset[1] + offset[2]
                    table_out[row, _KERNEL // 2 + tap] = place
                place += 1


@wp.kernel
def voxel_feature_kernel(
    # In:
    points_in: wp.array2d[wp.vec3],  # [B, P] points [m]
    kind_in: wp.array[int],  # [P] kind of each column of points, from 0 to below C
    order_in: wp.array[wp.int64],  # [K] points in the order of their keys: cloud * P + column
    start_in: wp.array[wp.int64],  # [M + 1] first of each voxel's points in that order, and the end
    voxel_size: float,  # side of a voxel [m]
    # Out:
    feature_out: wp.array2d[float],  # [M, 4 C] of each kind: 1 if a point is there, mean place
):
    """Tell what points a voxel holds, and where in it, from its middle [voxels]. Launch: [M, C].

    Sums go in the order of the points, so equal clouds give equal features.
    """
    row, kind = wp.tid()
    count = wp.float32(0.0)
    total = wp.vec3(0.0)
    for i in range(int(start_in[row]), int(start_in[row + 1])):
        point = int(order_in[i])
        column = point % points_in.shape[1]
        if kind_in[column] == kind:
            scaled = points_in[point // points_in.shape[1], column] / voxel_size
            for axis in range(3):
                total[axis] += scaled[axis] - wp.floor(scaled[axis]) - 0.5
            count += 1.0
    feature_out[row, 4 * kind] = wp.min(count, 1.0)
    for axis in range(3):
        feature_out[row, 4 * kind + 1 + axis] = total[axis] / wp.max(count, 1.0)


@wp.kernel
def gather_rows_kernel(
    # In:
    rows_in: wp.array2d[Any],  # [F, W] rows of words
    table_in: wp.array[int],  # [E] rows to take
    # Out:
    rows_out: wp.array2d[Any],  # [E, W] these rows
):
    """Copy rows, a thread for each word. Launch: [E, W]."""
    entry, word = wp.tid()
    rows_out[entry, word] = rows_in[table_in[entry], word]
