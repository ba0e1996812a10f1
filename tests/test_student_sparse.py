"""Sparse layers against dense ones, against a scalar oracle, and their gradients."""

import math
import sys

import numpy as np
import pytest
import torch
import warp as wp

import vd.vision
from vd.kernels.sparse.voxels import voxelise
from vd.vision import sparse
from vd.vision.sites import Sites
from vd.vision.sparse import SparseConv3d, SparseMaxPool3d, global_pool, parts

EXTENT = 8
"""Clouds of these tests lie in [-8, 8)."""


def make_sites(cells: np.ndarray, device: str) -> Sites:
    """Sites of cells [B, P, 3], integers."""
    points = wp.array(cells.astype(np.float32) + 0.5, dtype=wp.vec3, device=device)
    return Sites(voxelise(points, 1.0)[0], len(cells))


def random_sites(device: str, *, clouds: int = 2, points: int = 120, seed: int = 0) -> Sites:
    cells = np.random.default_rng(seed).integers(-EXTENT, EXTENT, (clouds, points, 3))
    cells[..., 2] //= 2  # some crowded, so that kernels overlap
    return make_sites(cells, device)


def features_of(sites: Sites, channels: int, dtype=torch.float32, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(len(sites), channels, dtype=dtype, generator=generator).to(sites.device)


def to_dense(values: torch.Tensor, sites: Sites, extent: int) -> torch.Tensor:
    """A dense tensor [B, C, 2 extent, 2 extent, 2 extent] with the values at their cells, zeros elsewhere."""
    dense = values.new_zeros((sites.clouds, 2 * extent, 2 * extent, 2 * extent, values.shape[1]))
    dense[indices(sites, extent)] = values
    return dense.permute(0, 4, 1, 2, 3)


def at_sites(dense: torch.Tensor, sites: Sites, extent: int) -> torch.Tensor:
    """Values [M, C] of a dense tensor at the cells."""
    return dense.permute(0, 2, 3, 4, 1)[indices(sites, extent)]


def indices(sites: Sites, extent: int) -> tuple[torch.Tensor, ...]:
    """Cloud and cell of each site, counted from the corner, [M] each."""
    corner = torch.tensor([0, extent, extent, extent], device=sites.device)
    return (sites.coordinates.long() + corner).unbind(dim=1)


def dense_weight(conv: SparseConv3d) -> torch.Tensor:
    """The weights as ``conv3d`` takes them: [C_out, C_in, 3, 3, 3]."""
    return conv.weight.detach().permute(2, 1, 0).unflatten(2, (3, 3, 3))


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("level", [0, 1])
def test_convolution_equals_a_dense_one_masked_to_the_sites(device, stride, level, monkeypatch):
    # On CUDA the dense convolution would round its products to 10 bits.
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    sites, extent = random_sites(device), EXTENT >> level
    for _ in range(level):
        sites = sites.coarser
    conv = SparseConv3d(5, 7, stride=stride).to(sites.device)
    values = features_of(sites, 5)
    result = conv(values, sites)
    outputs = sites if stride == 1 else sites.coarser
    dense = torch.nn.functional.conv3d(
        to_dense(values, sites, extent), dense_weight(conv), stride=stride, padding=1
    )
    torch.testing.assert_close(result, at_sites(dense, outputs, extent // stride), atol=1e-5, rtol=1e-5)


def test_layers_give_the_same_where_nothing_is_learned(device):
    sites = random_sites(device)
    values = features_of(sites, 5)
    for layer in (SparseConv3d(5, 7), SparseConv3d(5, 7, stride=2), SparseMaxPool3d()):
        layer = layer.to(sites.device)
        expected = layer(values, sites)
        with torch.inference_mode():
            assert torch.equal(layer(values, sites), expected)


def test_only_one_coarser_level_waits_for_the_device(device, monkeypatch):
    sites, waits, read = random_sites(device), [], wp.array.numpy
    monkeypatch.setattr(wp.array, "numpy", lambda array: waits.append(array.shape) or read(array))
    level = sites
    for _ in range(4):
        _ = level.neighbours, level.strided, level.strided_back, level.windows, level.offsets
        level = level.coarser
    assert len(waits) == 1


def test_pooling_equals_a_dense_one(device):
    sites = random_sites(device)
    values = features_of(sites, 6)
    empty = to_dense(torch.ones_like(values), sites, EXTENT) == 0
    dense = to_dense(values, sites, EXTENT).masked_fill(empty, -torch.inf)
    expected = at_sites(torch.nn.functional.max_pool3d(dense, 2), sites.coarser, EXTENT // 2)
    torch.testing.assert_close(SparseMaxPool3d()(values, sites), expected, atol=0.0, rtol=0.0)


@pytest.mark.parametrize("stride", [1, 2])
def test_gradients_of_a_convolution(device, stride):
    sites = random_sites(device, points=10)
    conv = SparseConv3d(2, 3, stride=stride).double().to(sites.device)
    values = features_of(sites, 2, torch.float64).requires_grad_()

    def run(values, weight):
        return torch.func.functional_call(conv, {"weight": weight}, (values, sites))

    assert torch.autograd.gradcheck(run, (values, conv.weight))


def test_gradients_of_pooling(device):
    sites = random_sites(device, points=12)
    values = features_of(sites, 2, torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: SparseMaxPool3d()(v, sites), (values,))
    assert torch.autograd.gradcheck(lambda v: global_pool(v, sites), (values,))


def test_global_pooling_keeps_clouds_apart_and_gives_zeros_for_an_empty_one(device):
    cells = np.zeros((3, 2, 3), np.float32)
    cells[2, 1] = 5.0
    cells[1] = np.nan
    sites = Sites(voxelise(wp.array(cells, dtype=wp.vec3, device=device), 1.0)[0], 3)
    values = torch.tensor([[-1.0], [-4.0], [2.0]], device=sites.device, requires_grad=True)
    pooled = global_pool(values, sites)
    expected = torch.tensor([[-1.0, -1.0], [0.0, 0.0], [2.0, -1.0]], device=sites.device)
    torch.testing.assert_close(pooled, expected)
    pooled.sum().backward()
    torch.testing.assert_close(values.grad, torch.tensor([[2.0], [0.5], [1.5]], device=sites.device))


def test_parts_give_the_same_as_the_whole(device, monkeypatch):
    sites = random_sites(device)
    conv = SparseConv3d(4, 4).to(sites.device)
    values = features_of(sites, 4)

    def gradients():
        inputs = values.clone().requires_grad_()
        output = conv(inputs, sites)
        (output * torch.arange(4, device=output.device)).sum().backward()
        grad, conv.weight.grad = conv.weight.grad, None
        return output.detach(), inputs.grad, grad

    whole = gradients()
    monkeypatch.setitem(sparse.GATHER_LIMIT, sites.device.type, 27 * 4 * 50)
    assert len(parts(sites.neighbours, 4)) > 2
    for one, other in zip(whole, gradients(), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def test_warns_and_gathers_where_the_fused_kernels_cannot_be_had(monkeypatch):
    monkeypatch.setitem(sys.modules, "vd.vision.fused", None)
    monkeypatch.delattr(vd.vision, "fused", raising=False)
    with pytest.warns(UserWarning, match="Triton"):
        assert sparse.fused_kernels.__wrapped__(torch.device("cpu")) is None


@pytest.mark.parametrize(("inner", "outer", "stride"), [(1, 32, 2), (32, 64, 2), (128, 256, 1), (24, 20, 1)])
def test_fused_convolution_equals_a_double_precision_one(device, inner, outer, stride):
    sites = random_sites(device, clouds=3, points=2000)
    if sparse.fused_for(features_of(sites, 1)) is None:
        pytest.skip(f"no fused kernels on {device}")
    for precision in (torch.float32, torch.bfloat16):
        values = features_of(sites, inner).to(precision)
        conv = SparseConv3d(inner, outer, stride=stride).to(sites.device)
        pull = features_of(sites if stride == 1 else sites.coarser, outer, seed=1).to(values.dtype)

        def gradients(dtype, values=values, conv=conv, pull=pull):
            inputs = values.to(dtype).requires_grad_()
            weight = conv.weight.detach().to(values.dtype).to(dtype).requires_grad_()
            output = torch.func.functional_call(conv, {"weight": weight}, (inputs, sites))
            return output, *torch.autograd.grad(output, (inputs, weight), pull.to(dtype))

        # Rounding errors of single precision wander: half a unit in the last place for each term of a sum, as
        # a random walk. Half precision is that of the results, rounded once.
        terms = max(27 * max(inner, outer), len(sites))
        bound = 2.0**-24 * math.sqrt(terms) if values.dtype is torch.float32 else 2.0**-8
        fused = gradients(values.dtype)
        for one, exact in zip(fused, gradients(torch.float64), strict=True):
            assert (one.double() - exact).norm() < bound * exact.norm()
        for again, once in zip(gradients(values.dtype), fused, strict=True):
            assert torch.equal(again, once)  # no sum depends on who comes first


def test_no_sites_flow_through(device):
    empty = wp.array(np.full((2, 3, 3), np.nan), dtype=wp.vec3, device=device)
    sites = Sites(voxelise(empty, 1.0)[0], 2)
    conv = SparseConv3d(2, 3, stride=2).to(sites.device)
    values = features_of(sites, 2).requires_grad_()
    output = SparseMaxPool3d()(conv(values, sites), sites.coarser)
    pooled = global_pool(output, sites.coarser.coarser)
    torch.testing.assert_close(pooled, torch.zeros(2, 6, device=sites.device))
    pooled.sum().backward()
