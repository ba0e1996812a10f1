from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from kernel_oracle import ALPHA, EXAMPLES, device_array, launch, on_device, streams
from scipy import stats

from vd.kernels.sparse.voxels import (
    CloudNoise,
    cloud_offsets,
    coordinates,
    draw_noise,
    voxel_key_kernel,
    voxelise,
)

SIZE = 0.005
HALF = 2048


@st.composite
def clouds(draw):
    """Points in voxel units, many in the same voxel or on a border, some not finite or far away."""
    shape = (draw(st.integers(1, 3)), draw(st.integers(1, 12)), 3)
    whole = draw(hnp.arrays(np.int32, shape, elements=st.integers(-3, 3)))
    part = draw(hnp.arrays(np.float32, shape, elements=st.sampled_from([0.0, 0.25, 0.5, 0.875])))
    points = (whole + part).astype(np.float32)
    odd = draw(hnp.arrays(np.int8, shape[:2], elements=st.integers(0, 9)))
    points[odd == 0, 1] = np.nan
    points[odd == 1, 2] = np.inf
    points[odd == 2, 0] = HALF
    points[odd == 3, 0] = -HALF
    return points


def expected_voxels(points, size):
    """Sorted set of (cloud, x, y, z), by Python's integers."""
    found = set()
    for cloud, rows in enumerate(points):
        for point in rows:
            cell = np.floor(point / np.float32(size))
            if np.isfinite(cell).all() and (cell >= -HALF).all() and (cell < HALF).all():
                found.add((cloud, *(int(c) for c in cell)))
    return found


def voxels(points, device, size=1.0, noise=None):
    keys, _ = voxelise(device_array(points, wp.vec3, device), size, noise)
    return coordinates(keys).numpy(), keys


@EXAMPLES
@given(points=clouds())
def test_voxels_are_the_set_of_floors(device, points):
    rows, keys = voxels(points, device)
    assert len(set(map(tuple, rows))) == len(rows)
    assert set(map(tuple, rows)) == expected_voxels(points, 1.0)
    offsets = cloud_offsets(keys, len(points)).numpy()
    np.testing.assert_array_equal(offsets, [np.sum(rows[:, 0] < b) for b in range(len(points) + 1)])
    assert (np.diff(keys.numpy()) > 0).all()


@EXAMPLES
@given(points=clouds(), data=st.data())
def test_marks_name_the_groups_whose_points_a_voxel_holds(device, points, data):
    ends = sorted(data.draw(st.lists(st.integers(0, points.shape[1]), min_size=1, max_size=3)))
    groups = device_array(np.array(ends, np.int32), int, device)
    keys, marks = voxelise(device_array(points, wp.vec3, device), 1.0, ends=groups)
    rows = [tuple(row) for row in coordinates(keys).numpy()]
    np.testing.assert_array_equal(keys.numpy(), voxels(points, device)[1].numpy())
    expected = np.zeros((len(rows), len(ends)))
    for group, (start, end) in enumerate(pairwise([0, *ends])):
        for voxel in expected_voxels(points[:, start:end], 1.0):
            expected[rows.index(voxel), group] = 1.0
    np.testing.assert_array_equal(marks.numpy(), expected)


def test_a_cloud_without_points_has_no_voxel(device):
    points = np.full((3, 2, 3), np.nan, np.float32)
    points[1] = 0.0
    rows, keys = voxels(points, device)
    np.testing.assert_array_equal(rows, [[1, 0, 0, 0]])
    np.testing.assert_array_equal(cloud_offsets(keys, 3).numpy(), [0, 0, 1, 1])
    assert len(voxels(np.full((2, 1, 3), np.nan, np.float32), device)[0]) == 0


def test_refuses_a_size_that_is_not_positive():
    with pytest.raises(ValueError, match="voxel_size"):
        voxelise(wp.zeros((1, 1), dtype=wp.vec3, device="cpu"), 0.0)


def noise_of(device, count, seed=0, jitter=0.4, std=0.004, dropout=0.4, ratio=(0.0, 0.2)):
    noise = {"jitter_probability": jitter, "jitter_std": std}
    noise |= {"dropout_probability": dropout, "dropout_ratio": wp.vec2(*ratio)}
    return draw_noise(on_device([noise], wp.array[CloudNoise], device), streams(count, seed, device))


def test_noise_is_drawn_for_each_cloud_as_the_paper_says(device):
    count = 20000
    draw = noise_of(device, count)
    jitter, dropout = draw.jitter.numpy(), draw.dropout.numpy()
    assert set(np.unique(jitter)) == {0.0, np.float32(0.004)}
    jittered, dropped = jitter > 0, dropout > 0
    for share in (jittered, dropped):
        assert stats.binomtest(int(share.sum()), count, 0.4).pvalue > ALPHA
    assert stats.binomtest(int((jittered & dropped).sum()), count, 0.16).pvalue > ALPHA
    assert stats.kstest(dropout[dropped], stats.uniform(0, 0.2).cdf).pvalue > ALPHA
    assert len(np.unique(draw.stream.numpy())) > count - 3


def keys_of(points, draw, device, size):
    out = wp.full(2 * points.shape[0] * points.shape[1], -1, dtype=wp.int64, device=device)
    inputs = [points, size, draw.jitter, draw.dropout, draw.stream, out]
    launch(voxel_key_kernel, points.shape[:2], inputs, device)
    return out


def test_jitter_is_gaussian_in_metres_and_dropout_loses_its_share(device):
    points = np.zeros((2, 20000, 3), np.float32)
    fine = 1e-4  # voxels far below the jitter, so that their coordinates show its distribution
    draw = noise_of(device, 2, jitter=1.0, dropout=1.0, ratio=(0.2, 0.2))
    keys = keys_of(points, draw, device, fine)
    per_cloud = []
    for cloud in range(2):
        own = keys[cloud * 20000 : (cloud + 1) * 20000]
        rows = coordinates(own).numpy()
        kept = rows[rows[:, 0] == cloud][:, 1:] * fine
        assert stats.binomtest(len(kept), 20000, 0.8).pvalue > ALPHA
        for axis in range(3):
            assert stats.kstest(kept[:, axis] + 0.5 * fine, stats.norm(0, 0.004).cdf).statistic < 0.02
        assert np.abs(np.corrcoef(kept.T) - np.eye(3)).max() < 0.05
        per_cloud.append(kept)
    assert len(per_cloud[0]) != len(per_cloud[1]) or not np.array_equal(*per_cloud)


def test_noise_repeats_with_the_seed_and_differs_between_clouds_and_draws(device):
    points = np.tile(np.random.default_rng(0).normal(size=(1, 300, 3)).astype(np.float32) * 0.05, (4, 1, 1))

    def rows(seed):
        draw = noise_of(device, 4, seed, jitter=1.0, dropout=1.0, ratio=(0.1, 0.2))
        found = voxels(points, device, SIZE, draw)[0]
        return [found[found[:, 0] == cloud][:, 1:].tobytes() for cloud in range(4)]

    first = rows(1)
    assert first == rows(1)
    assert len(set(first)) == 4
    assert not set(first) & set(rows(2))
