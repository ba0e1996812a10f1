"""Voxels of point clouds as keys, and which voxels touch others.

A voxel is one 63-bit key: the cloud in the high bits, then the bits of x, y and z interleaved
(Morton order, x highest). Keys sort by cloud and then along a curve on which the eight voxels of
every cube of side 2, 4, 8 ... are neighbours.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

AXIS_BITS = 12
"""Bits of a coordinate: 4096 voxels about the origin, 20 m at 5 mm."""
CLOUD_SHIFT = 3 * AXIS_BITS
"""Where the number of the cloud begins in a key."""

_HALF_RANGE = wp.constant(1 << (AXIS_BITS - 1))
_AXIS_CELLS = wp.constant(1 << AXIS_BITS)
_AXIS_MASK = wp.constant(wp.int64((1 << AXIS_BITS) - 1))
_MORTON_MASK = wp.constant(wp.int64((1 << CLOUD_SHIFT) - 1))
_CLOUD_SHIFT = wp.constant(wp.int64(CLOUD_SHIFT))
_NEIGHBOURS = wp.constant(27)
# Twelve bits spread to every third place: halves, quarters, eighths and single bits move apart.
_HALVES = wp.constant(wp.int64(0x0F0000FF))
_QUARTERS = wp.constant(wp.int64(0x0F00F00F))
_PAIRS = wp.constant(wp.int64(0xC30C30C3))
_SINGLES = wp.constant(wp.int64(0x249249249))


@wp.func
def spread_bits(value: int) -> wp.int64:
    """Move bit i of ``value`` in [0, 2^12) to bit 3 i."""
    bits = wp.int64(value)
    bits = (bits | (bits << wp.int64(16))) & _HALVES
    bits = (bits | (bits << wp.int64(8))) & _QUARTERS
    bits = (bits | (bits << wp.int64(4))) & _PAIRS
    return (bits | (bits << wp.int64(2))) & _SINGLES


@wp.func
def gather_bits(value: wp.int64) -> int:
    """Undo :func:`spread_bits`, whatever is in the bits between."""
    bits = value & _SINGLES
    bits = (bits | (bits >> wp.int64(2))) & _PAIRS
    bits = (bits | (bits >> wp.int64(4))) & _QUARTERS
    bits = (bits | (bits >> wp.int64(8))) & _HALVES
    return int((bits | (bits >> wp.int64(16))) & _AXIS_MASK)


@wp.func
def key_coordinates(key: wp.int64) -> wp.vec3i:
    """Coordinates in [0, 2^12) of a key, counted from the corner of the grid."""
    return wp.vec3i(
        gather_bits(key >> wp.int64(2)), gather_bits(key >> wp.int64(1)), gather_bits(key)
    )


@wp.func
def voxel_key(cloud: wp.int64, x: int, y: int, z: int) -> wp.int64:
    """Key of a voxel, counted from the grid's corner, or -1 where it lies beyond the grid."""
    if x < 0 or y < 0 or z < 0 or x >= _AXIS_CELLS or y >= _AXIS_CELLS or z >= _AXIS_CELLS:
        return wp.int64(-1)
    morton = (spread_bits(x) << wp.int64(2)) | (spread_bits(y) << wp.int64(1)) | spread_bits(z)
    return (cloud << _CLOUD_SHIFT) | morton


@wp.kernel
def voxel_key_kernel(
    # In:
    points_in: wp.array2d[wp.vec3],  # [B, P] points [m]; not finite or out of the grid: no voxel
    voxel_size: float,  # side of a voxel [m]
    # Out:
    key_out: wp.array2d[wp.int64],  # [B, P] keys; of points that count for nothing: cloud B
):
    """Key of the voxel of each point. Launch: [B, P]."""
    cloud, point = wp.tid()
    scaled = points_in[cloud, point] / voxel_size
    reach = float(_HALF_RANGE)
    kept = wp.bool(True)
    for axis in range(3):
        # Written so that NaN is refused.
        if not (scaled[axis] >= -reach and scaled[axis] < reach):
            kept = wp.bool(False)
    key_out[cloud, point] = wp.int64(points_in.shape[0]) << _CLOUD_SHIFT
    if kept:
        x = int(wp.floor(scaled[0])) + _HALF_RANGE
        y = int(wp.floor(scaled[1])) + _HALF_RANGE
        z = int(wp.floor(scaled[2])) + _HALF_RANGE
        key_out[cloud, point] = voxel_key(wp.int64(cloud), x, y, z)


@wp.kernel
def beside_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [M] keys of voxels, each once, ascending
    other_in: wp.array[wp.bool],  # [M] which are the others
    # Out:
    beside_out: wp.array[wp.bool],  # [M] which are among the others or touch one, if by a corner
):
    """Tell of each voxel whether any of the 3x3x3 about it is one of the others. Launch: [M]."""
    row = wp.tid()
    key = key_in[row]
    cell = key_coordinates(key & _MORTON_MASK)
    found = wp.bool(other_in[row])
    k = wp.int32(0)
    while k < _NEIGHBOURS and not found:
        x, y, z = cell[0] + k // 9 - 1, cell[1] + (k // 3) % 3 - 1, cell[2] + k % 3 - 1
        wanted = voxel_key(key >> _CLOUD_SHIFT, x, y, z)
        place = wp.lower_bound(key_in, wanted)
        if place < key_in.shape[0] and key_in[place] == wanted:
            found = other_in[place]
        k += 1
    beside_out[row] = found


@wp.kernel
def coordinates_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [M] keys
    # Out:
    coordinate_out: wp.array2d[int],  # [M, 4] rows (cloud, x, y, z); coordinates may be negative
):
    """Write keys as rows. Launch: [M]."""
    row = wp.tid()
    cell = key_coordinates(key_in[row] & _MORTON_MASK)
    coordinate_out[row, 0] = int(key_in[row] >> _CLOUD_SHIFT)
    for axis in range(3):
        coordinate_out[row, axis + 1] = cell[axis] - _HALF_RANGE
