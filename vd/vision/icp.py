"""Iterated closest points to planes (Chen and Medioni 1992).

Clouds that lie nearly right are laid right.

B pairs of clouds, P points of a goal, S of what is seen. Metres.
"""

import torch
from torch import Tensor

from vd.vision.rotations import matrices_about

NEIGHBOURS = 12
"""Points of which a goal's normals are taken: of 500 they reach about 1.5 cm. On validation 8 do
the same, on scans 24."""
NEAREST = 0.9
"""Share of seen points that pull, the nearest: others may be the hand's, or of a side that a goal
lacks. On scans 0.8 does the same."""
CLOUD_M = 0.08
"""Unit of places in a cloud and of offsets [m], so that turns and shifts count alike: half the
length of the largest objects."""
DAMPING = 1e-4
"""Of steps that no plane hinders: along a flat face nothing tells where it is."""
STEP_RAD = 0.2
"""Largest turn of a step."""


def normals(cloud: Tensor) -> Tensor:
    """Normals [B, P, 3] of clouds [B, P, 3], of either sign."""
    near = torch.cdist(cloud, cloud).topk(NEIGHBOURS, largest=False).indices
    rows = torch.arange(len(cloud), device=cloud.device)[:, None, None]
    points = cloud[rows, near]
    points = points - points.mean(dim=2, keepdim=True)
    spread = (points.mT @ points).cpu()  # so many small ones take a GPU longer
    return torch.linalg.eigh(spread).eigenvectors[..., 0].to(cloud.device)


def nearest(apart: Tensor) -> Tensor:
    """Indices [..] of the least of squared distances [.., P].

    On a CPU NumPy takes an eighth of the time.
    """
    if apart.device.type == "cpu":
        return torch.from_numpy(apart.numpy().argmin(axis=-1))
    return apart.argmin(dim=-1)


def refine(
    goal: Tensor,
    normal: Tensor,
    seen: Tensor,
    rotation: Tensor,
    offset: Tensor,
    steps: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Turn and shift goals until what is seen lies on their planes.

    Args:
        goal: Goals' clouds [B, P, 3].
        normal: Their :func:`normals` [B, P, 3].
        seen: What is seen [B, S, 3].
        rotation: From the goals to what is seen, matrices [B, 3, 3].
        offset: Where their origins lie [B, 3].
        steps: Steps of Gauss and Newton.

    Returns:
        Rotations, offsets, and root mean square distances from the planes [m] [B].
    """
    moved = (seen - offset[:, None]) @ rotation  # in the goals' frames, which stay
    count = seen.shape[1]
    damping = DAMPING * count * torch.eye(6, device=seen.device)
    for _ in range(steps):
        near, facing, apart = _planes(goal, normal, moved)
        away = (facing * (near - moved)).sum(dim=-1)
        most = apart.kthvalue(int(NEAREST * count), dim=1, keepdim=True).values
        inside = apart <= most
        middle = moved.mean(dim=1, keepdim=True)
        arm = (near - middle) / CLOUD_M
        lever = torch.linalg.cross(arm, facing)
        slope = torch.cat([lever, facing], dim=-1)
        pulled = (slope * inside[..., None]).mT
        force = (pulled @ away[..., None]).squeeze(-1)
        step = torch.linalg.solve(pulled @ slope + damping, force)
        turn = step[:, :3] / CLOUD_M
        angle = turn.norm(dim=-1).clamp(max=STEP_RAD)
        back = matrices_about(-turn, angle)
        shift = step[:, None, 3:]
        moved = (moved - middle) @ back + middle + shift
        rotation = rotation @ back
    near, facing, _ = _planes(goal, normal, moved)
    away = (facing * (near - moved)).sum(dim=-1)
    middle = rotation @ moved.mean(dim=1)[..., None]
    offset = seen.mean(dim=1) - middle.squeeze(-1)
    return rotation, offset, away.square().mean(dim=-1).sqrt()


def _planes(goal: Tensor, normal: Tensor, moved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Goals' points nearest to moved ones [B, S, 3], normals there, and squared distances [B, S]."""
    square = goal.square().sum(dim=-1)[:, None]
    # Squared distances but for those of the moved points from the origins.
    apart = torch.baddbmm(square, moved, goal.mT, alpha=-2.0)
    index = nearest(apart)[..., None]
    near = goal.take_along_dim(index, dim=1)
    facing = normal.take_along_dim(index, dim=1)
    least = apart.take_along_dim(index, dim=-1).squeeze(-1)
    return near, facing, least + moved.square().sum(dim=-1)
