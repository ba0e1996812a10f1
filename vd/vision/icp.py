"""Iterated closest points to planes (Chen and Medioni 1992).

Clouds that lie nearly right are laid right.

B pairs of clouds, P points of a goal, S of what is seen. Metres.
"""

import torch

from vd.vision.rotations import matrices, rotations_about, two_columns

NEIGHBOURS = 12
"""Points of which a goal's normals are taken: of 500 they reach about 1.5 cm.
On validation 8 do the same, on scans 24."""
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


def normals(cloud: torch.Tensor) -> torch.Tensor:
    """Normals [B, P, 3] of clouds [B, P, 3], of either sign."""
    near = torch.cdist(cloud, cloud).topk(NEIGHBOURS, largest=False).indices
    points = cloud[torch.arange(len(cloud), device=cloud.device)[:, None, None], near]
    points = points - points.mean(dim=2, keepdim=True)
    spread = (points.transpose(-1, -2) @ points).cpu()  # so many small ones take a GPU longer
    return torch.linalg.eigh(spread).eigenvectors[..., 0].to(cloud.device)


def nearest(apart: torch.Tensor) -> torch.Tensor:
    """Indices [..] of the least of squared distances [.., P].

    On a CPU NumPy takes an eighth of the time.
    """
    if apart.device.type == "cpu":
        return torch.from_numpy(apart.numpy().argmin(axis=-1))
    return apart.argmin(dim=-1)


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
    square, planes = goal.square().sum(dim=-1), torch.cat([goal, normal], dim=-1)
    damping = DAMPING * seen.shape[1] * torch.eye(6, device=seen.device)
    moved = (seen - offset[:, None]) @ rotation  # in the goals' frames, which stay
    for left in range(steps, -1, -1):
        # Squared distances but for those of the moved points from the origins.
        apart = torch.baddbmm(square[:, None], moved, goal.transpose(-1, -2), alpha=-2.0)
        index = nearest(apart)[..., None]
        near, facing = planes.take_along_dim(index, dim=1).split(3, dim=-1)
        away = (facing * (near - moved)).sum(dim=-1)
        if not left:
            break
        apart = apart.take_along_dim(index, dim=-1).squeeze(-1) + moved.square().sum(dim=-1)
        inside = apart <= apart.kthvalue(int(NEAREST * seen.shape[1]), dim=1, keepdim=True).values
        middle = moved.mean(dim=1, keepdim=True)
        slope = torch.cat([torch.linalg.cross((near - middle) / CLOUD_M, facing), facing], dim=-1)
        pulled = (slope * inside[..., None]).transpose(-1, -2)
        step = torch.linalg.solve(pulled @ slope + damping, (pulled @ away[..., None]).squeeze(-1))
        turn = step[:, :3] / CLOUD_M
        back = matrices(two_columns(rotations_about(-turn, turn.norm(dim=-1).clamp(max=STEP_RAD))))
        moved = (moved - middle) @ back + middle + step[:, None, 3:]
        rotation = rotation @ back
    offset = seen.mean(dim=1) - (rotation @ moved.mean(dim=1)[..., None]).squeeze(-1)
    return rotation, offset, away.square().mean(dim=-1).sqrt()
