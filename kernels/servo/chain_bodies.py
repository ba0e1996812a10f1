"""Bodies of a chain of revolute joints: mass matrix and bias forces in 3-D.

All vectors are in the frame of the chain's base with every joint at zero, so that link frames
differ by offsets only. SI units, radians.
"""

import functools
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

FEWEST = 3
"""Joints that a kernel has room for at least: compiling takes long, and one serves all short
chains.
"""


def room_for(joints: int) -> int:
    """Joints [n] that the kernel of a chain has room for."""
    return max(joints, FEWEST)


@functools.cache
def links_of_size(size: int) -> Any:
    """The structure that holds the bodies of a chain of up to ``size`` joints."""
    vector = wp.types.vector(length=size, dtype=float)
    rows = wp.types.matrix(shape=(size, 3), dtype=float)
    inertias = wp.types.matrix(shape=(3 * size, 3), dtype=float)

    @wp.struct
    class Links:
        """Bodies of a chain, in the base frame with all joints at zero.

        Rows beyond its joints are zero.
        """

        axis: rows  # unit joint axes, one a row
        offset: rows  # from the joint before (the base, for the first) to the joint, one a row [m]
        mass: vector  # masses of the links after each joint [kg]
        com: rows  # from the joint to the centre of mass, one a row [m]
        inertia: inertias  # about the centre of mass, three rows a link [kg m^2]
        gravity: wp.vec3  # acceleration of gravity [m/s^2]

    return Links


@wp.func
def chain_dynamics(q: Any, speed: Any, links: Any):
    """Mass matrix and bias torques (Coriolis, centrifugal, gravity) of the bodies.

    Outwards, each link in its own frame: the joints' axes and the velocities that they give to the
    link's joint are turned along, so that no inertia has to be. Loops are unrolled and the arrays
    in registers.

    Returns:
        ``(mass, bias)`` [n, n] and [n]; zero for links without mass.
    """
    bias = type(q)(0.0)
    mass = wp.outer(bias, bias)
    axes = type(links.axis)(0.0)
    levers = type(links.axis)(0.0)
    omega = wp.vec3(0.0)
    alpha = wp.vec3(0.0)
    acceleration = -links.gravity
    for i in range(len(q)):
        axis = links.axis[i]
        cosine = wp.cos(q[i])
        turn = (
            wp.diag(wp.vec3(cosine))
            - wp.sin(q[i]) * wp.skew(axis)
            + (1.0 - cosine) * wp.outer(axis, axis)
        )
        if i > 0:
            offset = links.offset[i]
            acceleration += wp.cross(alpha, offset) + wp.cross(omega, wp.cross(omega, offset))
            alpha = turn * (alpha + speed[i] * wp.cross(omega, axis))
            for j in range(len(q)):
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
        moved = type(links.axis)(0.0)
        for j in range(len(q)):
            if j <= i:
                lever = wp.cross(axes[j], arm)
                if j < i:
                    lever = levers[j] + lever
                moved[j] = lever
                bias[j] += wp.dot(axes[j], moment) + wp.dot(lever, force)
                turned = inertia * axes[j]
                for k in range(len(q)):
                    if k <= j:
                        mass[j, k] += wp.dot(turned, axes[k]) + weight * wp.dot(lever, moved[k])
    for j in range(len(q)):
        for k in range(len(q)):
            if k < j:
                mass[k, j] = mass[j, k]
    return mass, bias
