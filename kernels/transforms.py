"""Rotations: differences, angles, uniform draws on SO(3).

Quaternions are xyzw and of unit length; angles are in radians.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.14159265358979)


@wp.func
def rotation_difference(q: wp.quat, q_goal: wp.quat) -> wp.quat:
    """Rotation from ``q_goal`` to ``q`` in the world frame: q * conj(q_goal)."""
    return q * wp.quat(-q_goal[0], -q_goal[1], -q_goal[2], q_goal[3])


@wp.func
def rotation_angle(q: wp.quat) -> float:
    """Angle of the rotation ``q`` in [0, pi]: 2 asin(min(norm(vec(q)), 1)).

    The same for q and -q.
    """
    return 2.0 * wp.asin(wp.min(wp.length(wp.vec3(q[0], q[1], q[2])), 1.0))


@wp.func
def rotation_vector(q: wp.quat) -> wp.vec3:
    """Axis times angle of the rotation ``q``, at most pi long.

    The same for q and -q.
    """
    vector = wp.vec3(q[0], q[1], q[2])
    if q[3] < 0.0:
        vector = -vector
    sine = wp.length(vector)
    if sine == 0.0:
        return wp.vec3()
    return 2.0 * wp.atan2(sine, wp.abs(q[3])) / sine * vector


@wp.func
def canonical(q: wp.quat) -> wp.quat:
    """Of ``q`` and ``-q``, the same rotation, the one whose first of w, x, y, z that is not 0 is positive."""
    first = q[3]
    for i in range(3):
        if first == 0.0:
            first = q[i]
    if first < 0.0:
        return wp.quat(-q[0], -q[1], -q[2], -q[3])
    return q


@wp.func
def goal_beside(goal: wp.quat, q: wp.quat) -> wp.quat:
    """Of ``goal`` and ``-goal`` the one from which the rotation to ``q`` is canonical."""
    turn = rotation_difference(q, goal)
    kept = canonical(turn)
    if kept[0] != turn[0] or kept[1] != turn[1] or kept[2] != turn[2] or kept[3] != turn[3]:
        return wp.quat(-goal[0], -goal[1], -goal[2], -goal[3])
    return goal


@wp.func
def random_rotation(rng: wp.uint32):
    """Draw uniformly from SO(3): four standard normals, normalised.

    Returns ``(rng, quaternion)``.
    """
    x = wp.randn(rng)
    y = wp.randn(rng)
    z = wp.randn(rng)
    w = wp.randn(rng)
    return rng, wp.normalize(wp.quat(x, y, z, w))


@wp.func
def random_rotation_within(rng: wp.uint32, max_angle: float):
    """Draw uniformly (Haar) among the rotations of at most ``max_angle``.

    Returns ``(rng, quaternion)``.

    The axis is uniform on the sphere and the angle has density proportional to 1 - cos(angle) on
    [0, max_angle]. It is drawn by rejection from the density proportional to angle^2, which bounds
    it (1 - cos(a) <= a^2 / 2); 61 % are accepted at max_angle = pi, more below. ``max_angle >= pi``
    is all of SO(3).
    """
    bound = wp.clamp(max_angle, 0.0, PI)
    half = wp.float32(0.0)
    accepted = wp.bool(False)
    while not accepted:
        half = 0.5 * bound * wp.pow(1.0 - wp.randf(rng), 1.0 / 3.0)
        sine = wp.sin(half)
        accepted = wp.randf(rng) * half * half <= sine * sine
    axis = wp.sample_unit_sphere_surface(rng)
    vector = axis * wp.sin(half)
    return rng, wp.quat(vector[0], vector[1], vector[2], wp.cos(half))
