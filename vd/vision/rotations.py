"""Rotations as quaternions xyzw, and as two columns of their matrix for networks to predict (Zhou 2019)."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize


def random_rotations(count: int, device: torch.device) -> Tensor:
    """Quaternions uniform on SO(3), xyzw [count, 4]."""
    return normalize(torch.randn((count, 4), device=device), dim=-1)


def matrices_about(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotation matrices [R, 3, 3] about axes [R, 3], which need no unit length, by angles [R] [rad]."""
    half = 0.5 * angle[:, None]
    vector = normalize(axis, dim=-1) * half.sin()
    return quaternion_matrices(torch.cat([vector, half.cos()], dim=1))


def quaternion_matrices(quaternion: Tensor) -> Tensor:
    """Rotation matrices [.., 3, 3] of quaternions xyzw [.., 4]."""
    x, y, z, w = quaternion.unbind(-1)
    columns = [
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y + z * w),
        2.0 * (x * z - y * w),
        2.0 * (x * y - z * w),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z + x * w),
    ]
    return matrices(torch.stack(columns, dim=-1))


def first_columns(matrix: Tensor) -> Tensor:
    """First two columns of matrices [.., 3, 3], one after the other [.., 6]."""
    return matrix[..., :2].mT.flatten(-2)


def matrices(columns: Tensor) -> Tensor:
    """Rotation matrices [.., 3, 3] nearest to two columns [.., 6], by Gram and Schmidt."""
    first = normalize(columns[..., :3], dim=-1)
    second = columns[..., 3:]
    along = (first * second).sum(-1, keepdim=True)
    second = normalize(second - along * first, dim=-1)
    third = torch.linalg.cross(first, second)
    return torch.stack([first, second, third], dim=-1)


def quaternions(matrix: Tensor) -> Tensor:
    """Quaternions xyzw [.., 4] of rotation matrices [.., 3, 3]; of either sign."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrix.flatten(-2).unbind(-1)
    # Each row is the quaternion times four of its own numbers: the one of the largest loses no
    # digits.
    products = [
        1 + xx - yy - zz,
        xy + yx,
        xz + zx,
        zy - yz,
        xy + yx,
        1 - xx + yy - zz,
        yz + zy,
        xz - zx,
        xz + zx,
        yz + zy,
        1 - xx - yy + zz,
        yx - xy,
        zy - yz,
        xz - zx,
        yx - xy,
        1 + xx + yy + zz,
    ]
    rows = torch.stack(products, dim=-1).unflatten(-1, (4, 4))
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = rows.take_along_dim(best[..., None, None], dim=-2)
    return normalize(row.squeeze(-2), dim=-1)


def turn_angle(matrix: Tensor) -> Tensor:
    """Angles [..] in [0, pi] [rad] of rotation matrices [.., 3, 3].

    Exact for small ones, as acos is not.
    """
    difference = matrix - torch.eye(3, device=matrix.device)
    norm = difference.square().sum((-1, -2)).sqrt()
    half_sine = norm / math.sqrt(8.0)
    return 2.0 * torch.asin(half_sine.clamp(max=1.0))


def chord(first: Tensor, second: Tensor) -> Tensor:
    """Distances [..] of rotation matrices [.., 3, 3]: about 1.4 times the angle where it is small.

    As a loss it is robust: of rotations that look alike it chooses one, and gives no mean of them.
    """
    square = (first - second).square().sum((-1, -2))
    return (square + 1e-6).sqrt()


def cube_rotations(device: torch.device | str) -> Tensor:
    """The 24 rotations of a cube onto itself, matrices [24, 3, 3], the identity first."""
    group = Rotation.create_group("O").as_matrix()
    order = sorted(group, key=lambda matrix: -matrix.trace())
    every = np.array(order)
    return torch.tensor(every, dtype=torch.float32, device=device)
