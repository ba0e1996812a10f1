"""Rotations as quaternions xyzw [.., 4], torch."""

import torch


def product(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """``first * second``, quaternions xyzw [..., 4]: turns by the second, then by the first."""
    a, aw, b, bw = first[..., :3], first[..., 3:], second[..., :3], second[..., 3:]
    vector = aw * b + bw * a + torch.linalg.cross(a, b)
    return torch.cat([vector, aw * bw - (a * b).sum(dim=-1, keepdim=True)], dim=-1)


def canonical(quat: torch.Tensor) -> torch.Tensor:
    """Of q and -q, one rotation, the one whose first of w, x, y, z that is not 0 is positive [..., 4]."""
    first = quat[..., 3]
    for i in range(3):
        first = torch.where(first == 0.0, quat[..., i], first)
    return torch.where(first[..., None] < 0.0, -quat, quat)


def relative_rotation(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """``first * conj(second)``, quaternions xyzw [..., 4]."""
    return product(first, torch.cat([-second[..., :3], second[..., 3:]], dim=-1))


def rotation_distance(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Angle between orientations, quaternions xyzw [..., 4], in [0, pi] [rad]."""
    vector = torch.linalg.vector_norm(relative_rotation(first, second)[..., :3], dim=-1)
    return 2.0 * torch.asin(vector.clamp(max=1.0))


def rotated(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Vectors [..., 3] turned by quaternions xyzw [..., 4]."""
    twice = 2.0 * torch.linalg.cross(quat[..., :3], vector)
    return vector + quat[..., 3:] * twice + torch.linalg.cross(quat[..., :3], twice)
