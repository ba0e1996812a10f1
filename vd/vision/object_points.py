"""Which of a camera's points are the object's.

Those of voxels that neither are the hand's nor touch one.
"""

import torch
import warp as wp
from torch import Tensor

from vd.geometry.arrays import as_warp
from vd.kernels.launch import launch
from vd.kernels.sensor.voxels import (
    CLOUD_SHIFT,
    beside_kernel,
    coordinates_kernel,
    voxel_key_kernel,
)


def object_points(points: Tensor, hand: int, voxel_m: float, most: int) -> tuple[Tensor, Tensor]:
    """Centres of the object's voxels.

    The hand's own samples leave gaps, so a voxel that touches one of them, by a corner at least, is
    taken for the hand's too.

    Args:
        points: Clouds [m]: the hand's own samples, then what the camera sees, NaN for none [N, P,
            3].
        hand: Column at which the hand's samples end.
        voxel_m: Side of a voxel [m].
        most: M, voxels of a cloud at most.

    Returns:
        Centres [m], zeros where a cloud has fewer, shape [N, M', 3] with M' <= M, neighbours beside
        each other, and how many there are, int32 [N]. Waits for the device.
    """
    device = points.device
    envs = len(points)
    keys = torch.empty(points.shape[:2], dtype=torch.int64, device=device)
    launch(voxel_key_kernel, keys.shape, [as_warp(points, wp.vec3), voxel_m], [as_warp(keys)])
    voxels, place = torch.unique(keys, return_inverse=True)
    of_hand = torch.zeros(len(voxels), dtype=torch.bool, device=device)
    of_hand[place[:, :hand]] = True
    touches = torch.empty_like(of_hand)
    launch(beside_kernel, len(voxels), [as_warp(voxels), as_warp(of_hand)], [as_warp(touches)])
    free = voxels[~touches & (voxels < envs << CLOUD_SHIFT)]
    rows = torch.empty((len(free), 4), dtype=torch.int32, device=device)
    launch(coordinates_kernel, len(free), [as_warp(free)], [as_warp(rows)])
    cloud = rows[:, 0].long()
    first = torch.searchsorted(cloud, torch.arange(envs + 1, device=device))
    counts = torch.diff(first)
    rank = torch.arange(len(cloud), device=device) - first[cloud]
    # Of more than ``most`` every so many-th is taken, in the order of the rows, in which neighbours
    # follow each other: those left out would share a place with the one before them.
    share = counts.clip(min=most)[cloud]
    place = rank * most // share
    taken = (rank == 0) | ((rank - 1) * most // share < place)
    size = min(most, max(1, int(counts.max())))
    centres = torch.zeros((envs, size, 3), dtype=torch.float32, device=device)
    centres[cloud[taken], place[taken]] = rows[taken, 1:] + 0.5
    return voxel_m * centres, counts.clip(max=most).int()
