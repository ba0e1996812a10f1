"""Depth images by ray casting.

One thread a triangle, which tests the rays of the pixels it can cover.

Frames: *optical* is the camera's (x right, y down, z forward); depth is z of that frame, along the
optical axis, not along the ray. Pixel (column, row) is seen along its centre, (column + 0.5, row +
0.5); the principal point is measured from the top left corner of the image. Metres, quaternions
xyzw.

A mesh of the size of these covers few pixels with each triangle. A pixel is covered if the ray
through its centre meets the triangle, tested without dividing by depth, so that triangles beside
and behind the camera need no clipping.

Launch order: ``place_camera_kernel``, ``place_meshes_kernel``, then ``depth.fill_(NO_HIT)``,
``cast_rays_kernel`` and ``finish_depth_kernel``.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

NO_HIT = wp.constant(1.0e9)
"""Depth of nothing while the nearest surface is looked for [m]."""

EMPTY = wp.constant(0.0)
"""Depth in a finished image where nothing was measured."""

TINY = wp.constant(1.0e-9)
"""Stands in for a zero component of a direction, so that its reciprocal is finite."""

MARGIN = wp.constant(1.0e-3)
"""Pixels by which a triangle's bounds are widened: above the rounding of a projection."""


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
    """Direction through the centre of a pixel in the optical frame, z = 1.

    Times depth it is the point.
    """
    return wp.vec3(
        (float(column) + 0.5 - view.cx) / view.fx,
        (float(row) + 0.5 - view.cy) / view.fy,
        1.0,
    )


@wp.func
def box_depth(origin: wp.vec3, direction: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> float:
    """Multiple of ``direction`` at which a ray enters a box.

    NO_HIT if it misses or starts inside.
    """
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
    camera_body: int,  # body that carries the camera, an index within a world; negative for the world itself
    # In:
    extrinsics_in: wp.array[wp.transform],  # [N] optical frame in the frame of that body
    body_q_in: wp.array2d[wp.transform],  # [N, B] body poses in the world frame
    # Out:
    camera_q_out: wp.array[wp.transform],  # [N] optical frame in the world frame
):
    """Pose of each world's optical frame in the world frame, shape [N]. Launch: [N]."""
    world = wp.tid()
    pose = extrinsics_in[world]
    if camera_body >= 0:
        pose = wp.transform_multiply(body_q_in[world, camera_body], pose)
    camera_q_out[world] = pose


@wp.kernel
def place_meshes_kernel(
    # Model:
    shape_body: wp.array[int],  # [S] body of each shape, an index within a world; < 0: the world
    # In:
    camera_q_in: wp.array[wp.transform],  # [N] optical frames in the world frame
    body_q_in: wp.array2d[wp.transform],  # [N, B] body poses in the world frame
    # Out:
    rotation_out: wp.array2d[wp.mat33],  # [N, S] rotation from mesh to optical frame
    position_out: wp.array2d[wp.vec3],  # [N, S] origin of the mesh frame in the optical frame [m]
):
    """Place every mesh before its camera. Launch: [N, S]."""
    world, shape = wp.tid()
    pose = wp.transform_inverse(camera_q_in[world])
    body = shape_body[shape]
    if body >= 0:
        pose = wp.transform_multiply(pose, body_q_in[world, body])
    rotation_out[world, shape] = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    position_out[world, shape] = wp.transform_get_translation(pose)


@wp.func
def edge_normal(a: wp.vec3, b: wp.vec3, index_a: int, index_b: int) -> wp.vec3:
    """Normal of the plane through the camera and an edge.

    Exactly opposite for the edge turned around.

    The two triangles at an edge must agree on which side a ray passes, or rays slip between them;
    the rounding of a cross product depends on the order of its factors, so the indices choose the
    order.
    """
    if index_a < index_b:
        first, second, sign = a, b, 1.0
    else:
        first, second, sign = b, a, -1.0
    return wp.cross(first, second) * sign


@wp.kernel
def cast_rays_kernel(
    # Model:
    views: wp.array[View],  # [N] camera of each world
    points: wp.array[wp.vec3],  # [V] vertices of all meshes in their frames [m]
    triangles: wp.array[wp.vec3i],  # [F] vertices of all triangles, mesh after mesh
    mesh_first: wp.array[int],  # [M + 1] first triangle of each mesh, and the end of the last
    slot_shape: wp.array[int],  # [K] shape of each thread
    slot_index: wp.array[int],  # [K] each thread's triangle within the shape's mesh, if it has it
    shape_mesh: wp.array2d[int],  # [N, S] mesh of each shape
    shape_scale: wp.array2d[float],  # [N, S] size factor of each shape
    # In:
    rotation_in: wp.array2d[wp.mat33],  # [N, S] rotation from mesh to optical frame
    position_in: wp.array2d[wp.vec3],  # [N, S] origin of the mesh frame in the optical frame [m]
    # Out:
    depth_bits: wp.array3d[wp.int32],  # [N, H, W] depth [m] as the bits of a float
):
    """Lower the depth of every pixel that a triangle covers. Launch: [N, K].

    The bits of positive floats are in their order, and devices have an atomic minimum of integers.
    """
    world, slot = wp.tid()
    shape = slot_shape[slot]
    mesh = shape_mesh[world, shape]
    triangle = mesh_first[mesh] + slot_index[slot]
    if triangle >= mesh_first[mesh + 1]:
        return
    view = views[world]
    rotation = rotation_in[world, shape] * shape_scale[world, shape]
    position = position_in[world, shape]
    corner = triangles[triangle]
    a = rotation * points[corner[0]] + position
    b = rotation * points[corner[1]] + position
    c = rotation * points[corner[2]] + position
    if not (wp.max(a[2], wp.max(b[2], c[2])) > 0.0):  # behind the camera, or no number
        return

    height = depth_bits.shape[1]
    width = depth_bits.shape[2]
    left = wp.int32(0)
    top = wp.int32(0)
    right = width
    bottom = height
    if wp.min(a[2], wp.min(b[2], c[2])) >= view.near:
        pa = wp.vec2(a[0] / a[2], a[1] / a[2])
        pb = wp.vec2(b[0] / b[2], b[1] / b[2])
        pc = wp.vec2(c[0] / c[2], c[1] / c[2])
        least = wp.min(pa, wp.min(pb, pc))
        largest = wp.max(pa, wp.max(pb, pc))
        # Pixel k is seen along k + 0.5. Clamped before the cast: a far column need not fit an
        # integer.
        last_column, last_row = float(width) - 1.0, float(height) - 1.0
        left = int(
            wp.ceil(wp.clamp(view.cx + view.fx * least[0] - MARGIN - 0.5, 0.0, last_column + 1.0))
        )
        top = int(
            wp.ceil(wp.clamp(view.cy + view.fy * least[1] - MARGIN - 0.5, 0.0, last_row + 1.0))
        )
        right = (
            int(
                wp.floor(wp.clamp(view.cx + view.fx * largest[0] + MARGIN - 0.5, -1.0, last_column))
            )
            + 1
        )
        bottom = (
            int(wp.floor(wp.clamp(view.cy + view.fy * largest[1] + MARGIN - 0.5, -1.0, last_row)))
            + 1
        )
    if left >= right or top >= bottom:
        return

    # A ray d meets the plane of abc at u a + v b + w c with u : v : w = d.(b x c) : d.(c x a) :
    # d.(a x b), and the triangle where none of the three has the other sign. The depth comes from
    # the plane's normal, a product of short vectors and hence exact where these products of long
    # ones are not.
    na = edge_normal(b, c, corner[1], corner[2])
    nb = edge_normal(c, a, corner[2], corner[0])
    nc = edge_normal(a, b, corner[0], corner[1])
    normal = wp.cross(b - a, c - a)
    offset = wp.dot(a, normal)
    if offset < 0.0:
        na, nb, nc, normal, offset = -na, -nb, -nc, -normal, -offset
    nearest = wp.min(a[2], wp.min(b[2], c[2]))
    farthest = wp.max(a[2], wp.max(b[2], c[2]))
    across = 1.0 / view.fx
    for row in range(top, bottom):
        # Along a row the direction is (x, y, 1) with x alone changing.
        y = (float(row) + 0.5 - view.cy) / view.fy
        ka = na[1] * y + na[2]
        kb = nb[1] * y + nb[2]
        kc = nc[1] * y + nc[2]
        kn = normal[1] * y + normal[2]
        for column in range(left, right):
            x = (float(column) + 0.5 - view.cx) * across
            if na[0] * x + ka >= 0.0 and nb[0] * x + kb >= 0.0 and nc[0] * x + kc >= 0.0:
                slope = normal[0] * x + kn
                if slope > 0.0:
                    bits = wp.cast(wp.clamp(offset / slope, nearest, farthest), wp.int32)
                    if bits < depth_bits[world, row, column]:
                        wp.atomic_min(depth_bits, world, row, column, bits)


@wp.kernel
def finish_depth_kernel(
    # Model:
    views: wp.array[View],  # [N] camera of each world
    table_lower: wp.vec3,  # lower corner of the table in the world frame [m]
    table_upper: wp.vec3,  # upper corner [m]
    lanes: int,  # threads of a row
    # In:
    table_in: wp.array[int],  # [N] whether the table is there
    camera_q_in: wp.array[wp.transform],  # [N] optical frames in the world frame
    # In/Out:
    depth: wp.array3d[float],  # [N, H, W] depth of the nearest mesh [m], then of anything
):
    """Add the table, and write 0 where nothing is within the camera's range.

    Launch: [N, H, lanes].
    """
    world, row, lane = wp.tid()
    view = views[world]
    camera_q = camera_q_in[world]
    eye = wp.transform_get_translation(camera_q)
    rotation = wp.quat_to_matrix(wp.transform_get_rotation(camera_q))
    for column in range(lane, depth.shape[2], lanes):
        best = depth[world, row, column]
        if table_in[world] != 0:
            direction = rotation * pixel_direction(view, column, row)
            best = wp.min(best, box_depth(eye, direction, table_lower, table_upper))
        if best < view.near or best > view.far:
            best = EMPTY
        depth[world, row, column] = best
