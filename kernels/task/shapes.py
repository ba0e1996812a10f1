"""What the teacher is told about the object's shape: where its surface is, and how far it extends.

Privileged and exact: no sensor gives these values, and they get no noise. World frame (z up),
metres inside, quaternions xyzw. The values are written behind the state in the observation, scaled
to about one.
"""

from math import cos, pi, sin

import warp as wp

from vd.kernels.columns import consecutive, read_quat, read_vec3, write_vec3
from vd.kernels.task.observations import fingertip_pose

wp.set_module_options({"enable_backward": False})

SHAPE_UNIT_M = 0.02
"""Unit of the values [m]: fingertips are this far from the surface, and extents vary by it."""
EXTENT_CENTRE_M = 0.05
"""Subtracted from extents [m]: about their mean over objects of 6 to 15 cm."""
AZIMUTHS_PER_FINGER = 3
"""Directions of a ring for each finger: every 40 degrees with three, every 30 with four."""
RING_ELEVATIONS = (-0.25 * pi, 0.0, 0.25 * pi)
"""Elevations of the rings of directions [rad]."""
ORIENTATIONS = 2
"""Extents are given as the object lies, and as it would lie at the goal."""


def extent_directions(fingers: int) -> list[tuple[float, float, float]]:
    """Directions in which extents are taken for a hand of G ``fingers``: 9 G + 2 unit vectors.

    Up, down, then rings of 3 G directions each, 45 degrees below the horizontal, level, and 45
    above. A turn of the world from one finger to the next moves every direction to another one of
    its ring.
    """
    azimuths = [
        2.0 * pi * i / (AZIMUTHS_PER_FINGER * fingers) for i in range(AZIMUTHS_PER_FINGER * fingers)
    ]
    rings = [(cos(a) * cos(e), sin(a) * cos(e), sin(e)) for e in RING_ELEVATIONS for a in azimuths]
    return [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), *rings]


def shape_observation_slices(fingers: int) -> dict[str, slice]:
    """Columns of each part of the shape's values, counted from the first of them."""
    directions = len(extent_directions(fingers))
    return consecutive({"surface": 3 * fingers, "extent": directions, "goal_extent": directions})


def shape_observation_size(fingers: int) -> int:
    """Number of values for a hand of ``fingers`` fingers: 21 G + 4."""
    return shape_observation_slices(fingers)["goal_extent"].stop


@wp.kernel
def surface_kernel(
    # Model:
    points: wp.array2d[wp.vec3],  # [K, P] surface points of each object, object frame [m]
    world_object: wp.array[int],  # [N] object of each world
    world_scale: wp.array[float],  # [N] factor on the object's size in each world
    tip_body: wp.array[int],  # [G] link of each fingertip, an index within a world
    tip_offset: wp.array[wp.transform],  # [G] fingertip frame in the frame of its link
    object_column: int,  # column of the object's position in ``joint_q_in``; its quaternion follows
    first_column: int,  # column of the first value
    # In:
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    body_q_in: wp.array2d[wp.transform],  # [N, B] link poses in the world frame
    # Out:
    observation_out: wp.array2d[float],  # [N, O] world vectors [SHAPE_UNIT_M], 3 columns a finger
):
    """Vector from each fingertip to the nearest point of the object's surface. Launch: [N, G]."""
    world, finger = wp.tid()
    shape = world_object[world]
    scale = world_scale[world]
    orientation = read_quat(world, object_column + 3, joint_q_in)
    tip = wp.transform_get_translation(
        fingertip_pose(body_q_in[world, tip_body[finger]], tip_offset[finger])
    )
    # The search is in the object's frame: one rotation of the fingertip instead of one of every
    # point.
    local = wp.quat_rotate_inv(orientation, tip - read_vec3(world, object_column, joint_q_in))
    nearest = scale * points[shape, 0] - local
    for i in range(1, points.shape[1]):
        vector = scale * points[shape, i] - local
        if wp.length_sq(vector) < wp.length_sq(nearest):
            nearest = vector
    value = wp.quat_rotate(orientation, nearest) / wp.static(SHAPE_UNIT_M)
    write_vec3(world, first_column + 3 * finger, value, observation_out)


@wp.func
def extent(
    points: wp.array2d[wp.vec3], shape: int, scale: float, orientation: wp.quat, direction: wp.vec3
) -> float:
    """How far a shape, scaled and turned, extends from its origin along ``direction`` [m]."""
    local = wp.quat_rotate_inv(orientation, direction)
    farthest = wp.dot(points[shape, 0], local)
    for i in range(1, points.shape[1]):
        farthest = wp.max(farthest, wp.dot(points[shape, i], local))
    return scale * farthest


@wp.kernel
def extent_kernel(
    # Model:
    points: wp.array2d[wp.vec3],  # [K, P] surface points of each object, object frame [m]
    world_object: wp.array[int],  # [N] object of each world
    world_scale: wp.array[float],  # [N] factor on the object's size in each world
    directions: wp.array[wp.vec3],  # [E] unit vectors in the world frame
    object_column: int,  # column of the object's position in ``joint_q_in``; its quaternion follows
    first_column: int,  # column of the first value
    # In:
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    goal_quat_in: wp.array[wp.quat],  # [N] wanted orientation of the object
    # Out:
    observation_out: wp.array2d[float],  # [N, O] E columns now and E at the goal
):
    """How far the object extends from its origin along world directions. Launch: [N, 2, E].

    The support function max_p direction . (q p) of the surface points, once with the present
    orientation q and once with the goal's; written as (extent - EXTENT_CENTRE_M) / SHAPE_UNIT_M.
    """
    world, goal, index = wp.tid()
    shape = world_object[world]
    orientation = read_quat(world, object_column + 3, joint_q_in)
    if goal != 0:
        orientation = goal_quat_in[world]
    reach = extent(points, shape, world_scale[world], orientation, directions[index])
    value = (reach - wp.static(EXTENT_CENTRE_M)) / wp.static(SHAPE_UNIT_M)
    observation_out[world, first_column + goal * directions.shape[0] + index] = value


@wp.kernel
def clearance_kernel(
    # Model:
    points: wp.array2d[wp.vec3],  # [K, P] surface points of each object, object frame [m]
    world_object: wp.array[int],  # [N] object of each world
    world_scale: wp.array[float],  # [N] factor on the object's size in each world
    object_column: int,  # column of the object's position in ``joint_q_in``; its quaternion follows
    table_top: float,  # height of the table's top, world frame [m]
    # In:
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    # Out:
    clearance_out: wp.array[float],  # [N] height [m], negative below the top
):
    """Height of the object's lowest point above the table's top, whether it is there or not.

    Launch: [N].
    """
    world = wp.tid()
    orientation = read_quat(world, object_column + 3, joint_q_in)
    down = wp.vec3(0.0, 0.0, -1.0)
    depth = extent(points, world_object[world], world_scale[world], orientation, down)
    clearance_out[world] = joint_q_in[world, object_column + 2] - depth - table_top
