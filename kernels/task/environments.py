"""Bookkeeping over worlds.

Masks, statistics, and randomised values written into the simulator's model.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3

wp.set_module_options({"enable_backward": False})


@wp.kernel
def redraw_mask_kernel(
    # In:
    reset_in: wp.array[wp.int32],  # [N] 1 where a world resets in this step
    interval: int,  # control steps for which drawn dynamics are kept at least
    # In/Out:
    age: wp.array[wp.int32],  # [N] control steps since the last draw; counted, or zeroed
    # Out:
    mask_out: wp.array[wp.int32],  # [N] 1 where dynamics are to be drawn anew
):
    """Select worlds that reset and whose dynamics are at least ``interval`` control steps old."""
    world = wp.tid()
    age[world] = age[world] + 1
    mask_out[world] = 0
    if reset_in[world] != 0 and age[world] >= interval:
        mask_out[world] = 1
        age[world] = 0


@wp.kernel
def write_friction_kernel(
    # Model:
    shape_world: wp.array[wp.int32],  # [S] world of each shape
    shape_kind: wp.array[wp.int32],  # [S] kind of each shape
    nominal: wp.array[float],  # [S] friction of each shape before randomisation
    table_share: wp.array[float],  # [N] share of the table's friction in the pair's; 1: all
    nominal_hand: float,  # friction of the hand that ``hand_friction`` replaces
    kind_table: int,  # kind of the table
    kind_object: int,  # kind of the object's parts
    kind_hand: int,  # kind of the hand's shapes
    # In:
    hand_friction: wp.array[float],  # [N] friction of the hand in each world
    object_friction: wp.array[float],  # [N] friction of the object in each world
    table_friction: wp.array[float],  # [N] friction of the table in each world
    # Out:
    friction_out: wp.array[float],  # [S] friction of each shape
):
    """Write each shape's friction so that the solver's pair value is the average of the two bodies'.

    The solver takes the friction of the geom with the higher priority: table over hand over object.
    So the table carries the average of table and object, unless the pair's was measured, a hand
    shape that of hand and object; a fingertip whose material differs from the nominal hand's keeps
    its ratio to it. Launch [S].
    """
    shape = wp.tid()
    world = shape_world[shape]
    if world < 0:
        return
    kind = shape_kind[shape]
    if kind == kind_object:
        friction_out[shape] = object_friction[world]
    elif kind == kind_table:
        share = table_share[world]
        friction_out[shape] = share * table_friction[world] + (1.0 - share) * object_friction[world]
    elif kind == kind_hand:
        hand = hand_friction[world] * nominal[shape] / nominal_hand
        friction_out[shape] = 0.5 * (hand + object_friction[world])


@wp.kernel
def write_object_force_kernel(
    # Model:
    object_mass: wp.array[float],  # [N] mass of the object [kg]
    lightened: wp.array[wp.int32],  # [N] 1 where a part of the weight is carried
    gravity: wp.vec3,  # acceleration of gravity [m/s^2]
    weight: wp.array[float],  # [1] share of its weight that a lightened object has left
    object_body: int,  # the object's body within a world
    # In:
    force_in: wp.array[wp.vec3],  # [N] force on the object, world frame [N]
    # Out:
    body_force_out: wp.array2d[wp.spatial_vector],  # [N, B] force, torque [N, N m], of the object
):
    """Write a force at the object's centre of mass, and what carries a part of its weight.

    Launch: [N].
    """
    world = wp.tid()
    force = force_in[world]
    if lightened[world] != 0:
        force -= (1.0 - weight[0]) * object_mass[world] * gravity
    body_force_out[world, object_body] = wp.spatial_vector(force, wp.vec3(0.0))


@wp.kernel
def place_table_kernel(
    # Model:
    geom_kind: wp.array2d[wp.int32],  # [N, G] kind of each geom
    kind_table: int,  # kind of the table
    # In:
    step_count: wp.array[wp.int32],  # [N] control steps since the world's reset
    last_step: wp.array[wp.int32],  # [N] control steps for which the table of each world stays
    height: float,  # height of its top [m]
    away: float,  # height of its top where it is out of reach [m]
    # In/Out:
    geom_pos: wp.array2d[wp.vec3],  # [N, G] positions [m]; only the heights of tables are written
):
    """Put each world's table where it belongs, or away once its time is over. Launch: [N, G]."""
    world, geom = wp.tid()
    if geom_kind[world, geom] != kind_table:
        return
    position = geom_pos[world, geom]
    position[2] = wp.where(step_count[world] < last_step[world], height, away)
    geom_pos[world, geom] = position


@wp.kernel
def keep_object_pose_kernel(
    # In:
    joint_q: wp.array2d[float],
    object_column: int,
    # Out:
    object_pose_out: wp.array[wp.transform],
):
    """Copy the object's pose (world frame) out of the joint positions, shape [N]."""
    world = wp.tid()
    object_pose_out[world] = wp.transform(
        read_vec3(world, object_column, joint_q), read_quat(world, object_column + 3, joint_q)
    )


@wp.kernel
def copy_columns_kernel(
    # In:
    values_in: wp.array2d[float],  # [N, >= D] values
    # Out:
    values_out: wp.array2d[float],  # [N, >= D] the first D columns are written
):
    """Copy the first columns of an array; copies of slices cannot be in a graph. Launch: [N, D]."""
    world, column = wp.tid()
    values_out[world, column] = values_in[world, column]
