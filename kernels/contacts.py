"""Contact forces read from the solver's constraint rows."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pair_force_kernel(
    # In:
    contact_count: wp.array[int],
    contact_world: wp.array[int],
    contact_geom: wp.array[wp.vec2i],
    contact_row: wp.array2d[int],
    contact_dim: wp.array[int],
    row_force: wp.array2d[float],
    geom_kind: wp.array2d[int],
    kind_a: int,
    kind_b: int,
    pyramidal: int,
    # In/Out:
    force: wp.array[float],
):
    """Add up the normal forces [N] between two kinds of geoms in every world.

    One thread per contact slot. ``force`` must be zero before the launch.

    Args:
        contact_count: Number of contacts in use over all worlds, shape [1].
        contact_world: World of each contact, shape [C].
        contact_geom: The two geoms of each contact, shape [C].
        contact_row: Constraint rows of each contact; the first is the normal with an elliptic
            cone, -1 where the contact is not active, shape [C, R].
        contact_dim: Contact dimension (1, 3, 4 or 6), shape [C].
        row_force: Force of each constraint row [N], shape [N, rows].
        geom_kind: Kind of each geom, shape [N, G].
        kind_a: First kind.
        kind_b: Second kind.
        pyramidal: 1 for the pyramidal cone, whose normal force is the sum of its edges.
        force: Summed normal force [N], shape [N].
    """
    contact = wp.tid()
    if contact >= contact_count[0]:
        return
    first = contact_row[contact, 0]
    if first < 0:
        return
    world = contact_world[contact]
    geoms = contact_geom[contact]
    if geoms[0] < 0 or geoms[1] < 0:
        return
    a = geom_kind[world, geoms[0]]
    b = geom_kind[world, geoms[1]]
    if not ((a == kind_a and b == kind_b) or (a == kind_b and b == kind_a)):
        return
    normal = row_force[world, first]
    if pyramidal != 0 and contact_dim[contact] > 1:
        for edge in range(1, 2 * (contact_dim[contact] - 1)):
            normal += row_force[world, contact_row[contact, edge]]
    wp.atomic_add(force, world, normal)
