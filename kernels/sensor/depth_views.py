"""What ray casting and rasterisation share: where meshes and cameras are, and the table.

Frames: *optical* is the camera's (x right, y down, z forward); depth is z of that frame, along the optical
axis, not along the ray. Pixel (column, row) is seen along its centre, (column + 0.5, row + 0.5); the
principal point is measured from the top left corner of the image. Metres, quaternions xyzw.

Depth is found for *cells*: square blocks of pixels, of which one is looked at. Blocks of one pixel give the
image; larger ones give a random pixel of each block, which can be all that a point cloud needs.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

NO_HIT = wp.constant(1.0e9)
"""Depth of nothing while the nearest surface is looked for [m]."""

EMPTY = wp.constant(0.0)
"""Depth in a finished image where nothing was measured."""

TINY = wp.constant(1.0e-9)
"""Stands in for a zero component of a direction, so that its reciprocal is finite."""


@wp.struct
class View:
    """A pinhole camera: focal lengths and principal point [pixel], nearest and farthest depth [m].

    What is nearer than the range is opaque, but has no depth.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    far: float


@wp.func
def pixel_direction(view: View, column: int, row: int) -> wp.vec3:
    """Direction through the centre of a pixel in the optical frame, z = 1: times depth it is the point."""
    return wp.vec3(
        (float(column) + 0.5 - view.cx) / view.fx,
        (float(row) + 0.5 - view.cy) / view.fy,
        1.0,
    )


@wp.func
def cell_pixel(seed: wp.uint32, row: int, column: int, columns: int, block: int, height: int, width: int):
    """Pixel ``(row, column)`` through which a cell's ray goes: its only one, or a random one of its block.

    Args:
        seed: Random state of the world in this frame; the same state gives the same pixel.
        row: Row of the cell.
        column: Column of the cell.
        columns: Cells in a row.
        block: Pixels on a side of a cell.
        height: Rows of the image.
        width: Columns of the image.
    """
    if block == 1:
        return row, column
    rng = wp.rand_init(int(seed), row * columns + column)
    pixel_row = row * block + wp.randi(rng, 0, wp.min(block, height - row * block))
    pixel_column = column * block + wp.randi(rng, 0, wp.min(block, width - column * block))
    return pixel_row, pixel_column


@wp.func
def box_depth(origin: wp.vec3, direction: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> float:
    """Multiple of ``direction`` at which a ray enters a box; NO_HIT if it misses or starts inside."""
    enter = wp.float32(0.0)
    leave = wp.float32(NO_HIT)
    for axis in range(3):
        step = direction[axis]
        if wp.abs(step) < TINY:
            step = TINY
        a = (lower[axis] - origin[axis]) / step
        b = (upper[axis] - origin[axis]) / step
        enter = wp.max(enter, wp.min(a, b))
        leave = wp.min(leave, wp.max(a, b))
    if enter > leave or enter <= 0.0:
        return NO_HIT
    return enter


@wp.kernel
def place_camera_kernel(
    # Model:
    camera_body: int,
    # In:
    extrinsics_in: wp.array[wp.transform],
    body_q_in: wp.array2d[wp.transform],
    # Out:
    camera_q_out: wp.array[wp.transform],
):
    """Pose of each world's optical frame in the world frame, shape [N]. Launch: [N].

    Args:
        camera_body: Body that carries the camera, an index within a world; negative for the world itself.
        extrinsics_in: Optical frame in the frame of that body, shape [N].
        body_q_in: Body poses in the world frame, shape [N, B].
        camera_q_out: Optical frame in the world frame, shape [N].
    """
    world = wp.tid()
    pose = extrinsics_in[world]
    if camera_body >= 0:
        pose = wp.transform_multiply(body_q_in[world, camera_body], pose)
    camera_q_out[world] = pose


@wp.kernel
def place_meshes_kernel(
    # Model:
    views: wp.array[View],
    shape_body: wp.array[int],
    shape_mesh: wp.array2d[int],
    shape_scale: wp.array2d[float],
    mesh_lower: wp.array[wp.vec3],
    mesh_upper: wp.array[wp.vec3],
    # In:
    camera_q_in: wp.array[wp.transform],
    body_q_in: wp.array2d[wp.transform],
    # Out:
    rotation_out: wp.array2d[wp.mat33],
    position_out: wp.array2d[wp.vec3],
    window_out: wp.array2d[wp.vec4],
    nearest_out: wp.array2d[float],
):
    """Place every mesh before its camera, and bound what it can cover in the image. Launch: [N, S].

    Args:
        views: Camera of each world, shape [N].
        shape_body: Body that carries each shape, an index within a world; negative for the world, shape [S].
        shape_mesh: Mesh of each shape, shape [N, S].
        shape_scale: Size factor of each shape, shape [N, S].
        mesh_lower: Lower corner of each mesh's bounds in its frame [m], shape [M].
        mesh_upper: Upper corner, shape [M].
        camera_q_in: Optical frames in the world frame, shape [N].
        body_q_in: Body poses in the world frame, shape [N, B].
        rotation_out: Rotation from mesh to optical frame, shape [N, S].
        position_out: Origin of the mesh frame in the optical frame [m], shape [N, S].
        window_out: Least and largest column, then row, that the bounds cover [pixel] as
            (column, row, column, row); empty (least above largest) if nothing can be seen, shape [N, S].
        nearest_out: Depth that no point of the mesh is in front of [m], shape [N, S].
    """
    world, shape = wp.tid()
    view = views[world]
    pose = wp.transform_inverse(camera_q_in[world])
    body = shape_body[shape]
    if body >= 0:
        pose = wp.transform_multiply(pose, body_q_in[world, body])
    mesh = shape_mesh[world, shape]
    scale = shape_scale[world, shape]
    lower = mesh_lower[mesh] * scale
    upper = mesh_upper[mesh] * scale

    least = wp.vec2(NO_HIT, NO_HIT)
    largest = wp.vec2(-NO_HIT, -NO_HIT)
    nearest = wp.float32(NO_HIT)
    farthest = wp.float32(-NO_HIT)
    for corner in range(8):
        point = lower
        if corner & 1:
            point[0] = upper[0]
        if corner & 2:
            point[1] = upper[1]
        if corner & 4:
            point[2] = upper[2]
        seen = wp.transform_point(pose, point)
        nearest = wp.min(nearest, seen[2])
        farthest = wp.max(farthest, seen[2])
        z = wp.max(seen[2], view.near)
        pixel = wp.vec2(view.cx + view.fx * seen[0] / z, view.cy + view.fy * seen[1] / z)
        least = wp.min(least, pixel)
        largest = wp.max(largest, pixel)
    window = wp.vec4(least[0], least[1], largest[0], largest[1])
    if nearest < view.near:
        # A corner beside or behind the camera has no pixel: look everywhere.
        window = wp.vec4(-NO_HIT, -NO_HIT, NO_HIT, NO_HIT)
    if farthest <= 0.0 or nearest > view.far:
        window = wp.vec4(NO_HIT, NO_HIT, -NO_HIT, -NO_HIT)

    rotation_out[world, shape] = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    position_out[world, shape] = wp.transform_get_translation(pose)
    window_out[world, shape] = window
    nearest_out[world, shape] = wp.max(nearest, 0.0)


@wp.kernel
def finish_depth_kernel(
    # Model:
    views: wp.array[View],
    table_lower: wp.vec3,
    table_upper: wp.vec3,
    height: int,
    width: int,
    block: int,
    lanes: int,
    # In:
    table_in: wp.array[int],
    camera_q_in: wp.array[wp.transform],
    rng_in: wp.array[wp.uint32],
    # In/Out:
    depth: wp.array3d[float],
):
    """Add the table, and write 0 where nothing is within the camera's range. Launch: [N, R, lanes].

    Args:
        views: Camera of each world, shape [N].
        table_lower: Lower corner of the table in the world frame [m].
        table_upper: Upper corner [m].
        height: Rows of the image.
        width: Columns of the image.
        block: Pixels on a side of a cell.
        lanes: Threads of a row.
        table_in: Whether the table is there, shape [N].
        camera_q_in: Optical frames in the world frame, shape [N].
        rng_in: Random state of each world, shape [N]; not advanced.
        depth: Depth of the nearest mesh along the optical axis [m], then of anything, shape [N, R, C].
    """
    world, row, lane = wp.tid()
    view = views[world]
    camera_q = camera_q_in[world]
    eye = wp.transform_get_translation(camera_q)
    rotation = wp.quat_to_matrix(wp.transform_get_rotation(camera_q))
    columns = depth.shape[2]
    for column in range(lane, columns, lanes):
        best = depth[world, row, column]
        if table_in[world] != 0:
            pixel_row, pixel_column = cell_pixel(rng_in[world], row, column, columns, block, height, width)
            direction = rotation * pixel_direction(view, pixel_column, pixel_row)
            best = wp.min(best, box_depth(eye, direction, table_lower, table_upper))
        if best < view.near or best > view.far:
            best = EMPTY
        depth[world, row, column] = best
