"""Sparse 3D convolutional layers on the occupied voxels of point clouds.

A convolution gathers the rows under its kernel into one matrix [M, 27 C_in] and multiplies it once
with the weights [27 C_in, C_out]. The gradient of its input is a gather too, by the reverse map: no
sum depends on the order of atomic additions. Kernels find the rows
(:mod:`vd.kernels.sensor.sparse_conv`), once for all layers of a level, forward and backward.

B clouds of P points, M cells, C channels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
import warp as wp
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from vd.geometry.arrays import as_warp
from vd.kernels.launch import launch
from vd.kernels.sensor.sparse_conv import (
    KERNEL,
    gather_rows_kernel,
    kernel_map_kernel,
    voxel_feature_kernel,
)
from vd.kernels.sensor.voxels import CLOUD_SHIFT, coordinates_kernel, voxel_key_kernel

GATHERED = {"cpu": 2**20, "cuda": 2**28}
"""Entries of a gathered matrix at most; larger ones are made in parts. 4 MB on a CPU, where a part
is multiplied before it leaves the cache; 512 MB in half precision on a GPU."""


class Sites:
    """M occupied cells of B clouds, on a grid whose cells are ``step`` voxels wide.

    Maps and coarser grids are made when first asked for, and kept.

    Args:
        keys: Keys of the cells (:mod:`vd.kernels.sensor.sparse_conv`), each once, ascending,
            int64 [M].
        clouds: B.
        step: Voxels of a cell's side, a power of two.
    """

    def __init__(self, keys: Tensor, clouds: int, step: int = 1):
        self.keys = keys
        self.clouds = clouds
        self.step = step

    def __len__(self) -> int:
        return len(self.keys)

    @cached_property
    def warp_keys(self) -> wp.array:
        """The keys, for kernels."""
        return as_warp(self.keys)

    @cached_property
    def coordinates(self) -> Tensor:
        """Rows (cloud, x, y, z) in voxels: each cell begins there, int32 [M, 4]."""
        rows = self.keys.new_empty((len(self), 4), dtype=torch.int32)
        launch(coordinates_kernel, len(self), [self.warp_keys], [as_warp(rows)])
        return rows

    @cached_property
    def lengths(self) -> Tensor:
        """Cells of each cloud, int64 [B]."""
        ends = torch.arange(self.clouds + 1, device=self.keys.device) << CLOUD_SHIFT
        return torch.searchsorted(self.keys, ends).diff()

    @cached_property
    def coarser(self) -> "Sites":
        """Cells of twice the side that hold any of these."""
        step = 2 * self.step
        fine_bits = step**3 - 1
        keys = torch.unique_consecutive(self.keys & ~fine_bits)
        return Sites(keys, self.clouds, step)

    @cached_property
    def neighbours(self) -> Tensor:
        """Rows that a kernel of stride 1 reads for each cell, M for none, int32 [M, 27]."""
        return kernel_map(self, self, self.step)

    @cached_property
    def strided(self) -> Tensor:
        """Rows a kernel of stride 2 reads for each coarser cell, M for none, int32 [.., 27]."""
        return kernel_map(self.coarser, self, self.step)

    @cached_property
    def strided_back(self) -> Tensor:
        """Coarser cells that read each cell so, by the opposite offsets, int32 [M, 27]."""
        return kernel_map(self, self.coarser, self.step)


@dataclass(frozen=True)
class SparseTensor:
    """Features of the occupied cells of a batch of clouds."""

    features: Tensor
    """A row of each cell [M, C]."""
    sites: Sites
    """The cells."""


def kernel_map(outputs: Sites, inputs: Sites, step: int) -> Tensor:
    """Rows of ``inputs`` under a 3x3x3 kernel about each of ``outputs``, int32 [M, 27].

    Offsets are ``step`` voxels apart; F, their number, is where there is no cell.
    """
    table = outputs.keys.new_empty((len(outputs), KERNEL), dtype=torch.int32)
    launch(
        kernel_map_kernel,
        len(outputs),
        [outputs.warp_keys, inputs.warp_keys, step],
        [as_warp(table)],
    )
    return table


@torch.no_grad()
def voxelise(kinds: Sequence[Tensor], voxel_m: float) -> SparseTensor:
    """Voxels of clouds, with features that tell what points they hold.

    Args:
        kinds: Points of each kind [m] [B, P, 3] each; those that are not finite, or 10 m off, are
            left out.
        voxel_m: Side of a voxel [m].

    Returns:
        Of each kind 1 if a point of it is there, and their mean place from the voxel's middle
        [voxels], zeros for none [M, 4 kinds]. No gradient flows. Waits for the device.
    """
    points = torch.cat(tuple(kinds), dim=1)
    device = points.device
    cloud_points = as_warp(points, wp.vec3)
    keys = torch.empty(points.shape[:2], dtype=torch.int64, device=device)
    launch(voxel_key_kernel, keys.shape, [cloud_points, voxel_m], [as_warp(keys)])
    keys, order = keys.flatten().sort(stable=True)
    voxels, counts = torch.unique_consecutive(keys, return_counts=True)
    voxels = voxels[voxels < len(points) << CLOUD_SHIFT]
    ends = counts[: len(voxels)].cumsum(0)
    start = torch.cat([counts.new_zeros(1), ends])
    number = torch.arange(len(kinds), dtype=torch.int32, device=device)
    widths = torch.tensor([cloud.shape[1] for cloud in kinds], device=device)
    column_kind = number.repeat_interleave(widths, output_size=points.shape[1])
    features = torch.empty((len(voxels), 4 * len(kinds)), device=device)
    read = [cloud_points, as_warp(column_kind), as_warp(order), as_warp(start), voxel_m]
    launch(voxel_feature_kernel, (len(voxels), len(kinds)), read, [as_warp(features)])
    return SparseTensor(features, Sites(voxels, len(points)))


def gathered(features: Tensor, table: Tensor) -> Tensor:
    """Rows of ``features`` [F + 1, C] side by side as ``table`` [M, K] names them, [M, K C]."""
    entries = table.flatten()
    if features.is_cuda:  # where torch's gather took nine tenths of the time of learning
        taken = features.new_empty((len(entries), features.shape[1]))
        rows = words(features)
        launch(
            gather_rows_kernel,
            (len(entries), rows.shape[1]),
            [rows, as_warp(entries)],
            [words(taken)],
        )
    else:
        taken = features.index_select(0, entries)
    return taken.view(len(table), table.shape[1] * features.shape[1])


def words(rows: Tensor) -> wp.array:
    """Rows [F, C] as the largest words of 16, 4 or 2 bytes that fill them, in the same memory [F, W]."""
    size = rows.shape[1] * rows.element_size()
    if size % 16 == 0:
        return as_warp(rows.view(torch.int32).unflatten(1, (-1, 4)), wp.vec4i)
    if size % 4 == 0:
        return as_warp(rows.view(torch.int32))
    return as_warp(rows.view(torch.int16))


def padded(features: Tensor) -> Tensor:
    """Features [F, C] with a last row of zeros, which maps name for no cell."""
    zeros = features.new_zeros((1, features.shape[1]))
    return torch.cat([features, zeros])


def parts(table: Tensor, channels: int) -> tuple[Tensor, ...]:
    """Runs of rows of ``table`` [M, K] whose gathered matrices keep to :data:`GATHERED`."""
    width = table.shape[1] * channels
    rows = GATHERED[table.device.type] // width
    return table.split(max(1, rows))


def gather_multiply(features: Tensor, table: Tensor, weight: Tensor) -> Tensor:
    """Sum over k of ``features[table[:, k]] @ weight[k]``.

    [F, C_in], [M, K] and [K, C_in, C_out] give [M, C_out].
    """
    rows = padded(features)
    flat = weight.flatten(0, 1)
    products = [gathered(rows, part) @ flat for part in parts(table, features.shape[1])]
    return torch.cat(products)


def weight_gradient(features: Tensor, table: Tensor, grad: Tensor) -> Tensor:
    """Gradient of the weights of :func:`gather_multiply` [K, C_in, C_out].

    It is of single precision at least. Gathers again: kept, the matrix would take 27 times the
    memory of the features.
    """
    rows = padded(features)
    kernel = table.shape[1]
    channels = features.shape[1]
    precision = torch.promote_types(features.dtype, torch.float32)
    shape = kernel * channels, grad.shape[1]
    total = torch.zeros(shape, dtype=precision, device=grad.device)
    first = 0
    for part in parts(table, channels):
        end = first + len(part)
        total += gathered(rows, part).T @ grad[first:end]
        first = end
    return total.view(kernel, channels, -1)


class _Convolution(torch.autograd.Function):
    """:func:`gather_multiply` with its gradients.

    ``back`` [F, K] names the outputs that read each input, by the opposite offsets; only the
    gradient of the features needs it. Products are made in the precision of the features.
    """

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        weight: Tensor,
        table: Tensor,
        back: Tensor | None,
    ) -> Tensor:
        ctx.save_for_backward(features, weight, table, back)
        return gather_multiply(features, table, weight.to(features.dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        features, weight, table, back = ctx.saved_tensors
        of_features = None
        of_weight = None
        if ctx.needs_input_grad[0]:
            turned = weight.to(grad.dtype).flip(0).transpose(1, 2)
            of_features = gather_multiply(grad, back, turned)
        if ctx.needs_input_grad[1]:
            of_weight = weight_gradient(features, table, grad).to(weight.dtype)
        return of_features, of_weight, None, None


def convolve(
    features: Tensor,
    weight: Tensor,
    table: Tensor,
    back: Tensor | None = None,
) -> Tensor:
    """A convolution by a map and, where features learn, its reverse; in autocast's precision."""
    if torch.is_autocast_enabled(features.device.type):
        features = features.to(torch.get_autocast_dtype(features.device.type))
    if torch.is_grad_enabled():
        return _Convolution.apply(features, weight, table, back)
    return gather_multiply(features, table, weight.to(features.dtype))


class KernelConv(nn.Module):
    """Weights of a 3x3x3 convolution without bias [27, C_in, C_out], drawn as He et al. do for outputs.

    Args:
        inputs: C_in.
        outputs: C_out.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        weight = torch.randn(KERNEL, inputs, outputs)
        self.weight = nn.Parameter(math.sqrt(2.0 / (KERNEL * outputs)) * weight)


class SubmanifoldConv(KernelConv):
    """A convolution whose outputs are at the cells of its input."""

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Output = sum of input(cell + offset) times the weights of the offset."""
        table = x.sites.neighbours
        features = convolve(x.features, self.weight, table, table)
        return SparseTensor(features, x.sites)


class StridedConv(KernelConv):
    """A convolution of stride 2; its outputs are at the coarser cells."""

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Output = sum of input(2 cell + offset) times the weights of the offset."""
        back = x.sites.strided_back if x.features.requires_grad else None
        features = convolve(x.features, self.weight, x.sites.strided, back)
        return SparseTensor(features, x.sites.coarser)


class ResidualBlock(nn.Module):
    """Twice BN, ReLU and a convolution, added to what comes in (He 2016).

    Args:
        channels: C.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.norms = nn.ModuleList([nn.BatchNorm1d(channels), nn.BatchNorm1d(channels)])
        self.convs = nn.ModuleList(
            [SubmanifoldConv(channels, channels), SubmanifoldConv(channels, channels)]
        )

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features of the same cells."""
        inner = x
        for norm, conv in zip(self.norms, self.convs, strict=True):
            features = torch.relu(norm(inner.features))
            inner = conv(SparseTensor(features, x.sites))
        return SparseTensor(x.features + inner.features, x.sites)


def global_pool(x: SparseTensor) -> Tensor:
    """Largest and mean of each cloud's features [B, 2 C]; zeros of a cloud without cells.

    Of single precision at least.
    """
    precision = torch.promote_types(x.features.dtype, torch.float32)
    values = x.features.to(precision)
    lengths = x.sites.lengths
    most = torch.segment_reduce(values, "max", lengths=lengths, unsafe=True)
    mean = torch.segment_reduce(values, "mean", lengths=lengths, unsafe=True)
    occupied = (lengths > 0)[:, None]
    pooled = torch.cat([most, mean], dim=1)
    return torch.where(occupied, pooled, 0.0)
