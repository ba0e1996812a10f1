"""Sparse layers against dense ones, their gradients, and the edges of clouds and grids."""

import itertools

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vd.vision import sparse
from vd.vision.sparse import (
    ResidualBlock,
    Sites,
    SparseTensor,
    StridedConv,
    SubmanifoldConv,
    global_pool,
    voxelise,
)

EXTENT = 4
"""Cells of these tests lie in [-4, 4)."""
FEW = settings(max_examples=15, deadline=None)
LAYERS = [SubmanifoldConv, StridedConv]


@st.composite
def clouds(draw) -> np.ndarray:
    """Cells of one to three clouds [B, P, 3], crowded, many twice; a cloud of NaN has none."""
    shape = draw(st.integers(1, 3)), draw(st.integers(1, 40)), 3
    cells = draw(hnp.arrays(np.int8, shape, elements=st.integers(-EXTENT, EXTENT - 1)))
    points = cells.astype(np.float32)
    points[draw(hnp.arrays(np.bool_, shape[0]))] = np.nan
    return points


def sites_of(cells: np.ndarray, device: str, halvings: int = 0) -> Sites:
    points = torch.tensor(cells + 0.5, dtype=torch.float32, device=wp.device_to_torch(device))
    sites = voxelise([points], 1.0).sites
    for _ in range(halvings):
        sites = sites.coarser
    return sites


def random_features(sites: Sites, channels: int, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(len(sites), channels, dtype=dtype, generator=generator)
    return values.to(sites.keys.device)


def places(sites: Sites, extent: int) -> tuple[torch.Tensor, ...]:
    """Cloud and cell of each row, counted from the corner of a dense grid, [M] each."""
    cloud, *cell = sites.coordinates.long().unbind(dim=1)
    return cloud, *(axis.div(sites.step, rounding_mode="floor") + extent for axis in cell)


def to_dense(features: torch.Tensor, sites: Sites, extent: int) -> torch.Tensor:
    """A dense tensor [B, C, X, Y, Z] with the features at their cells, zeros elsewhere."""
    side = 2 * extent
    dense = features.new_zeros((sites.clouds, side, side, side, features.shape[1]))
    return dense.index_put(places(sites, extent), features).permute(0, 4, 1, 2, 3)


def dense_convolution(conv, features, weight, sites: Sites) -> torch.Tensor:
    """What torch's dense convolution gives at the cells of the output."""
    stride = 2 if isinstance(conv, StridedConv) else 1
    outputs = sites.coarser if stride == 2 else sites
    extent = EXTENT // sites.step
    kernel = weight.permute(2, 1, 0).unflatten(2, (3, 3, 3))
    dense = to_dense(features, sites, extent)
    result = torch.nn.functional.conv3d(dense, kernel, stride=stride, padding=1)
    return result.permute(0, 2, 3, 4, 1)[places(outputs, extent // stride)]


@pytest.mark.parametrize("layer", LAYERS)
@FEW
@given(cells=clouds(), halvings=st.integers(0, 1))
def test_convolution_and_gradients_equal_dense_ones(device, layer, cells, halvings):
    sites = sites_of(cells, device, halvings)
    conv = layer(3, 4).double().to(sites.keys.device)
    features = random_features(sites, 3).requires_grad_()
    output = conv(SparseTensor(features, sites)).features
    expected = dense_convolution(conv, features, conv.weight, sites)
    torch.testing.assert_close(output, expected, atol=1e-12, rtol=1e-12)
    pull = torch.cos(torch.arange(output.numel(), dtype=torch.float64)).view_as(output)
    learned = features, conv.weight
    found = torch.autograd.grad(output, learned, pull.to(output.device))
    wanted = torch.autograd.grad(expected, learned, pull.to(output.device))
    torch.testing.assert_close(found, wanted, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("layer", LAYERS)
def test_gradients_equal_finite_differences(device, layer):
    cells = np.random.default_rng(0).integers(-2, 2, (2, 8, 3))
    sites = sites_of(cells, device)
    conv = layer(2, 3).double().to(sites.keys.device)
    features = random_features(sites, 2).requires_grad_()

    def run(features, weight):
        given = SparseTensor(features, sites)
        return torch.func.functional_call(conv, {"weight": weight}, (given,)).features

    assert torch.autograd.gradcheck(run, (features, conv.weight))


def test_parts_of_a_large_matrix_give_the_same(device, monkeypatch):
    sites = sites_of(np.random.default_rng(0).integers(-4, 4, (2, 100, 3)), device)
    conv = SubmanifoldConv(4, 5).double().to(sites.keys.device)
    features = random_features(sites, 4).requires_grad_()

    def gradients():
        output = conv(SparseTensor(features, sites)).features
        return output, *torch.autograd.grad(output.square().sum(), (features, conv.weight))

    whole = gradients()
    monkeypatch.setitem(sparse.GATHERED, sites.keys.device.type, 27 * 4 * 7)
    torch.testing.assert_close(gradients(), whole, atol=1e-12, rtol=1e-12)


def test_layers_give_the_same_where_nothing_is_learned(device):
    sites = sites_of(np.random.default_rng(0).integers(-4, 4, (2, 100, 3)), device)
    given = SparseTensor(random_features(sites, 4, torch.float32), sites)
    for layer in LAYERS:
        conv = layer(4, 5).to(sites.keys.device)
        learned = conv(given).features
        with torch.inference_mode():
            assert torch.equal(conv(given).features, learned)


def test_maps_of_a_level_are_made_once_for_all_layers_and_gradients(device, monkeypatch):
    made = []
    kernel_map = sparse.kernel_map
    monkeypatch.setattr(sparse, "kernel_map", lambda *keys: made.append(1) or kernel_map(*keys))
    sites = sites_of(np.random.default_rng(0).integers(-4, 4, (2, 100, 3)), device)
    blocks = [ResidualBlock(3), StridedConv(3, 3), ResidualBlock(3), ResidualBlock(3)]
    network = torch.nn.Sequential(*blocks).to(sites.keys.device)
    features = random_features(sites, 3, torch.float32).requires_grad_()
    network(SparseTensor(features, sites)).features.sum().backward()
    # The fine cells' neighbours, the strided map and its reverse, the coarse cells' neighbours.
    assert len(made) == 4


def test_batch_borders_and_the_ends_of_the_grid_are_no_neighbours(device):
    """The last cell of a cloud and the first of the next have keys side by side."""
    far = 2047.0
    cells = np.array([[[far, far, far]], [[-far - 1, -far - 1, -far - 1]], [[np.nan] * 3]])
    sites = sites_of(cells, device)
    assert sites.coordinates.tolist() == [[0, 2047, 2047, 2047], [1, -2048, -2048, -2048]]
    assert sites.lengths.tolist() == [1, 1, 0]
    assert ((sites.neighbours != 2).sum(dim=1) == 1).all()
    assert sites.coarser.coordinates.tolist() == [[0, 2046, 2046, 2046], [1, -2048, -2048, -2048]]


@pytest.mark.parametrize("points", [0, 3])
def test_clouds_without_voxels_flow_through(device, points):
    sites = sites_of(np.full((2, points, 3), np.nan), device)
    features = random_features(sites, 2).requires_grad_()
    convs = torch.nn.Sequential(StridedConv(2, 3), SubmanifoldConv(3, 4)).double()
    pooled = global_pool(convs.to(sites.keys.device)(SparseTensor(features, sites)))
    assert pooled.shape == (2, 8)
    assert not pooled.any()
    pooled.sum().backward()
    assert not convs[0].weight.grad.any()


def test_pooling_keeps_clouds_apart(device):
    cells = np.array([[[0.0, 0, 0], [0, 0, 0]], [[np.nan] * 3] * 2, [[0, 0, 0], [3, 3, 3]]])
    sites = sites_of(cells, device)
    features = torch.tensor([[-1.0], [-4.0], [2.0]], device=sites.keys.device, requires_grad=True)
    pooled = global_pool(SparseTensor(features, sites))
    assert pooled.tolist() == [[-1.0, -1.0], [0.0, 0.0], [2.0, -1.0]]
    pooled.sum().backward()
    assert features.grad.tolist() == [[2.0], [0.5], [1.5]]


@FEW
@given(cells=clouds(), data=st.data())
def test_voxels_tell_what_points_they_hold_and_where(device, cells, data):
    inside = hnp.arrays(np.float32, cells.shape, elements=st.sampled_from([0.0, 0.25, 0.875]))
    points = cells + data.draw(inside)
    cut = data.draw(st.integers(0, points.shape[1]))
    place = wp.device_to_torch(device)
    kinds = [torch.tensor(part, device=place) for part in (points[:, :cut], points[:, cut:])]
    # In voxels of half a unit, exact in single precision.
    found = voxelise([0.5 * kind for kind in kinds], 0.5)
    rows = found.sites.coordinates.tolist()
    expected = np.zeros((len(rows), 8))
    there = set()
    for cloud, column in itertools.product(*map(range, points.shape[:2])):
        point = points[cloud, column].astype(float)
        if not np.isfinite(point).all():
            continue
        voxel = [cloud, *np.floor(point).astype(int).tolist()]
        there.add(tuple(voxel))
        kind = 4 * int(column >= cut)
        row = expected[rows.index(voxel)]
        row[kind] += 1
        row[kind + 1 : kind + 4] += point - np.floor(point) - 0.5
    for row in expected:
        row[:4] /= max(1.0, row[0])
        row[4:] /= max(1.0, row[4])
    assert sorted(map(tuple, rows)) == sorted(there)
    np.testing.assert_allclose(found.features.cpu(), expected, atol=1e-6)


def test_half_precision_multiplies_in_it_and_learns_in_single(device):
    sites = sites_of(np.random.default_rng(0).integers(-4, 4, (2, 100, 3)), device)
    conv = SubmanifoldConv(4, 5).to(sites.keys.device)
    features = random_features(sites, 4, torch.float32).requires_grad_()
    exact = conv(SparseTensor(features, sites)).features
    with torch.autocast(sites.keys.device.type, dtype=torch.bfloat16):
        half = conv(SparseTensor(features, sites)).features
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), exact, atol=0.02, rtol=0.02)
    half.float().square().sum().backward()
    assert conv.weight.grad.dtype == features.grad.dtype == torch.float32
