"""Which of a camera's points are the object's: those of voxels that neither are the hand's nor touch one."""

import torch
import warp as wp

from vd.kernels.sparse.coordinate_maps import beside
from vd.kernels.sparse.voxels import coordinates, voxelise


def object_points(
    points: wp.array, hand: wp.array, voxel_m: float, most: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Centres of the object's voxels.

    The hand's own samples leave gaps, so a voxel that touches one of them, by a corner at least, is taken for
    the hand's too.

    Args:
        points: Clouds [m]: the hand's own samples, then what the camera sees, NaN for none, vec3 [N, P].
        hand: Column at which the hand's samples end, int32 [1].
        voxel_m: Side of a voxel [m].
        most: M, voxels of a cloud at most.

    Returns:
        Centres [m], zeros where a cloud has fewer, shape [N, M', 3] with M' <= M, and how many there are,
        int32 [N]. Waits for the device.
    """
    keys, marks = voxelise(points, voxel_m, ends=hand)
    of_hand = wp.to_torch(marks)[:, 0] > 0
    free = ~of_hand
    touches = wp.to_torch(beside(keys, wp.from_torch(free), wp.from_torch(of_hand)))
    rows = wp.to_torch(coordinates(keys))[free & ~touches]
    cloud = rows[:, 0].long()
    first = torch.searchsorted(cloud, torch.arange(points.shape[0] + 1, device=rows.device))
    counts, rank = first.diff(), torch.arange(len(cloud), device=rows.device) - first[cloud]
    # Of more than ``most`` every so many-th is taken, in the order of the rows, in which neighbours follow
    # each other: those left out would share a place with the one before them.
    share = counts.clamp(min=most)[cloud]
    place = rank * most // share
    taken = (rank == 0) | ((rank - 1) * most // share < place)
    size = min(most, max(1, int(counts.max())))
    centres = torch.zeros((len(counts), size, 3), device=rows.device)
    centres[cloud[taken], place[taken]] = rows[taken, 1:] + 0.5
    return voxel_m * centres, counts.clamp(max=most).int()
