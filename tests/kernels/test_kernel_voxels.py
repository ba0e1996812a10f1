import itertools

import numpy as np
import torch
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from kernel_oracle import EXAMPLES, device_array, launch, unwritten

from vd.kernels.sensor.voxels import (
    CLOUD_SHIFT,
    beside_kernel,
    coordinates_kernel,
    voxel_key_kernel,
)
from vd.vision.object_points import object_points

HALF = 2048
NEAR = list(itertools.product((-1, 0, 1), repeat=3))


@st.composite
def clouds(draw):
    """Points in voxel units, many in the same voxel or on a border, some not finite or at the grid's ends."""
    shape = (draw(st.integers(1, 3)), draw(st.integers(1, 12)), 3)
    whole = draw(hnp.arrays(np.int32, shape, elements=st.integers(-3, 3)))
    part = draw(hnp.arrays(np.float32, shape, elements=st.sampled_from([0.0, 0.25, 0.5, 0.875])))
    points = (whole + part).astype(np.float32)
    odd = draw(hnp.arrays(np.int8, shape[:2], elements=st.integers(0, 9)))
    for kind, (axis, value) in enumerate(
        [(1, np.nan), (2, np.inf), (0, HALF), (0, -HALF), (1, HALF - 0.5)]
    ):
        points[odd == kind, axis] = value
    return points


def cell(point) -> tuple[int, ...] | None:
    """Voxel of a point, by Python's integers."""
    if not np.isfinite(point).all() or (point < -HALF).any() or (point >= HALF).any():
        return None
    return tuple(int(np.floor(value)) for value in point)


def keys_of(points, device):
    keys = unwritten(points.shape[:2], wp.int64, device)
    launch(voxel_key_kernel, keys.shape, [device_array(points, wp.vec3, device), 1.0, keys], device)
    return keys.numpy()


def rows_of(keys, device):
    rows = unwritten((len(keys), 4), int, device)
    launch(coordinates_kernel, len(keys), [device_array(keys, wp.int64, device), rows], device)
    return [tuple(row) for row in rows.numpy().tolist()]


@EXAMPLES
@given(points=clouds())
def test_keys_name_cloud_and_floor_and_sort_by_cloud(device, points):
    keys = keys_of(points, device)
    for cloud, (own, rows) in enumerate(zip(keys, points, strict=True)):
        for key, point in zip(own, rows, strict=True):
            if (expected := cell(point)) is None:
                assert key == len(points) << CLOUD_SHIFT
            else:
                assert rows_of([key], device) == [(cloud, *expected)]
                assert cloud << CLOUD_SHIFT <= key < (cloud + 1) << CLOUD_SHIFT


@EXAMPLES
@given(points=clouds(), kinds=st.integers(2, 4))
def test_voxels_beside_others_have_one_of_them_about(device, points, kinds):
    keys = np.unique(keys_of(points, device))
    keys = keys[keys < len(points) << CLOUD_SHIFT]
    rows = rows_of(keys, device)
    others = np.array([sum(row) % kinds == 0 for row in rows], dtype=bool)
    there = {row for row, other in zip(rows, others, strict=True) if other}
    found = wp.empty(len(keys), dtype=wp.bool, device=device)
    inputs = [device_array(keys, wp.int64, device), device_array(others, wp.bool, device), found]
    launch(beside_kernel, len(keys), inputs, device)
    expected = [any((c, x + i, y + j, z + k) in there for i, j, k in NEAR) for c, x, y, z in rows]
    assert found.numpy().tolist() == expected


@EXAMPLES
@given(points=clouds(), data=st.data(), most=st.integers(1, 8))
def test_an_objects_points_are_voxels_away_from_the_hands(device, points, data, most):
    hand = data.draw(st.integers(0, points.shape[1]))
    place = wp.device_to_torch(device)
    centres, counts = object_points(torch.tensor(points, device=place), hand, 1.0, most)
    for cloud, own in enumerate(points):
        of_hand = {cell(point) for point in own[:hand]} - {None}
        seen = {cell(point) for point in own[hand:]} - {None}
        about = {tuple(np.add(voxel, step).tolist()) for voxel in of_hand for step in NEAR}
        expected = {tuple(value + 0.5 for value in voxel) for voxel in seen - about}
        count = int(counts[cloud])
        assert count == min(most, len(expected))
        found = [tuple(row) for row in centres[cloud].tolist()]
        assert set(found[:count]) <= expected and len(set(found[:count])) == count
        assert not any(any(row) for row in found[count:])
