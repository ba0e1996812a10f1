"""Rotations as quaternions xyzw [.., 4], tensors of torch or arrays of NumPy."""

from vd.geometry.arrays import Array, library_of


def product(first: Array, second: Array) -> Array:
    """``first * second``, quaternions xyzw [..., 4]: turns by the second, then by the first."""
    xp = library_of(first)
    first_vector = first[..., :3]
    first_scalar = first[..., 3:]
    second_vector = second[..., :3]
    second_scalar = second[..., 3:]
    vector = (
        first_scalar * second_vector
        + second_scalar * first_vector
        + xp.linalg.cross(first_vector, second_vector)
    )
    dot = (first_vector * second_vector).sum(axis=-1, keepdims=True)
    return xp.concatenate([vector, first_scalar * second_scalar - dot], axis=-1)


def canonical(quat: Array) -> Array:
    """Of q and -q, one rotation, the one whose first of w, x, y, z that is not 0 is positive [..., 4]."""
    xp = library_of(quat)
    leading = quat[..., 3]
    for i in range(3):
        leading = xp.where(leading == 0.0, quat[..., i], leading)
    return xp.where(leading[..., None] < 0.0, -quat, quat)


def relative_rotation(first: Array, second: Array) -> Array:
    """``first * conj(second)``, quaternions xyzw [..., 4]."""
    other = library_of(second).concatenate([-second[..., :3], second[..., 3:]], axis=-1)
    return product(first, other)


def rotation_distance(first: Array, second: Array) -> Array:
    """Angle between orientations, quaternions xyzw [..., 4], in [0, pi] [rad]."""
    xp = library_of(first)
    turn = relative_rotation(first, second)
    return 2.0 * xp.atan2(xp.linalg.vector_norm(turn[..., :3], axis=-1), abs(turn[..., 3]))


def rotated(quat: Array, vector: Array) -> Array:
    """Vectors [..., 3] turned by quaternions xyzw [..., 4]."""
    cross = library_of(quat).linalg.cross
    axis = quat[..., :3]
    twice = 2.0 * cross(axis, vector)
    return vector + quat[..., 3:] * twice + cross(axis, twice)


def poses_in(frame: Array, poses: Array) -> Array:
    """Poses [N, 7], position and quaternion, as seen from a frame [7]; both given in one."""
    xp = library_of(frame)
    back = xp.broadcast_to(xp.concatenate([-frame[3:6], frame[6:]]), (len(poses), 4))
    position = rotated(back, poses[:, :3] - frame[:3])
    return xp.concatenate([position, product(back, poses[:, 3:])], axis=1)
