"""Rotations as quaternions xyzw, and as two columns of their matrix for networks to predict (Zhou 2019)."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn


def random_rotations(count: int, device: torch.device) -> torch.Tensor:
    """Quaternions uniform on SO(3), xyzw [count, 4]."""
    return nn.functional.normalize(torch.randn((count, 4), device=device), dim=-1)


def rotations_about(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Quaternions xyzw [R, 4] about axes [R, 3], which need no unit length, by angles [R] [rad]."""
    half = 0.5 * angle[:, None]
    return torch.cat([nn.functional.normalize(axis, dim=-1) * half.sin(), half.cos()], dim=1)


def two_columns(quaternion: torch.Tensor) -> torch.Tensor:
    """First two columns of the matrices of quaternions xyzw [.., 4], one after the other.

    [.., 6].
    """
    x, y, z, w = quaternion.unbind(-1)
    return torch.stack(
        (
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y + z * w),
            2.0 * (x * z - y * w),
            2.0 * (x * y - z * w),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z + x * w),
        ),
        dim=-1,
    )


def first_columns(matrix: torch.Tensor) -> torch.Tensor:
    """First two columns of matrices [.., 3, 3], one after the other [.., 6]."""
    return torch.cat([matrix[..., 0], matrix[..., 1]], dim=-1)


def matrices(columns: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [.., 3, 3] nearest to two columns [.., 6], by Gram and Schmidt."""
    first = nn.functional.normalize(columns[..., :3], dim=-1)
    second = columns[..., 3:]
    second = nn.functional.normalize(
        second - (first * second).sum(-1, keepdim=True) * first, dim=-1
    )
    return torch.stack((first, second, torch.linalg.cross(first, second)), dim=-1)


def quaternions(matrix: torch.Tensor) -> torch.Tensor:
    """Quaternions xyzw [.., 4] of rotation matrices [.., 3, 3]; of either sign."""
    m = matrix.flatten(-2)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = m.unbind(-1)
    x, y, z, w = 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz
    # Each row is the quaternion times four of its own numbers: the one of the largest loses no
    # digits.
    rows = torch.stack(
        [
            torch.stack([x, xy + yx, xz + zx, zy - yz], dim=-1),
            torch.stack([xy + yx, y, yz + zy, xz - zx], dim=-1),
            torch.stack([xz + zx, yz + zy, z, yx - xy], dim=-1),
            torch.stack([zy - yz, xz - zx, yx - xy, w], dim=-1),
        ],
        dim=-2,
    )
    best = torch.stack([x, y, z, w], dim=-1).argmax(dim=-1)[..., None, None]
    return nn.functional.normalize(rows.take_along_dim(best, dim=-2).squeeze(-2), dim=-1)


def turn_angle(matrix: torch.Tensor) -> torch.Tensor:
    """Angles [..] in [0, pi] [rad] of rotation matrices [.., 3, 3].

    Exact for small ones, as acos is not.
    """
    half = (matrix - torch.eye(3, device=matrix.device)).square().sum((-1, -2)).sqrt() / math.sqrt(
        8.0
    )
    return 2.0 * torch.asin(half.clamp(max=1.0))


def chord(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Distances [..] of rotation matrices [.., 3, 3]: about 1.4 times the angle where it is small.

    As a loss it is robust: of rotations that look alike it chooses one, and gives no mean of them.
    """
    return ((first - second).square().sum((-1, -2)) + 1e-6).sqrt()


def cube_rotations(device: torch.device | str) -> torch.Tensor:
    """The 24 rotations of a cube onto itself, matrices [24, 3, 3], the identity first."""
    group = Rotation.create_group("O").as_matrix()
    order = sorted(group, key=lambda matrix: -matrix.trace())
    return torch.tensor(np.array(order), dtype=torch.float32, device=device)
