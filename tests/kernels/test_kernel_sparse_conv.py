"""Maps between cells, and features of voxels, against Python's integers."""

import itertools

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from kernel_oracle import EXAMPLES, launch

from vd.kernels.sensor.sparse_conv import (
    gather_rows_kernel,
    kernel_map_kernel,
    voxel_feature_kernel,
)
from vd.kernels.sensor.voxels import CLOUD_SHIFT, coordinates_kernel, voxel_key_kernel
from vd.vision.sparse import words

FAR = 2047
"""Last voxel of the grid."""
OFFSETS = list(itertools.product((-1, 0, 1), repeat=3))


@st.composite
def grids(draw):
    """Voxels of up to three clouds [B, P, 3], crowded, some at the ends of the grid."""
    shape = draw(st.integers(1, 3)), draw(st.integers(1, 30))
    cells = draw(hnp.arrays(np.int32, (*shape, 3), elements=st.integers(-5, 5)))
    ends = draw(hnp.arrays(np.int8, shape, elements=st.integers(0, 9)))
    cells[ends == 0] = FAR
    cells[ends == 1] = -FAR - 1
    return cells


def keys_of(cells, device):
    points = (cells + 0.5).astype(np.float32)
    (keys,) = launch(voxel_key_kernel, cells.shape[:2], [points, 1.0], device, cells.shape[:2])
    return np.unique(keys)


def rows_of(keys, device):
    (rows,) = launch(coordinates_kernel, len(keys), [keys], device, (len(keys), 4))
    return [tuple(row) for row in rows.tolist()]


def coarse(keys, level):
    return np.unique(keys >> 3 * level << 3 * level)


def assert_map(outputs, inputs, step, device):
    """Each entry of the map is the row of the cell at its offset, or the number of cells."""
    read = [outputs, inputs, step]
    (table,) = launch(kernel_map_kernel, len(outputs), read, device, (len(outputs), 27))
    there = {row: i for i, row in enumerate(rows_of(inputs, device))}
    for found, (cloud, *cell) in zip(table, rows_of(outputs, device), strict=True):
        for row, offset in zip(found, OFFSETS, strict=True):
            other = (cloud, *(c + step * o for c, o in zip(cell, offset, strict=True)))
            assert row == there.get(other, len(inputs))


@EXAMPLES
@given(cells=grids(), level=st.integers(0, 3))
def test_maps_hold_the_cell_at_each_offset(device, cells, level):
    keys = coarse(keys_of(cells, device), level)
    above = coarse(keys, level + 1)
    assert_map(keys, keys, 1 << level, device)
    assert_map(above, keys, 1 << level, device)
    assert_map(keys, above, 1 << level, device)


def test_nothing_is_found_among_no_cells(device):
    keys = keys_of(np.zeros((1, 1, 3), np.int32), device)
    none = np.empty(0, np.int64)
    (table,) = launch(kernel_map_kernel, 1, [keys, none, 1], device, (1, 27))
    assert (table == 0).all()


@EXAMPLES
@given(cells=grids())
def test_coarser_cells_are_the_floors_of_halves(device, cells):
    keys = keys_of(cells, device)
    rows = np.array(rows_of(keys, device))
    rows[:, 1:] = 2 * np.floor(rows[:, 1:] / 2).astype(int)
    assert set(rows_of(coarse(keys, 1), device)) == set(map(tuple, rows.tolist()))


def test_features_are_of_the_points_in_the_given_order(device):
    size = 0.5
    points = size * np.array(
        [[[0.25, 0.5, 0.75], [0.75, 0.5, 0.25], [-0.5, 0, 0], [0.25, 0.25, 0.25]]]
    )
    points = np.concatenate([np.full_like(points, np.nan), points]).astype(np.float32)
    order = np.array([6, 4, 5, 7])  # the second cloud's third point, then its others
    read = [points, np.array([0, 0, 1, 1], np.int32), order, np.array([0, 1, 4]), size]
    (features,) = launch(voxel_feature_kernel, (2, 2), read, device, (2, 8))
    expected = [[0, 0, 0, 0, 1, 0, -0.5, -0.5], [1, 0, 0, 0, 1, -0.25, -0.25, -0.25]]
    np.testing.assert_allclose(features, expected, atol=1e-6)
    assert CLOUD_SHIFT == 36


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("channels", [15, 30, 32])
def test_rows_are_taken_bit_by_bit(device, channels, dtype):
    """Of floats and halves, in words of each size."""
    random = np.random.default_rng(0)
    place = torch.device(wp.device_to_torch(device))
    rows = torch.tensor(random.normal(size=(20, channels)), device=place).to(dtype)
    table = random.integers(0, 20, 50).astype(np.int32)
    taken = torch.full((50, channels), torch.nan, device=place).to(dtype)
    source = words(rows)
    inputs = [source, wp.array(table, device=device)]
    wp.launch(
        gather_rows_kernel, (50, source.shape[1]), inputs, outputs=[words(taken)], device=device
    )
    found = taken.float().cpu().numpy()
    np.testing.assert_array_equal(found, rows.float().cpu().numpy()[table])
