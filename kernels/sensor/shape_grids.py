"""Shapes as grids of distances to their surfaces, so that a point costs one look-up whatever the shape is.

Frames: *object* is that of the samples. Metres. N worlds, O shapes of S samples, grids of E^3
distances.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

ANYWHERE = wp.constant(1.0)
"""Farthest that the surface is looked for [m]."""


@wp.struct
class Shapes:
    """Shapes that can be looked for, and which one each world holds."""

    samples: wp.array2d[wp.vec3]  # [O, S] surface samples in the object frame, unscaled [m]
    distance: wp.array4d[float]  # [O, E, E, E] distance to the surface on grids, < 0 inside [m]
    half: wp.array[float]  # [O] half the side of each grid [m]
    world_shape: wp.array[int]  # [N] shape of each world
    world_scale: wp.array[float]  # [N] factor on its size


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
    samples: wp.array2d[wp.vec3],  # [O, S] surface samples in the object frame [m]
    mesh: wp.array[wp.uint64],  # [O] mesh of each shape, with winding numbers
    half: wp.array[float],  # [O] half the side of each grid [m]
    # In:
    meshed_in: wp.array[int],  # [O] 1 where the surface is the mesh, 0 where it is the samples
    # Out:
    distance_out: wp.array4d[float],  # [O, E, E, E] distances [m], negative inside of a mesh
):
    """Distance from each point of a grid to the surface. Launch: [O, E, E, E]."""
    shape, i, j, k = wp.tid()
    side = 2.0 * half[shape] / float(distance_out.shape[1] - 1)
    corner = wp.vec3(half[shape], half[shape], half[shape])
    place = side * wp.vec3(float(i), float(j), float(k)) - corner
    if meshed_in[shape] != 0:
        found = wp.mesh_query_point_sign_winding_number(mesh[shape], place, ANYWHERE)
        nearest = wp.mesh_eval_position(mesh[shape], found.face, found.u, found.v)
        distance_out[shape, i, j, k] = found.sign * wp.length(nearest - place)
        return
    least = wp.length_sq(samples[shape, 0] - place)
    for sample in range(1, samples.shape[1]):
        least = wp.min(least, wp.length_sq(samples[shape, sample] - place))
    distance_out[shape, i, j, k] = wp.sqrt(least)


@wp.func
def surface_distance(shapes: Shapes, shape: int, place: wp.vec3):
    """Distance of a point of the object frame (unscaled) from the surface, as in the grid, and its gradient.

    Between grid points it is interpolated; outside of the grid it grows by the distance from the
    grid.
    """
    last = shapes.distance.shape[1] - 1
    half = shapes.half[shape]
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
    d000 = shapes.distance[shape, i, j, k]
    d001 = shapes.distance[shape, i, j, k + 1]
    d010 = shapes.distance[shape, i, j + 1, k]
    d011 = shapes.distance[shape, i, j + 1, k + 1]
    d100 = shapes.distance[shape, i + 1, j, k]
    d101 = shapes.distance[shape, i + 1, j, k + 1]
    d110 = shapes.distance[shape, i + 1, j + 1, k]
    d111 = shapes.distance[shape, i + 1, j + 1, k + 1]
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
