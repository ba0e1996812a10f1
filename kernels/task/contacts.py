"""Contact forces read from the solver's constraint rows, and restitution written into its contacts."""

import warp as wp

from vd.kernels.columns import read_vec3

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pair_force_kernel(
    # In:
    contact_count: wp.array[int],  # [1] number of contacts in use over all worlds
    contact_world: wp.array[int],  # [C] world of each contact
    contact_geom: wp.array[wp.vec2i],  # [C] the two geoms of each contact
    contact_row: wp.array2d[int],  # [C, R] constraint rows of each contact; -1 where it is not active
    row_force: wp.array2d[float],  # [N, rows] force of each constraint row [N]
    geom_kind: wp.array2d[int],  # [N, G] kind of each geom
    kind_a: int,  # first kind
    kind_b: int,  # second kind
    # In/Out:
    force: wp.array[float],  # [N] summed normal force [N]
):
    """Add up the normal forces [N] between two kinds of geoms in every world.

    One thread per contact slot. ``force`` must be zero before the launch. The first row of a contact is the
    normal's: the cone is elliptic.
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


@wp.func
def damping_ratio(restitution: float, lowest: float) -> float:
    """Damping ratio z of a spring that throws back with ``restitution``; at least ``lowest``.

    The coefficient is exp(-pi z / sqrt(1 - z^2)).
    """
    if restitution <= 0.0:
        return 1.0
    log = -wp.log(wp.min(restitution, 1.0))
    return wp.clamp(log / wp.sqrt(wp.PI * wp.PI + log * log), lowest, 1.0)


@wp.kernel
def restitution_kernel(
    # Model:
    nominal: wp.array2d[wp.vec2],  # [N, G] references without restitution
    geom_kind: wp.array2d[int],  # [N, G] kind of each geom
    kind_table: int,  # kind of the table
    kind_hand: int,  # kind of the hand's geoms
    object_column: int,  # column of the object's linear velocity
    threshold: float,  # speed of the object below which nothing bounces [m/s]
    lowest: float,  # least damping ratio relative to the nominal
    # In:
    joint_qd: wp.array2d[float],  # [N, D + 6] velocities
    hand_restitution: wp.array[float],  # [N] coefficient of restitution of the hand
    object_restitution: wp.array[float],  # [N] the same of the object
    table_restitution: wp.array[float],  # [N] the same of the table
    # Out:
    solref_out: wp.array2d[wp.vec2],  # [N, G] references; geoms that are neither hand nor table keep theirs
):
    """Write each geom's contact reference so that a fast object bounces and a slow one does not.

    Launch: [N, G].

    A reference is (time constant, damping ratio). Where the object is faster than ``threshold``, the ratio is
    divided by as much as the time constant is multiplied with: the stiffness 1 / (time constant * ratio)^2
    stays. As for friction, hand and table carry the mean of their own and the object's restitution, because
    of two geoms that touch the solver takes the one with the higher priority: table over hand over object.
    """
    world, geom = wp.tid()
    kind = geom_kind[world, geom]
    if kind != kind_table and kind != kind_hand:
        return
    reference = nominal[world, geom]
    if wp.length(read_vec3(world, object_column, joint_qd)) > threshold:
        own = wp.where(kind == kind_table, table_restitution[world], hand_restitution[world])
        ratio = damping_ratio(0.5 * (own + object_restitution[world]), lowest)
        reference = wp.vec2(reference[0] / ratio, reference[1] * ratio)
    solref_out[world, geom] = reference
