"""Of what the points in each voxel are samples: the goal, or the hand.

The kernels of voxels (:mod:`vd.kernels.voxels`) forget which points a voxel holds; a search of every
point's key among those of the voxels finds out again. B clouds of P points, M voxels, C columns of marks.
"""

import warp as wp

from vd.kernels.voxels import NoiseDraw, voxel_key_kernel

wp.set_module_options({"enable_backward": False})


@wp.kernel
def voxel_mark_kernel(
    # In:
    point_key_in: wp.array[wp.int64],
    points: int,
    end_in: wp.array[int],
    key_in: wp.array[wp.int64],
    # Out:
    mark_out: wp.array2d[float],
):
    """Mark the voxel of each point with the group of the point. Launch: [B, P].

    Points of a voxel write the same value, so their order does not matter.

    Args:
        point_key_in: Keys of the points, shape [>= B P].
        points: P.
        end_in: Where each group of points ends, ascending, shape [C].
        key_in: Keys of the voxels, ascending, shape [M].
        mark_out: 1 where a voxel holds a point of the group, shape [M, C]; the others stay.
    """
    cloud, point = wp.tid()
    key = point_key_in[cloud * points + point]
    low = wp.int32(0)
    high = wp.int32(key_in.shape[0])
    while low < high:
        middle = (low + high) // 2
        if key_in[middle] < key:
            low = middle + 1
        else:
            high = middle
    # Points that count for nothing have a key that no voxel has.
    if low < key_in.shape[0] and key_in[low] == key:
        group = wp.int32(0)
        while group < end_in.shape[0] and point >= end_in[group]:
            group += 1
        if group < end_in.shape[0]:
            mark_out[low, group] = 1.0


def mark_voxels(
    keys: wp.array, points: wp.array, voxel_size: float, ends: wp.array, noise: NoiseDraw | None = None
) -> wp.array:
    """Marks of voxels by the groups of points in them.

    Args:
        keys: Keys of the voxels, as :func:`vd.kernels.voxels.voxelise` gave them for these arguments, [M].
        points: Points [m], shape [B, P].
        voxel_size: Side of a voxel [m].
        ends: Where each group of points ends, ascending, shape [C]; points after the last are of none.
        noise: The noise that was added.

    Returns:
        1 where a voxel holds a point of the group, else 0; shape [M, C].
    """
    clouds, per_cloud = points.shape
    device = points.device
    point_keys = wp.empty(clouds * per_cloud, dtype=wp.int64, device=device)
    wp.launch(
        voxel_key_kernel,
        dim=(clouds, per_cloud),
        inputs=[
            points,
            voxel_size,
            noise and noise.jitter,
            noise and noise.dropout,
            noise and noise.stream,
        ],
        outputs=[point_keys],
        device=device,
    )
    marks = wp.zeros((keys.shape[0], ends.shape[0]), dtype=float, device=device)
    wp.launch(
        voxel_mark_kernel,
        dim=(clouds, per_cloud),
        inputs=[point_keys, per_cloud, ends, keys],
        outputs=[marks],
        device=device,
    )
    return marks
