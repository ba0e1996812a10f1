"""Sparse layers: convolution, max pooling and global pooling over :class:`vd.student.sites.Sites`.

A convolution gathers the rows under its kernel into one matrix [M, K C_in] and multiplies it once with
the weights [K C_in, C_out]. At this network's few sites a cloud that is faster than a product for
every offset with scattered sums, although it multiplies zeros (docs/student.md). No sum is scattered
in the backward pass either: the gradient of the input is a gather too, with the reverse map, so
results do not depend on the order of atomic additions.
"""

import math
from typing import Any

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from vd.kernels.coordinate_maps import KERNEL
from vd.student.sites import Sites

GATHER_LIMIT = {"cpu": 2**20, "cuda": 2**27}
"""Entries of the gathered matrix at most, larger ones are made in parts: 4 MB on a CPU, where a part is
multiplied before it leaves the cache (a quarter faster in training), 256 MB in half precision on a GPU."""


def gather_rows(features: torch.Tensor, table: torch.Tensor, fill: float = 0.0) -> torch.Tensor:
    """Rows of ``features`` [F, C] under each entry of ``table`` [M, K], ``fill`` for entry F: [M, K, C]."""
    padded = torch.cat([features, features.new_full((1, features.shape[1]), fill)])
    return padded.index_select(0, table.reshape(-1)).view(*table.shape, features.shape[1])


def parts(table: torch.Tensor, channels: int) -> list[slice]:
    """Rows of ``table`` [M, K] in runs whose gathered matrix keeps to :data:`GATHER_LIMIT`."""
    rows = max(1, GATHER_LIMIT[table.device.type] // (table.shape[1] * channels))
    return [slice(start, start + rows) for start in range(0, table.shape[0], rows)]


def gather_multiply(features: torch.Tensor, table: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Sum over k of ``features[table[:, k]] @ weight[k]``.

    Shapes [F, C_in], [M, K] and [K, C_in, C_out] give [M, C_out].
    """
    flat = weight.reshape(-1, weight.shape[2])
    outputs = [
        gather_rows(features, table[rows]).flatten(1) @ flat for rows in parts(table, features.shape[1])
    ]
    if len(outputs) == 1:
        return outputs[0]
    return torch.cat(outputs) if outputs else features.new_zeros((0, weight.shape[2]))


class _Convolution(torch.autograd.Function):
    """``gather_multiply`` with its gradients, by gathers alone.

    ``back`` is the reverse map [F, K]: which outputs read each input, by the same weights. The map of
    neighbours needs none: it is its own reverse with the weights in opposite order.
    """

    @staticmethod
    def forward(
        ctx: Any,
        features: torch.Tensor,
        weight: torch.Tensor,
        table: torch.Tensor,
        back: torch.Tensor | None = None,
    ) -> torch.Tensor:
        ctx.save_for_backward(features, weight, table, back)
        return gather_multiply(features, table, weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        features, weight, table, back = ctx.saved_tensors
        to_features = to_weight = None
        if ctx.needs_input_grad[0]:
            turned = weight.transpose(1, 2)
            if back is None:
                to_features = gather_multiply(grad, table, turned.flip(0))
            else:
                to_features = gather_multiply(grad, back, turned)
        if ctx.needs_input_grad[1]:
            # Gathered again, not kept: 27 times the memory of the features would be.
            total = weight.new_zeros((weight.shape[0] * weight.shape[1], weight.shape[2]))
            for rows in parts(table, features.shape[1]):
                total = total.addmm(gather_rows(features, table[rows]).flatten(1).t(), grad[rows])
            to_weight = total.view_as(weight)
        return to_features, to_weight, None, None


class _WindowMaximum(torch.autograd.Function):
    """Largest of each window; the gradient goes to the first row that has it."""

    @staticmethod
    def forward(ctx: Any, features: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
        values, winner = gather_rows(features, table, -math.inf).max(dim=1)
        ctx.save_for_backward(table.gather(1, winner).long())
        ctx.rows = features.shape[0]
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        (winner,) = ctx.saved_tensors
        # Windows do not overlap: no entry is written twice.
        return grad.new_zeros((ctx.rows, grad.shape[1])).scatter_(0, winner, grad), None


class SparseConv3d(nn.Module):
    """A 3x3x3 convolution without bias on occupied cells.

    With stride 1 outputs are at the input's cells (submanifold), input = output + offset; with stride 2
    at the cells of the next level that hold any, input = 2 output + offset, offsets in {-1, 0, 1}^3.

    Attributes:
        weight: Shape [27, in_channels, out_channels]; offset k as in :mod:`vd.kernels.coordinate_maps`.
    """

    def __init__(self, in_channels: int, out_channels: int, *, stride: int = 1):
        super().__init__()
        if stride not in (1, 2):
            raise ValueError(f"stride {stride}: a sparse convolution has stride 1 or 2")
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(KERNEL, in_channels, out_channels))
        # He et al., fan out: keeps the variance of gradients through ReLU.
        nn.init.normal_(self.weight, std=math.sqrt(2.0 / (KERNEL * out_channels)))

    def forward(self, features: torch.Tensor, sites: Sites) -> torch.Tensor:
        """Convolve ``features`` [M, C_in]; rows of the result are of ``sites``, or of ``sites.coarser``."""
        weight = self.weight
        if torch.is_autocast_enabled(features.device.type):
            dtype = torch.get_autocast_dtype(features.device.type)
            features, weight = features.to(dtype), weight.to(dtype)
        if self.stride == 2:
            back = sites.strided_back if features.requires_grad else None
            return _Convolution.apply(features, weight, sites.strided, back)
        return _Convolution.apply(features, weight, sites.neighbours)

    def extra_repr(self) -> str:
        """Sizes, for ``print``."""
        return f"{self.weight.shape[1]}, {self.weight.shape[2]}, stride={self.stride}"


class SparseMaxPool3d(nn.Module):
    """Largest value in each 2x2x2 window, stride 2, over its occupied cells."""

    def forward(self, features: torch.Tensor, sites: Sites) -> torch.Tensor:
        """Pool ``features`` [M, C] to [coarser M, C]."""
        return _WindowMaximum.apply(features, sites.windows)


def global_pool(features: torch.Tensor, sites: Sites) -> torch.Tensor:
    """Largest value and mean of each cloud's features, side by side: [B, 2 C], zeros for an empty cloud.

    In single precision at least, whatever the features are.
    """
    values = features.float() if features.dtype in (torch.half, torch.bfloat16) else features
    lengths = sites.offsets.diff().long()
    filled = (lengths > 0).unsqueeze(1)
    pooled = [
        torch.where(filled, torch.segment_reduce(values, kind, lengths=lengths, unsafe=True), 0.0)
        for kind in ("max", "mean")
    ]
    return torch.cat(pooled, dim=1)
