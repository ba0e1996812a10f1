"""Iterated closest points to planes (Chen and Medioni 1992): clouds that lie nearly right are laid right.

B pairs of clouds, P points of a goal, S of what is seen. Metres.
"""

import torch

from vd.vision.rotations import matrices, rotations_about, two_columns

NEIGHBOURS = 12
"""Points of which a goal's normals are taken: of 500 they reach about 1.5 cm.
On validation 8 do the same, on scans 24."""
NEAREST = 0.9
"""Share of seen points that pull, the nearest: others may be the hand's, or of a side that a goal lacks.
On scans 0.8 does the same."""
CLOUD_M = 0.08
"""Unit of places in a cloud and of offsets [m], so that turns and shifts count alike: half the length of the
largest objects."""
DAMPING = 1e-4
"""Of steps that no plane hinders: along a flat face nothing tells where it is."""
STEP_RAD = 0.2
"""Largest turn of a step."""


def normals(cloud: torch.Tensor) -> torch.Tensor:
    """Normals [B, P, 3] of clouds [B, P, 3], of either sign."""
    near = torch.cdist(cloud, cloud).topk(NEIGHBOURS, largest=False).indices
    points = cloud[torch.arange(len(cloud), device=cloud.device)[:, None, None], near]
    points = points - points.mean(dim=2, keepdim=True)
    spread = (points.transpose(-1, -2) @ points).cpu()  # so many small ones take a GPU longer
    return torch.linalg.eigh(spread).eigenvectors[..., 0].to(cloud.device)


def refine(
    goal: torch.Tensor,
    normal: torch.Tensor,
    seen: torch.Tensor,
    rotation: torch.Tensor,
    offset: torch.Tensor,
    steps: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
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
    for _ in range(steps):
        near, facing, apart = _matched(goal, normal, seen, rotation, offset)
        away = (facing * (seen - near)).sum(dim=-1)
        weight = (apart <= apart.kthvalue(int(NEAREST * seen.shape[1]), dim=1, keepdim=True).values).float()
        slope = torch.cat([torch.linalg.cross(near / CLOUD_M, facing), facing], dim=-1)
        pulled = slope * weight[..., None]
        square = pulled.transpose(-1, -2) @ slope
        square = square + DAMPING * seen.shape[1] * torch.eye(6, device=seen.device)
        step = torch.linalg.solve(square, (pulled * away[..., None]).sum(dim=1))
        turn = step[:, :3] / CLOUD_M
        turn = matrices(two_columns(rotations_about(turn, turn.norm(dim=-1).clamp(max=STEP_RAD))))
        rotation = turn @ rotation
        offset = (turn @ offset[..., None]).squeeze(-1) + step[:, 3:]
    near, facing, _ = _matched(goal, normal, seen, rotation, offset)
    return rotation, offset, (facing * (seen - near)).sum(dim=-1).square().mean(dim=-1).sqrt()


def _matched(
    goal: torch.Tensor,
    normal: torch.Tensor,
    seen: torch.Tensor,
    rotation: torch.Tensor,
    offset: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of each point that is seen the goal's nearest, its normal, and how far it is; [B, S, 3], [B, S]."""
    back = rotation.transpose(-1, -2)
    placed = goal @ back + offset[:, None]
    apart, index = torch.cdist(seen, placed).min(dim=-1)
    near = placed.take_along_dim(index[..., None], dim=1)
    return near, normal.take_along_dim(index[..., None], dim=1) @ back, apart
