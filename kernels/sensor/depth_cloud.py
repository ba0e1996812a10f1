"""From a depth image to a point cloud.

Crop by height, choose a fixed number of points, carry to the base.

Pixels are gathered in tiles, which have a bit of a word for each of theirs. Launch order:
``crop_pixels_kernel``, ``count_points_kernel``, ``choose_points_kernel``.
"""

import warp as wp

from vd.kernels.rng import next_stream
from vd.kernels.sensor.raycast import View, pixel_direction

wp.set_module_options({"enable_backward": False})

TILE_COLUMNS = wp.constant(8)
TILE_ROWS = wp.constant(4)
TILE_PIXELS = wp.constant(32)
"""A tile has one bit of a word for each of its pixels."""


@wp.func
def last_not_above(value: int, world: int, start: int, end: int, sums: wp.array2d[int]) -> int:
    """Last of ``sums[world, start:end]``, which does not fall, that is not above ``value``."""
    low = start
    high = end
    while high - low > 1:
        middle = (low + high) // 2
        if sums[world, middle] <= value:
            low = middle
        else:
            high = middle
    return low


@wp.kernel
def crop_pixels_kernel(
    # Model:
    views: wp.array[View],  # [N] camera of each world
    lowest: float,  # least height of a point in the world frame [m]
    highest: float,  # largest height [m]
    tile_columns: int,  # tiles in a row of tiles
    # In:
    camera_q_in: wp.array[wp.transform],  # [N] optical frames in the world frame
    depth_in: wp.array3d[float],  # [N, H, W] depth [m], 0 for none
    # Out:
    tile_pixels_out: wp.array2d[wp.uint32],  # [N, T] bit k: the tile's pixel k is within the crop
    tile_first_out: wp.array2d[int],  # [N, T] points before each tile in its row of tiles
    row_count_out: wp.array2d[int],  # [N, T / tile_columns] points of each row of tiles
):
    """Mark the pixels whose point lies within the crop.

    Launch: [N, T / tile_columns], the rows of tiles.
    """
    world, tile_row = wp.tid()
    view = views[world]
    camera_q = camera_q_in[world]
    # Height of a point: the third row of the camera's rotation by the point, above the eye.
    up = wp.quat_rotate_inv(wp.transform_get_rotation(camera_q), wp.vec3(0.0, 0.0, 1.0))
    eye_height = wp.transform_get_translation(camera_q)[2]
    rows = depth_in.shape[1]
    columns = depth_in.shape[2]
    count = wp.int32(0)
    for tile_column in range(tile_columns):
        tile = tile_row * tile_columns + tile_column
        tile_first_out[world, tile] = count
        word = wp.uint32(0)
        for pixel in range(TILE_PIXELS):
            row = tile_row * TILE_ROWS + pixel // TILE_COLUMNS
            column = tile_column * TILE_COLUMNS + pixel % TILE_COLUMNS
            if row < rows and column < columns:
                depth = depth_in[world, row, column]
                if depth > 0.0:
                    above = wp.dot(up, pixel_direction(view, column, row)) * depth + eye_height
                    if above >= lowest and above <= highest:
                        word = word | (wp.uint32(1) << wp.uint32(pixel))
                        count += 1
        tile_pixels_out[world, tile] = word
    row_count_out[world, tile_row] = count


@wp.kernel
def count_points_kernel(
    # Model:
    capacity: int,  # points of a cloud at most, K
    # In:
    row_count_in: wp.array2d[int],  # [N, Y] points of each row of tiles
    # Out:
    row_first_out: wp.array2d[int],  # [N, Y] points before each row of tiles
    available_out: wp.array[int],  # [N] points within the crop
    count_out: wp.array[int],  # [N] points of the cloud
):
    """Number the points of each world. Launch: [N]."""
    world = wp.tid()
    total = wp.int32(0)
    for tile_row in range(row_count_in.shape[1]):
        row_first_out[world, tile_row] = total
        total += row_count_in[world, tile_row]
    available_out[world] = total
    count_out[world] = wp.min(total, capacity)


@wp.kernel
def choose_points_kernel(
    # Model:
    views: wp.array[View],  # [N] camera of each world
    tile_columns: int,  # tiles in a row of tiles
    # In:
    extrinsics_in: wp.array[wp.transform],  # [N] optical frame in the hand's base
    rng_in: wp.array[wp.uint32],  # [N] random state of each world; not advanced
    depth_in: wp.array3d[float],  # [N, H, W] depth [m], 0 for none
    tile_pixels_in: wp.array2d[wp.uint32],  # [N, T] pixels within the crop, a bit each
    tile_first_in: wp.array2d[int],  # [N, T] points before each tile in its row of tiles
    row_first_in: wp.array2d[int],  # [N, Y] points before each row of tiles
    available_in: wp.array[int],  # [N] points within the crop
    # Out:
    points_out: wp.array2d[wp.vec3],  # [N, K] points in the frame of the camera's body [m]
):
    """Choose points at random, evenly over the image and each at most once. Launch: [N, K].

    With V points and room for K < V, thread k takes a random one of those from k V / K to (k + 1) V
    / K. With V <= K all are taken, in order, and the rows beyond are NaN.
    """
    world, k = wp.tid()
    capacity = points_out.shape[1]
    available = available_in[world]
    if k >= available:
        points_out[world, k] = wp.vec3(wp.nan, wp.nan, wp.nan)
        return
    rows = depth_in.shape[1]
    columns = depth_in.shape[2]
    wanted = k
    if available > capacity:
        # 64 bits: k times the pixels of a large image does not fit 32.
        start = int(wp.int64(k) * wp.int64(available) // wp.int64(capacity))
        end = int(wp.int64(k + 1) * wp.int64(available) // wp.int64(capacity))
        # Streams of the pixels come first.
        rng = wp.rand_init(int(rng_in[world]), rows * columns + k)
        wanted = wp.randi(rng, start, end)

    tile_row = last_not_above(wanted, world, 0, row_first_in.shape[1], row_first_in)
    wanted -= row_first_in[world, tile_row]
    first = tile_row * tile_columns
    tile = last_not_above(wanted, world, first, first + tile_columns, tile_first_in)
    wanted -= tile_first_in[world, tile]
    word = tile_pixels_in[world, tile]
    chosen = wp.int32(0)
    for pixel in range(TILE_PIXELS):
        if (word & (wp.uint32(1) << wp.uint32(pixel))) != wp.uint32(0):
            if wanted == 0:
                chosen = pixel
            wanted -= 1

    row = tile_row * TILE_ROWS + chosen // TILE_COLUMNS
    column = (tile % tile_columns) * TILE_COLUMNS + chosen % TILE_COLUMNS
    seen = pixel_direction(views[world], column, row) * depth_in[world, row, column]
    points_out[world, k] = wp.transform_point(extrinsics_in[world], seen)


@wp.kernel
def next_frame_kernel(
    # In/Out:
    rng: wp.array[wp.uint32],
):
    """Advance the random state of each world, shape [N], past this frame's draws. Launch: [N]."""
    world = wp.tid()
    state = rng[world]
    wp.randu(state)  # else the next frame's state would be that of one of this frame's pixels
    rng[world] = next_stream(state, world)
