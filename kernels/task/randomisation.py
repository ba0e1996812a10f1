"""Domain randomisation of Table S3 and the disturbance force on the object.

Draws act on the worlds of an int32 mask; worlds outside it keep every bit. Ranges are (low, high).
"""

import warp as wp

from vd.kernels.rng import next_stream, uniform
from vd.kernels.servo.actuators import COMMAND_DELAY, KD, KP, READ_DELAY

wp.set_module_options({"enable_backward": False})


@wp.struct
class RandomisationParams:
    """Ranges of the draws; an array of length 1 in device memory."""

    friction: wp.vec2  # friction coefficient of the hand, and of the object
    link_mass_scale: wp.vec2  # factor on each link's mass
    action_offset_std: float  # standard deviation of the constant action error, in action units
    observation_offset_std: float  # standard deviation of the constant error of each observed value


@wp.struct
class ForceParams:
    """Settings of the disturbance force; an array of length 1 in device memory."""

    probability: float  # probability of a new force in a control step
    force_per_mass: float  # magnitude of a new force per mass of the object, c_d [N/kg]
    decay: float  # factor in a step without a new one: 0 in the paper, 0.998 in the released code


@wp.kernel
def draw_dynamics_kernel(
    # Model:
    nominal_kp: wp.array[float],  # [D] stiffness before randomisation [N m/rad]
    nominal_kd: wp.array[float],  # [D] damping before randomisation [N m s/rad]
    kp_scale: wp.array[wp.vec2],  # [D] range of the factor on the stiffness
    kd_scale: wp.array[wp.vec2],  # [D] range of the factor on the damping
    table_friction: wp.array[wp.vec2],  # [N] range of the friction coefficient of the table
    params: wp.array[RandomisationParams],  # [1] ranges
    # In:
    mask_in: wp.array[int],  # [N] 1 where a world is drawn anew
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    kp_out: wp.array2d[float],  # [N, D] stiffness [N m/rad], independent per joint
    kd_out: wp.array2d[float],  # [N, D] damping [N m s/rad], independent per joint
    hand_friction_out: wp.array[float],  # [N] friction coefficient of all hand shapes
    object_friction_out: wp.array[float],  # [N] friction coefficient of the object
    table_friction_out: wp.array[float],  # [N] friction coefficient of the table
    action_offset_out: wp.array2d[float],  # [N, D] constant action error, action units
    observation_offset_out: wp.array2d[float],  # [N, O] constant error of each observed value
):
    """Draw gains, frictions and constant errors of the masked worlds (Table S3). Launch: [N]."""
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
    state, drawn_table_friction = uniform(state, table_friction[world])
    hand_friction_out[world] = hand_friction
    object_friction_out[world] = object_friction
    table_friction_out[world] = drawn_table_friction
    for i in range(observation_offset_out.shape[1]):
        observation_offset_out[world, i] = settings.observation_offset_std * wp.randn(state)
    rng[world] = next_stream(state, world)


@wp.kernel
def draw_servo_kernel(
    # Model:
    ranges: wp.array2d[wp.vec2],  # [D, P] range of each joint's parameters; equal ends: not drawn
    # In:
    mask_in: wp.array[int],  # [N] 1 where a world is drawn anew
    kp_in: wp.array2d[float],  # [N, D] stiffness drawn for the world [N m/rad]
    kd_in: wp.array2d[float],  # [N, D] damping drawn for the world [N m s/rad]
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    parameters_out: wp.array2d[float],  # [N D, P] rows (:mod:`vd.kernels.servo.actuators`)
):
    """Draw the servo model of the joints of the masked worlds, each number for itself. Launch: [N].

    But the delays of commands and of readings are of the bus that all joints share: each is drawn
    once, as the same share of every joint's range.
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
def draw_masses_kernel(
    # Model:
    object_mass: wp.array[wp.vec2],  # [N] range of the mass of the object [kg]
    params: wp.array[RandomisationParams],  # [1] ranges
    # In:
    mask_in: wp.array[int],  # [N] 1 where a world is drawn anew
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    link_mass_scale_out: wp.array2d[float],  # [N, L] factor on each link's mass
    object_mass_out: wp.array[float],  # [N] mass of the object [kg]
):
    """Draw link and object masses of the masked worlds (Table S3). Launch: [N]."""
    world = wp.tid()
    if mask_in[world] == 0:
        return
    settings = params[0]
    state = rng[world]
    for link in range(link_mass_scale_out.shape[1]):
        state, scale = uniform(state, settings.link_mass_scale)
        link_mass_scale_out[world, link] = scale
    state, mass = uniform(state, object_mass[world])
    object_mass_out[world] = mass
    rng[world] = next_stream(state, world)


@wp.kernel
def scale_masses_kernel(
    level: float,  # in [0, 1]: 0 scales nothing, 1 by the whole factor, in between geometrically
    # Model:
    factor: wp.array[float],  # [B] factor on the mass of each body
    own_mass: wp.array[float],  # [B] mass before [kg]
    own_inv_mass: wp.array[float],  # [B] and its inverse, 0 of what does not move [1/kg]
    own_inertia: wp.array[wp.mat33],  # [B] inertia before [kg m^2]
    own_inv_inertia: wp.array[wp.mat33],  # [B] and its inverse [1/(kg m^2)]
    # Out:
    mass_out: wp.array[float],  # [B] mass [kg]
    inv_mass_out: wp.array[float],  # [B] inverse [1/kg]
    inertia_out: wp.array[wp.mat33],  # [B] inertia [kg m^2]
    inv_inertia_out: wp.array[wp.mat33],  # [B] inverse [1/(kg m^2)]
):
    """Scale masses, and inertias with them. Launch: [B]."""
    body = wp.tid()
    scale = wp.pow(factor[body], level)
    mass_out[body] = scale * own_mass[body]
    inv_mass_out[body] = own_inv_mass[body] / scale
    inertia_out[body] = scale * own_inertia[body]
    inv_inertia_out[body] = own_inv_inertia[body] / scale


@wp.kernel
def disturbance_force_kernel(
    # Model:
    object_mass: wp.array[float],  # [N] mass of the object [kg]
    params: wp.array[ForceParams],  # [1] settings
    # In/Out:
    force: wp.array[wp.vec3],  # [N] force at the object's centre of mass, world frame [N]
    rng: wp.array[wp.uint32],  # [N] random stream of each world
):
    """Disturbance force on the object for one control step (Supplementary Methods). Launch: [N].

    With the given probability a new force of magnitude c_d m in a uniform random direction;
    otherwise the old one times ``decay``.
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
