"""Point clouds to voxels: noise on each cloud, true floor, each voxel once, in a fixed order.

A voxel is one 63-bit key: the cloud in the high bits, then the bits of x, y and z interleaved (Morton
order, x highest). Keys sort by cloud and then along a curve on which the eight voxels of every cube of
side 2, 4, 8 ... are neighbours: dividing all coordinates by two, rounding down, is a shift by three
bits that keeps the order, so that coarser grids need no further sort
(:mod:`vd.kernels.sparse.coordinate_maps`).
"""

from typing import NamedTuple

import warp as wp

from vd.kernels.launch import launch
from vd.kernels.rng import next_stream, uniform

wp.set_module_options({"enable_backward": False})

AXIS_BITS = 12
"""Bits of a coordinate: 4096 voxels about the origin, 20 m at 5 mm."""
CLOUD_SHIFT = 3 * AXIS_BITS
"""Where the number of the cloud begins in a key."""
MAX_CLOUDS = 2 ** (63 - CLOUD_SHIFT) - 2
"""Clouds of a batch at most; the next number marks points that count for nothing."""

_HALF_RANGE = wp.constant(1 << (AXIS_BITS - 1))
_AXIS_MASK = wp.constant(wp.int64((1 << AXIS_BITS) - 1))
_MORTON_MASK = wp.constant(wp.int64((1 << CLOUD_SHIFT) - 1))
_CLOUD_SHIFT = wp.constant(wp.int64(CLOUD_SHIFT))
# Twelve bits spread to every third place: halves, quarters, eighths and single bits move apart.
_HALVES = wp.constant(wp.int64(0x0F0000FF))
_QUARTERS = wp.constant(wp.int64(0x0F00F00F))
_PAIRS = wp.constant(wp.int64(0xC30C30C3))
_SINGLES = wp.constant(wp.int64(0x249249249))


@wp.struct
class CloudNoise:
    """Augmentation of point clouds."""

    jitter_probability: float  # share of clouds with jitter
    jitter_std: float  # standard deviation of the jitter of each coordinate of a point [m]
    dropout_probability: float  # share of clouds that lose points, independently
    dropout_ratio: wp.vec2  # lowest and highest probability with which a point of these is lost


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
    return wp.vec3i(gather_bits(key >> wp.int64(2)), gather_bits(key >> wp.int64(1)), gather_bits(key))


@wp.kernel
def draw_noise_kernel(
    # In:
    noise_in: wp.array[CloudNoise],  # [1] what to draw
    # In/Out:
    rng: wp.array[wp.uint32],  # [B] random stream of each cloud
    # Out:
    jitter_out: wp.array[float],  # [B] standard deviation of the jitter [m]; 0 for none
    dropout_out: wp.array[float],  # [B] probability with which a point is lost; 0 for none
    stream_out: wp.array[wp.uint32],  # [B] seed of the cloud's points
):
    """Draw the noise of each cloud from its own stream, so that no two clouds share it. Launch: [B]."""
    cloud = wp.tid()
    noise = noise_in[0]
    state = rng[cloud]
    jitter = wp.float32(0.0)
    if wp.randf(state) < noise.jitter_probability:
        jitter = noise.jitter_std
    lost = wp.randf(state)
    state, ratio = uniform(state, noise.dropout_ratio)
    if lost >= noise.dropout_probability:
        ratio = wp.float32(0.0)
    jitter_out[cloud] = jitter
    dropout_out[cloud] = ratio
    stream_out[cloud] = wp.randu(state)
    rng[cloud] = next_stream(state, cloud)


@wp.kernel
def voxel_key_kernel(
    # In:
    points_in: wp.array2d[wp.vec3],  # [B, P] points [m]; what is not finite or out of the grid is no voxel
    voxel_size: float,  # side of a voxel [m]
    jitter_in: wp.array[float],  # [B] standard deviation of the jitter [m]; null for no noise at all
    dropout_in: wp.array[float],  # [B] probability with which each cloud's points are lost, or null
    stream_in: wp.array[wp.uint32],  # [B] seed of each cloud's points, or null
    # Out:
    key_out: wp.array[wp.int64],  # [>= B P] keys; those of points that count for nothing name cloud B
):
    """Key of the voxel of each point. Launch: [B, P]."""
    cloud, point = wp.tid()
    position = points_in[cloud, point]
    kept = wp.bool(True)
    if jitter_in:
        # A counter-based draw: the same whatever the number of threads.
        state = wp.rand_init(int(stream_in[cloud]), point)
        kept = wp.randf(state) >= dropout_in[cloud]
        jitter = jitter_in[cloud]
        if jitter > 0.0:
            position += jitter * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
    scaled = position / voxel_size
    reach = float(_HALF_RANGE)
    for axis in range(3):
        # Written so that NaN is refused.
        if not (scaled[axis] >= -reach and scaled[axis] < reach):
            kept = wp.bool(False)
    if kept:
        x = int(wp.floor(scaled[0])) + _HALF_RANGE
        y = int(wp.floor(scaled[1])) + _HALF_RANGE
        z = int(wp.floor(scaled[2])) + _HALF_RANGE
        morton = (spread_bits(x) << wp.int64(2)) | (spread_bits(y) << wp.int64(1)) | spread_bits(z)
        key_out[cloud * points_in.shape[1] + point] = (wp.int64(cloud) << _CLOUD_SHIFT) | morton
    else:
        key_out[cloud * points_in.shape[1] + point] = wp.int64(points_in.shape[0]) << _CLOUD_SHIFT


@wp.kernel
def point_group_kernel(
    # In:
    end_in: wp.array[int],  # [C] columns at which the groups end, one after the other
    points: int,  # P
    # Out:
    group_out: wp.array[int],  # [>= B P] groups, C for points after the last
):
    """Group of each point by its column. Launch: [B, P]."""
    cloud, point = wp.tid()
    group = wp.int32(0)
    while group < end_in.shape[0] and point >= end_in[group]:
        group += 1
    group_out[cloud * points + point] = group


@wp.kernel
def voxel_mark_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [>= K] sorted keys of points
    limit: wp.int64,  # keys from here on are ignored
    run_in: wp.array[int],  # [K] place of each key among the voxels, counted from 1
    group_in: wp.array[int],  # [>= K] group of each point, in the order of the keys
    # Out:
    mark_out: wp.array2d[float],  # [M, C] 1 where a voxel holds a point of the group; the others stay
):
    """Mark the voxel of each point with the point's group. Launch: [K].

    Points of a voxel write the same value, so their order does not matter.
    """
    i = wp.tid()
    if key_in[i] < limit and group_in[i] < mark_out.shape[1]:
        mark_out[run_in[i] - 1, group_in[i]] = 1.0


@wp.kernel
def run_start_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [>= K] sorted keys
    limit: wp.int64,  # keys from here on are ignored
    shift: wp.int64,  # bits by which keys are shifted to the right before they are compared
    # Out:
    start_out: wp.array[int],  # [K] marks
):
    """Mark where a run of equal sorted keys begins: 1 there, 0 elsewhere. Launch: [K]."""
    i = wp.tid()
    start_out[i] = 0
    if key_in[i] < limit and (i == 0 or key_in[i] >> shift != key_in[i - 1] >> shift):
        start_out[i] = 1


@wp.kernel
def keep_starts_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [>= K] sorted keys
    limit: wp.int64,  # keys from here on are ignored
    shift: wp.int64,  # bits by which keys are shifted to the right
    run_in: wp.array[int],  # [K] inclusive sum of the marks of :func:`run_start_kernel`
    # Out:
    key_out: wp.array[wp.int64],  # [M] keys, each once, ascending
):
    """Keep the (shifted) key of each run. Launch: [K]."""
    i = wp.tid()
    if key_in[i] < limit:
        run = run_in[i] - 1
        if i == 0 or run_in[i - 1] == run:
            key_out[run] = key_in[i] >> shift


@wp.kernel
def cloud_offset_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [M] sorted keys
    cloud_shift: wp.int64,  # where the number of the cloud begins in a key
    # Out:
    offset_out: wp.array[int],  # [B + 1] rows
):
    """First voxel of each cloud among sorted keys, and the number of all. Launch: [B + 1]."""
    cloud = wp.tid()
    first = wp.int64(cloud) << cloud_shift
    low = wp.int32(0)
    high = wp.int32(key_in.shape[0])
    while low < high:
        middle = (low + high) // 2
        if key_in[middle] < first:
            low = middle + 1
        else:
            high = middle
    offset_out[cloud] = low


@wp.kernel
def coordinates_kernel(
    # In:
    key_in: wp.array[wp.int64],  # [M] keys
    level: int,  # how often the grid was halved: coordinates count cells of 2^level voxels
    # Out:
    coordinate_out: wp.array2d[int],  # [M, 4] rows; coordinates may be negative
):
    """Write keys as rows (cloud, x, y, z). Launch: [M]."""
    site = wp.tid()
    key = key_in[site]
    corner = _HALF_RANGE >> level
    cell = key_coordinates(key & (_MORTON_MASK >> wp.int64(3 * level)))
    coordinate_out[site, 0] = int(key >> (_CLOUD_SHIFT - wp.int64(3 * level)))
    for axis in range(3):
        coordinate_out[site, axis + 1] = cell[axis] - corner


class NoiseDraw(NamedTuple):
    """Noise of the clouds of one batch, as :func:`draw_noise_kernel` draws it, shape [B] each."""

    jitter: wp.array
    """Standard deviation of the jitter [m]."""
    dropout: wp.array
    """Probability with which a point is lost."""
    stream: wp.array
    """Seed of each cloud's points."""


def draw_noise(noise: wp.array, rng: wp.array) -> NoiseDraw:
    """Draw the noise of each cloud of a batch from its stream, which advances.

    Args:
        noise: One :class:`CloudNoise`, shape [1].
        rng: Random stream of each cloud, shape [B].
    """
    draw = NoiseDraw(*(wp.empty(rng.shape, dtype=t, device=rng.device) for t in (float, float, wp.uint32)))
    launch(draw_noise_kernel, rng.shape, [noise, rng], draw)
    return draw


def unique_keys(
    keys: wp.array, count: int, *, limit: int, shift: int = 0, kept: int | None = None
) -> tuple[wp.array, wp.array]:
    """Each of the first ``count`` sorted keys once, ascending.

    Args:
        keys: Sorted keys, shape [>= count].
        count: K.
        limit: Keys from here on are ignored.
        shift: Bits by which keys are shifted to the right.
        kept: M, where it is known; else the device is waited for.

    Returns:
        The keys [M], and for each key given its place among them, counted from 1 [K].
    """
    run = wp.empty(count, dtype=int, device=keys.device)
    if count == 0:
        return wp.empty(0, dtype=wp.int64, device=keys.device), run
    read = [keys, wp.int64(limit), wp.int64(shift)]
    launch(run_start_kernel, count, read, [run])
    wp.utils.array_scan(run, run, inclusive=True)
    if kept is None:
        kept = int(run[count - 1 :].numpy()[0])
    unique = wp.empty(kept, dtype=wp.int64, device=keys.device)
    launch(keep_starts_kernel, count, [*read, run], [unique])
    return unique, run


def voxelise(
    points: wp.array, voxel_size: float, noise: NoiseDraw | None = None, ends: wp.array | None = None
) -> tuple[wp.array, wp.array]:
    """Voxels of a batch of clouds, each once, ascending, and what the points in each are samples of.

    The order depends on the voxels alone, not on that of the points.

    Args:
        points: Points [m], shape [B, P]; those that are not finite or out of the grid are left out.
        voxel_size: Side of a voxel [m].
        noise: Noise to add first; none by default.
        ends: Columns of ``points`` at which groups end, one after the other, ascending, int32, shape [C];
            points after the last are of none; None marks nothing.

    Returns:
        Keys, shape [M], and marks: 1 where a voxel holds a point of the group, else 0, float, shape [M, C].

    Raises:
        ValueError: The voxel size is not positive, or there are too many points or clouds.
    """
    clouds, per_cloud = points.shape
    count, device = clouds * per_cloud, points.device
    if not voxel_size > 0.0:
        raise ValueError(f"voxel_size = {voxel_size} must be positive")
    if clouds > MAX_CLOUDS or 2 * count >= 2**31:
        raise ValueError(f"{clouds} clouds of {per_cloud} points are too many at once; give fewer")
    keys = wp.empty(2 * count, dtype=wp.int64, device=device)  # the second half is for the sort
    launch(voxel_key_kernel, points.shape, [points, voxel_size, *(noise or [None] * 3)], [keys])
    groups = wp.empty(2 * count, dtype=int, device=device)  # sorted along; of no meaning without ends
    if ends is not None:
        launch(point_group_kernel, points.shape, [ends, per_cloud], [groups])
    wp.utils.radix_sort_pairs(keys, groups, count, end_bit=CLOUD_SHIFT + clouds.bit_length())
    limit = clouds << CLOUD_SHIFT
    voxels, run = unique_keys(keys, count, limit=limit)
    marks = wp.zeros((voxels.shape[0], 0 if ends is None else ends.shape[0]), dtype=float, device=device)
    if ends is not None:
        launch(voxel_mark_kernel, count, [keys, wp.int64(limit), run, groups], [marks])
    return voxels, marks


def cloud_offsets(keys: wp.array, clouds: int, level: int = 0) -> wp.array:
    """First voxel of each cloud, and the number of all, shape [B + 1], for sorted keys of a level."""
    offsets = wp.empty(clouds + 1, dtype=int, device=keys.device)
    launch(cloud_offset_kernel, clouds + 1, [keys, wp.int64(CLOUD_SHIFT - 3 * level)], [offsets])
    return offsets


def coordinates(keys: wp.array, level: int = 0) -> wp.array:
    """Rows (cloud, x, y, z) of keys of a level, shape [M, 4]."""
    rows = wp.empty((keys.shape[0], 4), dtype=int, device=keys.device)
    launch(coordinates_kernel, keys.shape, [keys, level], [rows])
    return rows
