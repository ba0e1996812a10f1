"""Contact forces read from the solver's constraint rows."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pair_force_kernel(
    # In:
    contact_count: wp.array[int],  # [1] number of contacts in use over all worlds
    contact_world: wp.array[int],  # [C] world of each contact
    contact_geom: wp.array[wp.vec2i],  # [C] the two geoms of each contact
    contact_row: wp.array2d[int],  # [C, R] constraint rows of each contact; -1: not active
    row_force: wp.array2d[float],  # [N, rows] force of each constraint row [N]
    geom_kind: wp.array2d[int],  # [N, G] kind of each geom
    kind_a: int,  # first kind
    kind_b: int,  # second kind
    # In/Out:
    force: wp.array[float],  # [N] summed normal force [N]
):
    """Add up the normal forces [N] between two kinds of geoms in every world.

    One thread per contact slot. ``force`` must be zero before the launch. The first row of a
    contact is the normal's: the cone is elliptic.
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
    wp.atomic_add(force, world, row_force[world, first])
