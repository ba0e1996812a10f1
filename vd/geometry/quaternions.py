"""Rotations as quaternions xyzw [.., 4], tensors of torch or arrays of NumPy."""

from vd.geometry.arrays import Array, library_of


def product(first: Array, second: Array) -> Array:
    """``first * second``, quaternions xyzw [..., 4]: turns by the second, then by the first."""
    xp, a, aw, b, bw = (
        library_of(first),
        first[..., :3],
        first[..., 3:],
        second[..., :3],
        second[..., 3:],
    )
    vector = aw * b + bw * a + xp.linalg.cross(a, b)
    return xp.concatenate([vector, aw * bw - (a * b).sum(axis=-1, keepdims=True)], axis=-1)


def canonical(quat: Array) -> Array:
    """Of q and -q, one rotation, the one whose first of w, x, y, z that is not 0 is positive [..., 4]."""
    xp, first = library_of(quat), quat[..., 3]
    for i in range(3):
        first = xp.where(first == 0.0, quat[..., i], first)
    return xp.where(first[..., None] < 0.0, -quat, quat)


def relative_rotation(first: Array, second: Array) -> Array:
    """``first * conj(second)``, quaternions xyzw [..., 4]."""
    other = library_of(second).concatenate([-second[..., :3], second[..., 3:]], axis=-1)
    return product(first, other)


def rotation_distance(first: Array, second: Array) -> Array:
    """Angle between orientations, quaternions xyzw [..., 4], in [0, pi] [rad]."""
    xp, vector = library_of(first), relative_rotation(first, second)[..., :3]
    return 2.0 * xp.asin(xp.linalg.vector_norm(vector, axis=-1).clip(max=1.0))


def rotated(quat: Array, vector: Array) -> Array:
    """Vectors [..., 3] turned by quaternions xyzw [..., 4]."""
    cross, axis = library_of(quat).linalg.cross, quat[..., :3]
    twice = 2.0 * cross(axis, vector)
    return vector + quat[..., 3:] * twice + cross(axis, twice)


def poses_in(frame: Array, poses: Array) -> Array:
    """Poses [N, 7], position and quaternion, as seen from a frame [7]; both given in one."""
    xp = library_of(frame)
    back = xp.broadcast_to(xp.concatenate([-frame[3:6], frame[6:]]), (len(poses), 4))
    position = rotated(back, poses[:, :3] - frame[:3])
    return xp.concatenate([position, product(back, poses[:, 3:])], axis=1)
