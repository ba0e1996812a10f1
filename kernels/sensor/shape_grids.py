"""Distances from shapes, as grids of which a point costs one look-up, and turns of a shape onto itself.

Frames: that of the object. Metres. O shapes, grids of E^3 distances, R rotations.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

ANYWHERE = wp.constant(1.0)
"""Farthest that the surface is looked for [m]."""
LEVER_M = wp.constant(0.03)
"""Turns weigh against shifts as at this distance from the centre, about the size of an object."""
DAMPING = wp.constant(0.01)
"""Curvature added to each direction, of one: what the points do not fix stays where it is."""
LARGEST_TURN = wp.constant(0.5)
"""Largest turn of one step [rad]."""
SETTLED_M = wp.constant(5.0e-5)
"""A step that shifts a pose by less than this [m] (ours, far below what is seen) ..."""
SETTLED_RAD = wp.constant(1.0e-3)
"""... and turns it by less than this [rad] is the last one (ours)."""
SMALL = wp.constant(1.0e-7)
"""Lengths and angles below this have no direction."""


@wp.kernel
def off_mesh_kernel(
    # Model:
    samples: wp.array2d[wp.vec3],  # [O, S] surface samples in the object frame [m]
    mesh: wp.array[wp.uint64],  # [O] mesh of each shape
    # Out:
    distance_out: wp.array2d[float],  # [O, S] distances [m]
):
    """Distance of each sample from the mesh of its shape. Launch: [O, S]."""
    shape, sample = wp.tid()
    place = samples[shape, sample]
    found = wp.mesh_query_point_no_sign(mesh[shape], place, ANYWHERE)
    distance_out[shape, sample] = wp.length(
        wp.mesh_eval_position(mesh[shape], found.face, found.u, found.v) - place
    )


@wp.kernel
def shape_distance_kernel(
    # Model:
    mesh: wp.array[wp.uint64],  # [O] mesh of each shape, with winding numbers
    half: wp.array[float],  # [O] half the side of each grid [m]
    # Out:
    distance_out: wp.array4d[float],  # [O, E, E, E] distances [m], negative inside
):
    """Distance from each point of a grid to the mesh. Launch: [O, E, E, E]."""
    shape, i, j, k = wp.tid()
    side = 2.0 * half[shape] / float(distance_out.shape[1] - 1)
    corner = wp.vec3(half[shape], half[shape], half[shape])
    place = side * wp.vec3(float(i), float(j), float(k)) - corner
    found = wp.mesh_query_point_sign_winding_number(mesh[shape], place, ANYWHERE)
    nearest = wp.mesh_eval_position(mesh[shape], found.face, found.u, found.v)
    distance_out[shape, i, j, k] = found.sign * wp.length(nearest - place)


@wp.func
def surface_distance(distances: wp.array4d[float], half: float, shape: int, place: wp.vec3):
    """Distance of a point from the surface, as in the grid, and its gradient.

    Between grid points it is interpolated; outside of the grid it grows by the distance from the
    grid.
    """
    last = distances.shape[1] - 1
    per_metre = float(last) / (2.0 * half)
    grid = (place + wp.vec3(half, half, half)) * per_metre
    top = float(last) - 1.0e-3
    inside = wp.vec3(
        wp.clamp(grid[0], 0.0, top), wp.clamp(grid[1], 0.0, top), wp.clamp(grid[2], 0.0, top)
    )
    i = int(inside[0])
    j = int(inside[1])
    k = int(inside[2])
    u = inside[0] - float(i)
    v = inside[1] - float(j)
    w = inside[2] - float(k)
    d000 = distances[shape, i, j, k]
    d001 = distances[shape, i, j, k + 1]
    d010 = distances[shape, i, j + 1, k]
    d011 = distances[shape, i, j + 1, k + 1]
    d100 = distances[shape, i + 1, j, k]
    d101 = distances[shape, i + 1, j, k + 1]
    d110 = distances[shape, i + 1, j + 1, k]
    d111 = distances[shape, i + 1, j + 1, k + 1]
    low = wp.lerp(wp.lerp(d000, d001, w), wp.lerp(d010, d011, w), v)
    high = wp.lerp(wp.lerp(d100, d101, w), wp.lerp(d110, d111, w), v)
    along_x = high - low
    along_y = wp.lerp(wp.lerp(d010 - d000, d011 - d001, w), wp.lerp(d110 - d100, d111 - d101, w), u)
    along_z = wp.lerp(wp.lerp(d001 - d000, d011 - d010, v), wp.lerp(d101 - d100, d111 - d110, v), u)
    distance = wp.lerp(low, high, u)
    gradient = per_metre * wp.vec3(along_x, along_y, along_z)
    outside = (grid - inside) / per_metre
    beyond = wp.length(outside)
    if beyond > 2.0e-3 / per_metre:
        distance += beyond
        gradient = outside / beyond
    return distance, gradient


@wp.func
def improved(
    distances: wp.array4d[float],
    half: float,
    points: wp.array2d[wp.vec3],
    far: float,
    shape: int,
    pose: wp.transform,
) -> wp.transform:
    """A pose after one step of Gauss and Newton on the distances of points from the shape."""
    place = wp.transform_get_translation(pose)
    turn = wp.transform_get_rotation(pose)
    # Curvature of shifts, of turns, and between them; slopes of both.
    shifts = wp.mat33()
    turns = wp.mat33()
    mixed = wp.mat33()
    shift_slope = wp.vec3()
    turn_slope = wp.vec3()
    for i in range(points.shape[1]):
        arm = points[shape, i] - place
        distance, gradient = surface_distance(distances, half, shape, wp.quat_rotate_inv(turn, arm))
        normal = wp.quat_rotate(turn, gradient)
        moment = wp.cross(arm, normal) / LEVER_M
        weight = far * far / (far * far + distance * distance)
        shifts += weight * wp.outer(normal, normal)
        turns += weight * wp.outer(moment, moment)
        mixed += weight * wp.outer(normal, moment)
        shift_slope += weight * distance * normal
        turn_slope += weight * distance * moment
    damping = DAMPING * float(points.shape[1]) * wp.identity(n=3, dtype=float)
    solved = wp.inverse(shifts + damping)
    # The shift that is best for each turn put in (Schur's complement).
    left = turns + damping - wp.transpose(mixed) * solved * mixed
    angle_axis = wp.inverse(left) * (turn_slope - wp.transpose(mixed) * solved * shift_slope)
    shift = solved * (shift_slope - mixed * angle_axis)
    angle_axis = angle_axis / LEVER_M
    angle = wp.length(angle_axis)
    if angle > SMALL:
        step = wp.quat_from_axis_angle(angle_axis / angle, wp.min(angle, LARGEST_TURN))
        turn = wp.normalize(step * turn)
    return wp.transform(place + shift, turn)


@wp.kernel
def turn_onto_itself_kernel(
    # Model:
    distances: wp.array4d[float],  # [O, E, E, E] of ``shape_distance_kernel`` [m]
    half: wp.array[float],  # [O] half the side of each grid [m]
    points: wp.array2d[wp.vec3],  # [O, P] points of each surface [m]
    far: float,  # length at which distances are cut off [m]; from about there on points count less
    steps: int,  # steps at most
    # In:
    mean_in: wp.array[wp.vec3],  # [O] middle of each shape [m] ...
    place_in: wp.array[wp.vec3],  # [O] ... and where it is at first [m]
    turn_in: wp.array[wp.quat],  # [R] rotations to begin from
    # Out:
    turn_out: wp.array2d[wp.quat],  # [O, R] rotations that are better
    misfit_out: wp.array2d[float],  # [O, R] mean square of the points' distances [m^2]
):
    """Turn shapes until their own points lie on them, and say how badly they do. Launch: [O, R]."""
    shape, row = wp.tid()
    begun = turn_in[row]
    pose = wp.transform(place_in[shape] - wp.quat_rotate(begun, mean_in[shape]), begun)
    for _ in range(steps):
        before = pose
        pose = improved(distances, half[shape], points, far, shape, before)
        shift = wp.transform_get_translation(pose) - wp.transform_get_translation(before)
        # Half the angle, if small.
        turn = wp.transform_get_rotation(pose) - wp.transform_get_rotation(before)
        if wp.length(shift) < SETTLED_M and 2.0 * wp.length(turn) < SETTLED_RAD:
            break
    back = wp.transform_inverse(pose)
    off = wp.float32(0.0)
    for i in range(points.shape[1]):
        place = wp.transform_point(back, points[shape, i])
        distance, _gradient = surface_distance(distances, half[shape], shape, place)
        distance = wp.min(wp.abs(distance), far)
        off += distance * distance
    turn_out[shape, row] = wp.transform_get_rotation(pose)
    misfit_out[shape, row] = off / float(points.shape[1])
