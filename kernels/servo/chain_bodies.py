"""Bodies of a chain of one to three revolute joints: mass matrix and bias forces in 3-D.

All vectors are in the frame of the chain's base with every joint at zero, so that link frames differ
by offsets only. SI units, radians.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_JOINTS = 3
"""Joints of a chain at most: Warp's vectors of three hold them."""
mat93 = wp.types.matrix(shape=(3 * MAX_JOINTS, 3), dtype=float)


@wp.struct
class Links:
    """Bodies of a chain, in the base frame with all joints at zero; rows beyond its joints are zero."""

    axis: wp.mat33  # unit joint axes, one a row
    offset: wp.mat33  # from the joint before (the base, for the first) to the joint, one a row [m]
    mass: wp.vec3  # masses of the links after each joint [kg]
    com: wp.mat33  # from the joint to the centre of mass, one a row [m]
    inertia: mat93  # about the centre of mass, three rows a link [kg m^2]
    gravity: wp.vec3  # acceleration of gravity [m/s^2]


@wp.func
def chain_dynamics(q: wp.vec3, speed: wp.vec3, links: Links):
    """Mass matrix and bias torques (Coriolis, centrifugal, gravity) of the bodies.

    Outwards, each link in its own frame: the joints' axes and the velocities that they give to the link's
    joint are turned along, so that no inertia has to be. Loops are unrolled and the arrays in registers.

    Returns:
        ``(mass, bias)`` [3, 3] and [3]; zero for links without mass.
    """
    mass = wp.mat33(0.0)
    bias = wp.vec3(0.0)
    axes = wp.mat33(0.0)
    levers = wp.mat33(0.0)
    omega = wp.vec3(0.0)
    alpha = wp.vec3(0.0)
    acceleration = -links.gravity
    for i in range(MAX_JOINTS):
        axis = links.axis[i]
        cosine = wp.cos(q[i])
        turn = wp.diag(wp.vec3(cosine)) - wp.sin(q[i]) * wp.skew(axis) + (1.0 - cosine) * wp.outer(axis, axis)
        if i > 0:
            offset = links.offset[i]
            acceleration += wp.cross(alpha, offset) + wp.cross(omega, wp.cross(omega, offset))
            alpha = turn * (alpha + speed[i] * wp.cross(omega, axis))
            for j in range(MAX_JOINTS):
                if j < i:
                    levers[j] = turn * (levers[j] + wp.cross(axes[j], offset))
                    axes[j] = turn * axes[j]
            omega = turn * omega
        omega += speed[i] * axis
        acceleration = turn * acceleration
        axes[i] = axis

        arm = links.com[i]
        inertia = wp.matrix_from_rows(
            links.inertia[3 * i], links.inertia[3 * i + 1], links.inertia[3 * i + 2]
        )
        weight = links.mass[i]
        pushed = acceleration
        moment = wp.cross(omega, inertia * omega)
        if i > 0:  # the base does not turn
            pushed += wp.cross(alpha, arm)
            moment = inertia * alpha + moment
        force = weight * (pushed + wp.cross(omega, wp.cross(omega, arm)))
        moved = wp.mat33(0.0)
        for j in range(MAX_JOINTS):
            if j <= i:
                lever = wp.cross(axes[j], arm)
                if j < i:
                    lever = levers[j] + lever
                moved[j] = lever
                bias[j] += wp.dot(axes[j], moment) + wp.dot(lever, force)
                turned = inertia * axes[j]
                for k in range(MAX_JOINTS):
                    if k <= j:
                        mass[j, k] += wp.dot(turned, axes[k]) + weight * wp.dot(lever, moved[k])
    for j in range(MAX_JOINTS):
        for k in range(MAX_JOINTS):
            if k < j:
                mass[k, j] = mass[j, k]
    return mass, bias
