"""Rotations as quaternions xyzw, and as two columns of their matrix for networks to predict (Zhou 2019)."""

import torch
from torch import nn

from vd.quaternions import relative_rotation


def random_rotations(count: int, device: torch.device) -> torch.Tensor:
    """Quaternions uniform on SO(3), xyzw [count, 4]."""
    return nn.functional.normalize(torch.randn((count, 4), device=device), dim=-1)


def rotations_about(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Quaternions xyzw [R, 4] about axes [R, 3], which need no unit length, by angles [R] [rad]."""
    half = 0.5 * angle[:, None]
    return torch.cat([nn.functional.normalize(axis, dim=-1) * half.sin(), half.cos()], dim=1)


def multiply(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Product of quaternions xyzw [R, 4]: first turns what second turned."""
    return relative_rotation(first, torch.cat([-second[:, :3], second[:, 3:]], dim=1))


def two_columns(quaternion: torch.Tensor) -> torch.Tensor:
    """First two columns of the matrices of quaternions xyzw [.., 4], one after the other: [.., 6]."""
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


def matrices(columns: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [.., 3, 3] nearest to two columns [.., 6], by Gram and Schmidt."""
    first = nn.functional.normalize(columns[..., :3], dim=-1)
    second = columns[..., 3:]
    second = nn.functional.normalize(second - (first * second).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), dim=-1)


def angle_between(columns: torch.Tensor, others: torch.Tensor | None = None) -> torch.Tensor:
    """Angles [..] [rad] between rotations, each two columns [.., 6]; to no rotation without ``others``."""
    matrix = matrices(columns)
    if others is not None:
        matrix = matrix.transpose(-1, -2) @ matrices(others)
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.acos((0.5 * (trace - 1.0)).clamp(-1.0, 1.0))
