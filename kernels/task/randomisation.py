"""Domain randomisation of Table S3 and the disturbance force on the object.

Draws act on the worlds of an int32 mask; worlds outside it keep every bit. Ranges are (low, high).
"""

import warp as wp

from vd.kernels.rng import next_stream, uniform
from vd.kernels.servo.actuators import COMMAND_DELAY, KD, KP, READ_DELAY

wp.set_module_options({"enable_backward": False})


@wp.struct
class RandomisationParams:
    """Ranges of the draws; an array of length 1 in device memory.

    friction: Friction coefficient of the hand, and of the object.
    table_friction: Friction coefficient of the table.
    link_mass_scale: Factor on each link's mass.
    object_mass: Mass of the object [kg].
    action_offset_std: Standard deviation of the constant action error, in action units.
    observation_offset_std: Standard deviation of the constant error of each observed value.
    """

    friction: wp.vec2
    table_friction: wp.vec2
    link_mass_scale: wp.vec2
    object_mass: wp.vec2
    action_offset_std: float
    observation_offset_std: float


@wp.struct
class ForceParams:
    """Settings of the disturbance force; an array of length 1 in device memory.

    probability: Probability of a new force in a control step.
    force_per_mass: Magnitude of a new force per mass of the object, c_d [N/kg].
    decay: Factor on the force in a step without a new one: 0 in the paper, 0.998 in the released code.
    """

    probability: float
    force_per_mass: float
    decay: float


@wp.kernel
def draw_dynamics_kernel(
    # Model:
    nominal_kp: wp.array[float],
    nominal_kd: wp.array[float],
    kp_scale: wp.array[wp.vec2],
    kd_scale: wp.array[wp.vec2],
    params: wp.array[RandomisationParams],
    # In:
    mask_in: wp.array[int],
    # In/Out:
    rng: wp.array[wp.uint32],
    # Out:
    kp_out: wp.array2d[float],
    kd_out: wp.array2d[float],
    hand_friction_out: wp.array[float],
    object_friction_out: wp.array[float],
    table_friction_out: wp.array[float],
    action_offset_out: wp.array2d[float],
    observation_offset_out: wp.array2d[float],
):
    """Draw gains, frictions and constant errors of the masked worlds (Table S3). Launch: [N].

    Args:
        nominal_kp: Stiffness before randomisation [N m/rad], shape [D].
        nominal_kd: Damping before randomisation [N m s/rad], shape [D].
        kp_scale: Range of the factor on the stiffness, shape [D].
        kd_scale: Range of the factor on the damping, shape [D].
        params: Ranges, shape [1].
        mask_in: 1 where a world is drawn anew, shape [N].
        rng: Random stream of each world, shape [N].
        kp_out: Stiffness [N m/rad], independent per joint, shape [N, D].
        kd_out: Damping [N m s/rad], independent per joint, shape [N, D].
        hand_friction_out: Friction coefficient of all hand shapes, shape [N].
        object_friction_out: Friction coefficient of the object, shape [N].
        table_friction_out: Friction coefficient of the table, shape [N].
        action_offset_out: Constant action error, action units, shape [N, D].
        observation_offset_out: Constant error of each observed value, shape [N, O].
    """
    world = wp.tid()
    if mask_in[world] == 0:
        return
    settings = params[0]
    state = rng[world]

    for joint in range(nominal_kp.shape[0]):
        state, kp_factor = uniform(state, kp_scale[joint])
        state, kd_factor = uniform(state, kd_scale[joint])
        kp_out[world, joint] = nominal_kp[joint] * kp_factor
        kd_out[world, joint] = nominal_kd[joint] * kd_factor
        action_offset_out[world, joint] = settings.action_offset_std * wp.randn(state)
    state, hand_friction = uniform(state, settings.friction)
    state, object_friction = uniform(state, settings.friction)
    state, table_friction = uniform(state, settings.table_friction)
    hand_friction_out[world] = hand_friction
    object_friction_out[world] = object_friction
    table_friction_out[world] = table_friction
    for i in range(observation_offset_out.shape[1]):
        observation_offset_out[world, i] = settings.observation_offset_std * wp.randn(state)
    rng[world] = next_stream(state, world)


@wp.kernel
def draw_servo_kernel(
    # Model:
    ranges: wp.array2d[wp.vec2],
    # In:
    mask_in: wp.array[int],
    kp_in: wp.array2d[float],
    kd_in: wp.array2d[float],
    # In/Out:
    rng: wp.array[wp.uint32],
    # Out:
    parameters_out: wp.array2d[float],
):
    """Draw the servo model of the joints of the masked worlds, each number for itself. Launch: [N].

    But the delays of commands and of readings are of the bus that all joints share: each is drawn once, as
    the same share of every joint's range.

    Args:
        ranges: Range of each parameter of each joint, shape [D, P]; equal ends draw nothing.
        mask_in: 1 where a world is drawn anew, shape [N].
        kp_in: Stiffness drawn for the world [N m/rad], shape [N, D].
        kd_in: Damping drawn for the world [N m s/rad], shape [N, D].
        rng: Random stream of each world, shape [N].
        parameters_out: Rows of parameters (:mod:`vd.kernels.servo.actuators`), shape [N D, P].
    """
    world = wp.tid()
    if mask_in[world] == 0:
        return
    state = rng[world]
    joints = ranges.shape[0]
    commanded = wp.randf(state)
    read = wp.randf(state)
    for joint in range(joints):
        row = world * joints + joint
        for column in range(ranges.shape[1]):
            bounds = ranges[joint, column]
            value = bounds[0]
            if bounds[1] > bounds[0]:
                if column == COMMAND_DELAY:
                    value = wp.lerp(bounds[0], bounds[1], commanded)
                elif column == READ_DELAY:
                    value = wp.lerp(bounds[0], bounds[1], read)
                else:
                    state, value = uniform(state, bounds)
            parameters_out[row, column] = value
        parameters_out[row, KP] = kp_in[world, joint]
        parameters_out[row, KD] = kd_in[world, joint]
    rng[world] = next_stream(state, world)


@wp.kernel
def draw_restitution_kernel(
    # Model:
    bounds: wp.vec2,
    # In:
    mask_in: wp.array[int],
    # In/Out:
    rng: wp.array[wp.uint32],
    # Out:
    hand_out: wp.array[float],
    object_out: wp.array[float],
    table_out: wp.array[float],
):
    """Draw the coefficients of restitution of the masked worlds (Table S3). Launch: [N].

    Args:
        bounds: Range of each.
        mask_in: 1 where a world is drawn anew, shape [N].
        rng: Random stream of each world, shape [N].
        hand_out: Restitution of all hand shapes, shape [N].
        object_out: Restitution of the object, shape [N].
        table_out: Restitution of the table, shape [N].
    """
    world = wp.tid()
    if mask_in[world] == 0:
        return
    state = rng[world]
    state, of_hand = uniform(state, bounds)
    state, of_object = uniform(state, bounds)
    state, of_table = uniform(state, bounds)
    hand_out[world] = of_hand
    object_out[world] = of_object
    table_out[world] = of_table
    rng[world] = next_stream(state, world)


@wp.kernel
def draw_masses_kernel(
    # Model:
    params: wp.array[RandomisationParams],
    # In:
    mask_in: wp.array[int],
    # In/Out:
    rng: wp.array[wp.uint32],
    # Out:
    link_mass_scale_out: wp.array2d[float],
    object_mass_out: wp.array[float],
):
    """Draw link and object masses of the masked worlds (Table S3). Launch: [N].

    Args:
        params: Ranges, shape [1].
        mask_in: 1 where a world is drawn anew, shape [N].
        rng: Random stream of each world, shape [N].
        link_mass_scale_out: Factor on each link's mass, shape [N, L].
        object_mass_out: Mass of the object [kg], shape [N].
    """
    world = wp.tid()
    if mask_in[world] == 0:
        return
    settings = params[0]
    state = rng[world]
    for link in range(link_mass_scale_out.shape[1]):
        state, scale = uniform(state, settings.link_mass_scale)
        link_mass_scale_out[world, link] = scale
    state, mass = uniform(state, settings.object_mass)
    object_mass_out[world] = mass
    rng[world] = next_stream(state, world)


@wp.kernel
def disturbance_force_kernel(
    # Model:
    object_mass: wp.array[float],
    params: wp.array[ForceParams],
    # In/Out:
    force: wp.array[wp.vec3],
    rng: wp.array[wp.uint32],
):
    """Disturbance force on the object for one control step (Supplementary Methods). Launch: [N].

    With the given probability a new force of magnitude c_d m in a uniform random direction; otherwise
    the old one times ``decay``.

    Args:
        object_mass: Mass of the object [kg], shape [N].
        params: Settings, shape [1].
        force: Force at the object's centre of mass, world frame [N], shape [N].
        rng: Random stream of each world, shape [N].
    """
    world = wp.tid()
    settings = params[0]
    state = rng[world]
    if wp.randf(state) < settings.probability:
        direction = wp.sample_unit_sphere_surface(state)
        force[world] = settings.force_per_mass * object_mass[world] * direction
    else:
        force[world] = settings.decay * force[world]
    rng[world] = next_stream(state, world)
