"""Starts of the object in which no finger is inside it.

The nearest of a few places beside the one drawn.

The orientation stays. Places are tried side by side, each by how deep the samples of the object's
surface are in the shapes of the hand as it stands after a reset. World frame (z up), metres,
quaternions xyzw.
"""

from math import cos, pi, sin

import warp as wp

from vd.kernels.columns import read_quat, read_vec3, write_vec3

wp.set_module_options({"enable_backward": False})

PLACE_STEP_M = 0.015
"""Distance of places from each other [m]: smaller ones need more of them to come out of a
finger.
"""
RINGS, RING_PLACES, LEVELS = 2, 6, 4
"""Places of a level: the start, and rings of six around; levels go away from the palm."""
APART_M = 0.004
"""Distance from the hand at which a sample counts as outside [m]: half of that between samples. Of
13 meshes none of 325 starts is then more than 1 mm inside, at 3 mm one in a hundred is."""
IN_TABLE_M = 0.001
"""How deep a sample may be in the table [m]: objects at rest sink in a little."""
CHUNKS = 8
"""Threads that share the samples of an object at one place."""


def start_places(*, up: bool = False) -> list[tuple[float, float, float]]:
    """Displacements from the start as drawn [m], itself first, the nearer ones before the farther.

    Levels go away from the palm: down, or up from a hand in which objects rest.
    """
    places = []
    for level in range(LEVELS):
        height = (PLACE_STEP_M if up else -PLACE_STEP_M) * level
        places.append((0.0, 0.0, height))
        for ring in range(1, RINGS + 1):
            angles = [2.0 * pi * (i + 0.5 * ring) / RING_PLACES for i in range(RING_PLACES)]
            radius = PLACE_STEP_M * ring
            places += [(radius * cos(angle), radius * sin(angle), height) for angle in angles]
    return sorted(places, key=lambda place: round(sum(x * x for x in place), 9))


@wp.struct
class OpenHand:
    """S shapes of the hand as it stands after a reset.

    Boxes with rounded edges, which capsules are too.
    """

    pose: wp.array[wp.transform]  # [S] pose of each shape
    half: wp.array[wp.vec3]  # [S] half extents without the rounding [m]
    radius: wp.array[float]  # [S] radius of the rounding [m]
    reach: wp.array[float]  # [S] distance from its centre to what counts as inside, at most [m]


@wp.func
def depth_in_box(point: wp.vec3, half: wp.vec3, radius: float) -> float:
    """Depth of a point in a rounded box about the origin, negative outside [m]."""
    beyond = wp.vec3(wp.abs(point[0]), wp.abs(point[1]), wp.abs(point[2])) - half
    outside = wp.vec3(wp.max(beyond[0], 0.0), wp.max(beyond[1], 0.0), wp.max(beyond[2], 0.0))
    return radius - wp.length(outside) - wp.min(wp.max(beyond), 0.0)


@wp.kernel
def start_depth_kernel(
    # Model:
    hand: OpenHand,  # the hand after a reset
    points: wp.array2d[wp.vec3],  # [K, P] surface points of each object, object frame [m]
    world_object: wp.array[int],  # [N] object of each world
    world_scale: wp.array[float],  # [N] factor on the object's size in each world
    places: wp.array[wp.vec3],  # [C] displacements of the object [m]
    table_top: float,  # height of the table's top [m]
    object_column: int,  # column of the object's position in ``joint_q_in``; its quaternion follows
    # In:
    reset_in: wp.array[int],  # [N] 1 where the world is reset; others are left as they are
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    # In/Out:
    depth: wp.array2d[float],  # [N, C] depth beyond what is allowed [m], 0 before; raised
):
    """How deep the object would start in hand or table at each place. Launch: [N, C, CHUNKS]."""
    world, place, chunk = wp.tid()
    if reset_in[world] == 0:
        return
    position = read_vec3(world, object_column, joint_q_in) + places[place]
    orientation = read_quat(world, object_column + 3, joint_q_in)
    shape = world_object[world]
    scale = world_scale[world]
    deepest = wp.float32(0.0)
    for i in range(chunk, points.shape[1], wp.static(CHUNKS)):
        point = position + wp.quat_rotate(orientation, scale * points[shape, i])
        deepest = wp.max(deepest, table_top - point[2] - wp.static(IN_TABLE_M))
        for s in range(hand.radius.shape[0]):
            away = point - wp.transform_get_translation(hand.pose[s])
            if wp.length_sq(away) < hand.reach[s] * hand.reach[s]:
                local = wp.quat_rotate_inv(wp.transform_get_rotation(hand.pose[s]), away)
                inside = depth_in_box(local, hand.half[s], hand.radius[s])
                deepest = wp.max(deepest, inside + wp.static(APART_M))
    if deepest > 0.0:
        wp.atomic_max(depth, world, place, deepest)


@wp.kernel
def move_start_kernel(
    # Model:
    places: wp.array[wp.vec3],  # [C] displacements of the object [m]
    object_column: int,  # column of the object's position in ``joint_q``
    # In:
    reset_in: wp.array[int],  # [N] 1 where the world is reset; others are left as they are
    # In/Out:
    depth: wp.array2d[float],  # [N, C] depth at each place [m], which becomes 0 for the next reset
    joint_q: wp.array2d[float],  # [N, D + 7] hand joints [rad], object position [m] and quaternion
):
    """Move the object to the place of least depth, of several the first. Launch: [N]."""
    world = wp.tid()
    if reset_in[world] == 0:
        return
    best = wp.int32(0)
    for place in range(1, places.shape[0]):
        if depth[world, place] < depth[world, best]:
            best = place
    for place in range(places.shape[0]):
        depth[world, place] = 0.0
    write_vec3(
        world, object_column, read_vec3(world, object_column, joint_q) + places[best], joint_q
    )
