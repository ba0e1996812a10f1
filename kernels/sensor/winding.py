"""Winding numbers of a surface that is known by samples.

What is inside of it, and what is outside.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1e6)
"""Distance within which a mesh of size 1 has a nearest point: any."""

ACCURACY = wp.constant(2.0)
"""Clusters of triangles farther than so many of their radii count by their moment: Warp's
default.
"""


@wp.kernel
def winding_kernel(
    # Model:
    samples: wp.array[wp.vec3],  # [K] centres of the pieces [m]
    areas: wp.array[wp.vec3],  # [K] outward normals of the pieces, as long as their areas [m^2]
    width: float,  # least distance [m]
    corner: wp.vec3,  # place of the first grid point [m]
    pitch: float,  # distance between grid points [m]
    # Out:
    winding_out: wp.array3d[float],  # [X, Y, Z] winding numbers
):
    """Winding numbers of a surface at the points of a grid. Launch: [X, Y, Z].

    The solid angles of its pieces as a share of the full one: about 1 inside, 0 outside and a half
    on the surface (Gauss). A piece nearer than ``width`` counts as if it were that far away, where
    its solid angle would go to infinity.
    """
    i, j, k = wp.tid()
    place = corner + pitch * wp.vec3(float(i), float(j), float(k))
    total = wp.float32(0.0)
    for sample in range(samples.shape[0]):
        away = samples[sample] - place
        distance = wp.max(wp.length(away), width)
        total += wp.dot(away, areas[sample]) / (distance * distance * distance)
    winding_out[i, j, k] = total / (4.0 * wp.PI)


@wp.kernel
def inside_kernel(
    # Model:
    mesh: wp.uint64,  # the mesh
    level: float,  # least winding number of the inside; a half for a closed mesh
    # In:
    points: wp.array[wp.vec3],  # [K] places in the mesh's frame
    # Out:
    inside_out: wp.array[wp.bool],  # [K] whether each is inside
):
    """Whether the generalised winding number of a mesh exceeds a level at points. Launch: [K].

    Far triangles count by clusters of the mesh's tree (Barill et al. 2018, Fast Winding Numbers for
    Soups and Clouds), as in Warp's query, which wants a mesh made with ``support_winding_number``.
    """
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], FAR, ACCURACY, level)
    inside_out[i] = query.sign < 0.0
