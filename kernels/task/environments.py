"""Bookkeeping over worlds: masks, statistics, and randomised values written into the simulator's model."""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3

wp.set_module_options({"enable_backward": False})


@wp.kernel
def redraw_mask_kernel(
    # In:
    reset_in: wp.array[wp.int32],
    interval: int,
    # In/Out:
    age: wp.array[wp.int32],
    # Out:
    mask_out: wp.array[wp.int32],
):
    """Select worlds that reset and whose dynamics are at least ``interval`` control steps old.

    Args:
        reset_in: 1 where a world resets in this step, shape [N].
        interval: Control steps for which drawn dynamics are kept at least.
        age: Control steps since the last draw, shape [N]; counted here, zeroed where selected.
        mask_out: 1 where dynamics are to be drawn anew, shape [N].
    """
    world = wp.tid()
    age[world] = age[world] + 1
    mask_out[world] = 0
    if reset_in[world] != 0 and age[world] >= interval:
        mask_out[world] = 1
        age[world] = 0


@wp.kernel
def write_gains_kernel(
    # In:
    kp_in: wp.array2d[float],
    kd_in: wp.array2d[float],
    # Out:
    model_kp: wp.array2d[float],
    model_kd: wp.array2d[float],
):
    """Copy gains, shape [N, D], into the first D columns of the model's. Launch [N, D]."""
    world, joint = wp.tid()
    model_kp[world, joint] = kp_in[world, joint]
    model_kd[world, joint] = kd_in[world, joint]


@wp.kernel
def write_friction_kernel(
    # Model:
    shape_world: wp.array[wp.int32],
    shape_kind: wp.array[wp.int32],
    nominal: wp.array[float],
    nominal_hand: float,
    kind_table: int,
    kind_object: int,
    kind_hand: int,
    # In:
    hand_friction: wp.array[float],
    object_friction: wp.array[float],
    table_friction: wp.array[float],
    # Out:
    friction_out: wp.array[float],
):
    """Write each shape's friction so that the solver's pair value is the average of the two bodies'.

    The solver takes the friction of the geom with the higher priority: table over hand over object.
    So the table carries the average of table and object, a hand shape that of hand and object; a
    fingertip whose material differs from the nominal hand's keeps its ratio to it. Launch [S].

    Args:
        shape_world: World of each shape, shape [S].
        shape_kind: Kind of each shape, shape [S].
        nominal: Friction of each shape before randomisation, shape [S].
        nominal_hand: Friction of the hand that ``hand_friction`` replaces.
        kind_table: Kind of the table.
        kind_object: Kind of the object's parts.
        kind_hand: Kind of the hand's shapes.
        hand_friction: Friction of the hand in each world, shape [N].
        object_friction: Friction of the object in each world, shape [N].
        table_friction: Friction of the table in each world, shape [N].
        friction_out: Friction of each shape, shape [S].
    """
    shape = wp.tid()
    world = shape_world[shape]
    if world < 0:
        return
    kind = shape_kind[shape]
    if kind == kind_object:
        friction_out[shape] = object_friction[world]
    elif kind == kind_table:
        friction_out[shape] = 0.5 * (table_friction[world] + object_friction[world])
    elif kind == kind_hand:
        hand = hand_friction[world] * nominal[shape] / nominal_hand
        friction_out[shape] = 0.5 * (hand + object_friction[world])


@wp.kernel
def write_object_force_kernel(
    # Model:
    object_mass: wp.array[float],
    lightened: wp.array[wp.int32],
    gravity: wp.vec3,
    weight: wp.array[float],
    object_body: int,
    # In:
    force_in: wp.array[wp.vec3],
    # Out:
    body_force_out: wp.array2d[wp.spatial_vector],
):
    """Write a force at the object's centre of mass, and what carries a part of its weight. Launch: [N].

    Args:
        object_mass: Mass of the object [kg], shape [N].
        lightened: 1 where a part of the weight is carried, shape [N].
        gravity: Acceleration of gravity [m/s^2].
        weight: Share of its weight that a lightened object has left, shape [1].
        object_body: The object's body within a world.
        force_in: Force on the object, world frame [N], shape [N].
        body_force_out: Force and torque on each body [N, N m], shape [N, B]; only the object's is written.
    """
    world = wp.tid()
    force = force_in[world]
    if lightened[world] != 0:
        force -= (1.0 - weight[0]) * object_mass[world] * gravity
    body_force_out[world, object_body] = wp.spatial_vector(force, wp.vec3(0.0))


@wp.kernel
def place_table_kernel(
    # Model:
    geom_kind: wp.array2d[wp.int32],
    kind_table: int,
    # In:
    step_count: wp.array[wp.int32],
    last_step: wp.array[wp.int32],
    height: float,
    away: float,
    # In/Out:
    geom_pos: wp.array2d[wp.vec3],
):
    """Put each world's table where it belongs, or away once its time in the episode is over. Launch: [N, G].

    Args:
        geom_kind: Kind of each geom, shape [N, G].
        kind_table: Kind of the table.
        step_count: Control steps since the world's reset, shape [N].
        last_step: Control steps for which the table of each world stays, shape [N].
        height: Height of its top [m].
        away: Height of its top where it is out of reach [m].
        geom_pos: Positions of the geoms [m], shape [N, G]; only the heights of tables are written.
    """
    world, geom = wp.tid()
    if geom_kind[world, geom] != kind_table:
        return
    position = geom_pos[world, geom]
    position[2] = wp.where(step_count[world] < last_step[world], height, away)
    geom_pos[world, geom] = position


@wp.kernel
def record_step_kernel(
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
    values_in: wp.array2d[float],
    # Out:
    values_out: wp.array2d[float],
):
    """Copy the first columns of a wider array; copies of slices cannot be in a graph. Launch: [N, D].

    Args:
        values_in: Values, shape [N, >= D].
        values_out: Its first columns, shape [N, D].
    """
    world, column = wp.tid()
    values_out[world, column] = values_in[world, column]
