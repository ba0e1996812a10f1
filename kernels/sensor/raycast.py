"""Depth by ray casting: one ray a pixel against the bounding volume hierarchies of the meshes.

Cells are gathered in tiles, and a tile looks only at meshes whose bounds reach into it, nearest first.

Launch order: ``place_camera_kernel``, ``place_meshes_kernel``, then ``order_shapes_kernel``,
``cull_tiles_kernel``, ``raycast_kernel``, and ``finish_depth_kernel`` (:mod:`vd.kernels.sensor.depth_views`).
"""

import warp as wp

from vd.kernels.sensor.depth_views import NO_HIT, View, cell_pixel, pixel_direction

wp.set_module_options({"enable_backward": False})

TILE_COLUMNS = wp.constant(8)
TILE_ROWS = wp.constant(4)
TILE_CELLS = wp.constant(32)
"""A tile has one bit of a word, and one thread of a warp, for each of its cells."""

RAY_BLOCK = 128
"""Threads of a block of rays on a GPU. The search keeps many registers: five such blocks fit a multiprocessor
of 64 k registers almost without spilling, where two of 256 threads would without the bound."""

MAX_SHAPES = 32
"""Shapes of a world: one bit of a tile's word each."""


@wp.kernel
def order_shapes_kernel(
    # In:
    nearest_in: wp.array2d[float],
    # Out:
    order_out: wp.array2d[int],
):
    """Shapes of each world from near to far, shape [N, S]. Launch: [N, S]."""
    world, shape = wp.tid()
    mine = nearest_in[world, shape]
    rank = wp.int32(0)
    for other in range(nearest_in.shape[1]):
        theirs = nearest_in[world, other]
        if theirs < mine or (theirs == mine and other < shape):
            rank += 1
    order_out[world, rank] = shape


@wp.kernel
def cull_tiles_kernel(
    # Model:
    block: int,
    tile_columns: int,
    # In:
    window_in: wp.array2d[wp.vec4],
    order_in: wp.array2d[int],
    # Out:
    tile_shapes_out: wp.array2d[wp.uint32],
):
    """Mark the shapes that a tile has to look at. Launch: [N, T].

    Args:
        block: Pixels on a side of a cell.
        tile_columns: Tiles in a row of tiles.
        window_in: Pixels that each shape's bounds cover, shape [N, S].
        order_in: Shapes from near to far, shape [N, S].
        tile_shapes_out: Bit k is set if shape ``order_in[world, k]`` may be seen in the tile, shape [N, T].
    """
    world, tile = wp.tid()
    left = float((tile % tile_columns) * TILE_COLUMNS * block)
    top = float((tile // tile_columns) * TILE_ROWS * block)
    right = left + float(TILE_COLUMNS * block)
    bottom = top + float(TILE_ROWS * block)
    word = wp.uint32(0)
    for rank in range(order_in.shape[1]):
        window = window_in[world, order_in[world, rank]]
        if window[0] <= right and window[2] >= left and window[1] <= bottom and window[3] >= top:
            word = word | (wp.uint32(1) << wp.uint32(rank))
    tile_shapes_out[world, tile] = word


@wp.kernel(launch_bounds=(RAY_BLOCK, 5))
def raycast_kernel(
    # Model:
    views: wp.array[View],
    mesh_id: wp.array[wp.uint64],
    shape_mesh: wp.array2d[int],
    shape_scale: wp.array2d[float],
    height: int,
    width: int,
    block: int,
    tile_columns: int,
    lanes: int,
    # In:
    rotation_in: wp.array2d[wp.mat33],
    position_in: wp.array2d[wp.vec3],
    nearest_in: wp.array2d[float],
    order_in: wp.array2d[int],
    tile_shapes_in: wp.array2d[wp.uint32],
    rng_in: wp.array[wp.uint32],
    # Out:
    depth_out: wp.array3d[float],
):
    """Depth of the nearest surface through each cell. Launch: [N, T, lanes].

    The ray is cast in the mesh's own frame with a direction whose optical z is 1, so that its parameter is
    the depth, whatever the size of the mesh.

    Args:
        views: Camera of each world, shape [N].
        mesh_id: Meshes with their hierarchies, shape [M].
        shape_mesh: Mesh of each shape, shape [N, S].
        shape_scale: Size factor of each shape, shape [N, S].
        height: Rows of the image.
        width: Columns of the image.
        block: Pixels on a side of a cell.
        tile_columns: Tiles in a row of tiles.
        lanes: Threads of a tile, 1 to 32.
        rotation_in: Rotation from mesh to optical frame, shape [N, S].
        position_in: Origin of the mesh frame in the optical frame [m], shape [N, S].
        nearest_in: Depth that no point of the shape is in front of [m], shape [N, S].
        order_in: Shapes from near to far, shape [N, S].
        tile_shapes_in: Shapes that each tile has to look at, shape [N, T].
        rng_in: Random state of each world, shape [N]; not advanced.
        depth_out: Depth along the optical axis [m], NO_HIT without a surface, shape [N, R, C].
    """
    world, tile, lane = wp.tid()
    view = views[world]
    rows = depth_out.shape[1]
    columns = depth_out.shape[2]
    first_row = (tile // tile_columns) * TILE_ROWS
    first_column = (tile % tile_columns) * TILE_COLUMNS
    word = tile_shapes_in[world, tile]
    for cell in range(lane, TILE_CELLS, lanes):
        row = first_row + cell // TILE_COLUMNS
        column = first_column + cell % TILE_COLUMNS
        if row < rows and column < columns:
            pixel_row, pixel_column = cell_pixel(rng_in[world], row, column, columns, block, height, width)
            direction = pixel_direction(view, pixel_column, pixel_row)
            best = wp.float32(NO_HIT)
            remaining = word
            rank = wp.int32(0)
            while remaining != wp.uint32(0):
                if (remaining & wp.uint32(1)) != wp.uint32(0):
                    shape = order_in[world, rank]
                    if nearest_in[world, shape] > best:
                        break
                    inverse = wp.transpose(rotation_in[world, shape]) / shape_scale[world, shape]
                    hit = wp.mesh_query_ray(
                        mesh_id[shape_mesh[world, shape]],
                        -(inverse * position_in[world, shape]),
                        inverse * direction,
                        best,
                    )
                    if hit.result:
                        best = hit.t
                remaining = remaining >> wp.uint32(1)
                rank += 1
            depth_out[world, row, column] = best
