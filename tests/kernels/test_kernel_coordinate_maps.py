import itertools

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from kernel_oracle import EXAMPLES, device_array

from vd.kernels.sparse.coordinate_maps import (
    beside,
    coarsen,
    level_counts,
    neighbour_table,
    strided_table,
    window_table,
)
from vd.kernels.sparse.voxels import coordinates, voxelise

OFFSETS = list(itertools.product((-1, 0, 1), repeat=3))
"""Of a 3x3x3 kernel, in the order of its weights."""
CORNERS = list(itertools.product((0, 1), repeat=3))
FAR = 2047
"""Last cell of the grid."""


@st.composite
def grids(draw):
    """Occupied cells (cloud, x, y, z) of up to three clouds, crowded, some at the ends of the grid."""
    clouds = draw(st.integers(1, 3))
    count = draw(st.integers(1, 30))
    cells = draw(hnp.arrays(np.int32, (clouds, count, 3), elements=st.integers(-3, 3)))
    ends = draw(hnp.arrays(np.int8, (clouds, count), elements=st.integers(0, 9)))
    cells[ends == 0] = FAR
    cells[ends == 1] = -FAR - 1
    return cells


def sites(cells, device, level):
    """Keys and rows (cloud, x, y, z) of a level."""
    keys, _ = voxelise(device_array(cells + 0.5, wp.vec3, device), 1.0)
    for _ in range(level):
        keys, _ = coarsen(keys)
    return keys, coordinates(keys, level).numpy()


def row_of(rows):
    return {tuple(int(v) for v in row): i for i, row in enumerate(rows)}


def moved(row, offset, factor=1):
    return (int(row[0]), *(factor * int(c) + o for c, o in zip(row[1:], offset, strict=True)))


@EXAMPLES
@given(cells=grids(), level=st.integers(0, 3))
def test_coarse_sites_are_the_floors_of_halves(device, cells, level):
    keys, rows = sites(cells, device, level)
    coarse, place = coarsen(keys)
    found = coordinates(coarse, level + 1).numpy()
    expected = np.c_[rows[:, 0], np.floor(rows[:, 1:] / 2).astype(int)]
    assert set(map(tuple, found)) == set(map(tuple, expected))
    assert len(found) == len(set(map(tuple, found)))
    np.testing.assert_array_equal(found[place.numpy() - 1], expected)


def assert_counts(keys):
    """``level_counts`` foretells what coarsening gives, and coarsening told so gives the same."""
    counts = level_counts(keys)
    assert len(counts) == 12
    for count in counts:
        told, place = coarsen(keys, count)
        keys, expected = coarsen(keys)
        assert count == len(keys)
        np.testing.assert_array_equal(told.numpy(), keys.numpy())
        np.testing.assert_array_equal(place.numpy(), expected.numpy())


@EXAMPLES
@given(cells=grids(), level=st.integers(0, 2))
def test_sizes_of_all_coarser_levels_are_known_at_once(device, cells, level):
    keys, _ = sites(cells, device, level)
    # twelve halvings of the finest grid leave one cell; of a coarser one that cell stays
    if level == 0:
        assert_counts(keys)
    assert level_counts(keys)[0] == len(coarsen(keys)[0])


def test_sizes_of_many_sites_are_summed_over_threads(device):
    cells = np.random.default_rng(0).integers(-60, 60, (4, 5000, 3))
    assert_counts(sites(cells, device, 0)[0])


@EXAMPLES
@given(cells=grids(), level=st.integers(0, 2))
def test_neighbours_are_all_the_sites_at_each_offset(device, cells, level):
    keys, rows = sites(cells, device, level)
    table, index = neighbour_table(keys, level).numpy(), row_of(rows)
    for row, k in itertools.product(range(len(rows)), range(27)):
        assert table[row, k] == index.get(moved(rows[row], OFFSETS[k]), len(rows))


@EXAMPLES
@given(cells=grids(), level=st.integers(0, 2))
def test_strided_maps_hold_every_pair_of_input_and_output(device, cells, level):
    keys, rows = sites(cells, device, level)
    coarse, _ = coarsen(keys)
    outputs = coordinates(coarse, level + 1).numpy()
    table, back = (strided_table(keys, coarse, level, reverse=r).numpy() for r in (False, True))
    index = row_of(rows)
    for row, k in itertools.product(range(len(outputs)), range(27)):
        expected = index.get(moved(outputs[row], OFFSETS[k], 2), len(rows))
        assert table[row, k] == expected
    pairs = {(table[row, k], row, k) for row, k in zip(*np.nonzero(table < len(rows)), strict=True)}
    assert pairs == {(row, back[row, k], k) for row, k in zip(*np.nonzero(back < len(outputs)), strict=True)}


@EXAMPLES
@given(cells=grids(), level=st.integers(0, 2))
def test_windows_hold_the_sites_of_each_cell(device, cells, level):
    keys, rows = sites(cells, device, level)
    coarse, place = coarsen(keys)
    outputs = coordinates(coarse, level + 1).numpy()
    table, index = window_table(keys, place, len(outputs)).numpy(), row_of(rows)
    for row, k in itertools.product(range(len(outputs)), range(8)):
        assert table[row, k] == index.get(moved(outputs[row], CORNERS[k], 2), len(rows))
    assert sorted(table[table < len(rows)]) == list(range(len(rows)))


@EXAMPLES
@given(cells=grids(), kinds=st.integers(3, 4))
def test_voxels_beside_others_are_those_with_one_of_them_about(device, cells, kinds):
    keys, rows = sites(cells, device, 0)
    kind = rows[:, 1:].sum(axis=1) % kinds  # asked about, both, one of the others, neither
    asked, others = kind <= 1, (kind == 1) | (kind == 2)
    there = {tuple(row) for row in rows[others]}
    expected = [
        bool(a) and any(moved(row, o) in there for o in OFFSETS) for row, a in zip(rows, asked, strict=True)
    ]
    parts = (wp.array(part, dtype=wp.bool, device=device) for part in (asked, others))
    assert beside(keys, *parts).numpy().tolist() == expected


def test_no_sites_give_empty_maps(device):
    keys = wp.empty(0, dtype=wp.int64, device=device)
    coarse, place = coarsen(keys)
    assert coarse.shape == place.shape == (0,)
    assert level_counts(keys) == [0] * 12
    assert neighbour_table(keys, 0).shape == (0, 27)
    assert (
        strided_table(keys, coarse, 0).shape == strided_table(keys, coarse, 0, reverse=True).shape == (0, 27)
    )
    assert window_table(keys, place, 0).shape == (0, 8)
    nothing = wp.empty(0, dtype=wp.bool, device=device)
    assert beside(keys, nothing, nothing).shape == (0,)
