"""Sparse layers: convolution, max pooling and global pooling over :class:`vd.vision.sites.Sites`.

A convolution gathers the rows under its kernel into one matrix [M, K C_in] and multiplies it once with
the weights [K C_in, C_out]. At this network's few sites a cloud that is faster than a product for
every offset with scattered sums, although it multiplies zeros. No sum is scattered
in the backward pass either: the gradient of the input is a gather too, with the reverse map, so
results do not depend on the order of atomic additions.

On a GPU one kernel gathers and multiplies (:mod:`vd.vision.fused`): a gathered matrix is 27 times the
features, and moving it there and back takes longer than everything else.
"""

import functools
import math
import warnings
from subprocess import SubprocessError
from types import ModuleType
from typing import Any, Literal

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from vd.kernels.sparse.coordinate_maps import KERNEL
from vd.vision.sites import Sites

GATHER_LIMIT = {"cpu": 2**20, "cuda": 2**27}
"""Entries of the gathered matrix at most, larger ones are made in parts: 4 MB on a CPU, where a part is
multiplied before it leaves the cache (a quarter faster in training), 256 MB in half precision on a GPU."""
FUSED_TYPES = (torch.float32, torch.bfloat16, torch.float16)
"""Precisions of the kernels that gather and multiply at once."""


@functools.cache
def fused_kernels(device: torch.device) -> ModuleType | None:
    """:mod:`vd.vision.fused`, or None with a warning where Triton is missing or cannot compile for a GPU."""
    try:
        from vd.vision import fused

        fused.multiply(
            torch.ones(1, 1, device=device),
            torch.zeros(1, 1, dtype=torch.int32, device=device),
            torch.ones(1, 1, 1, device=device),
        )
    except (ImportError, RuntimeError, OSError, SubprocessError) as error:  # no Triton, compiler or headers
        warnings.warn(
            f"the student's convolutions are many times slower without Triton: {error}", stacklevel=2
        )
        return None
    return fused


def fused_for(features: torch.Tensor) -> ModuleType | None:
    """The fused kernels if they take such features: on a GPU, in single or half precision."""
    takes = features.is_cuda and features.dtype in FUSED_TYPES
    return fused_kernels(features.device) if takes else None


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
    if fused := fused_for(features):
        return fused.multiply(features, table, weight)
    flat = weight.reshape(-1, weight.shape[2])
    outputs = [
        gather_rows(features, table[rows]).flatten(1) @ flat for rows in parts(table, features.shape[1])
    ]
    if len(outputs) == 1:
        return outputs[0]
    return torch.cat(outputs) if outputs else features.new_zeros((0, weight.shape[2]))


def weight_gradient(features: torch.Tensor, table: torch.Tensor, grad: torch.Tensor) -> torch.Tensor:
    """Gradient of the weights of :func:`gather_multiply`, [K, C_in, C_out], in single precision at least.

    Gathers ``features`` [F, C_in] by ``table`` [M, K] again: kept, they would take 27 times their memory.
    """
    if fused := fused_for(features):
        return fused.weight_gradient(features, table, grad)
    channels = features.shape[1]
    precision = torch.promote_types(features.dtype, torch.float32)
    total = grad.new_zeros((table.shape[1] * channels, grad.shape[1]), dtype=precision)
    for rows in parts(table, channels):
        total += gather_rows(features, table[rows]).flatten(1).t() @ grad[rows]
    return total.view(table.shape[1], channels, grad.shape[1])


class _Convolution(torch.autograd.Function):
    """``gather_multiply`` with its gradients, by gathers alone.

    ``back`` is the reverse map [F, K]: which outputs read each input, by the same weights. The map of
    neighbours needs none: it is its own reverse with the weights in opposite order. Weights may be of
    higher precision than ``features``, in which products are made; so is their gradient then.
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
        return gather_multiply(features, table, weight.to(features.dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        features, weight, table, back = ctx.saved_tensors
        to_features = to_weight = None
        if ctx.needs_input_grad[0]:
            turned = weight.to(grad.dtype).transpose(1, 2)
            if back is None:
                to_features = gather_multiply(grad, table, turned.flip(0))
            else:
                to_features = gather_multiply(grad, back, turned)
        if ctx.needs_input_grad[1]:
            to_weight = weight_gradient(features, table, grad).to(weight.dtype)
        return to_features, to_weight, None, None


class SparseConv3d(nn.Module):
    """A 3x3x3 convolution without bias on occupied cells.

    With stride 1 outputs are at the input's cells (submanifold), input = output + offset; with stride 2
    at the cells of the next level that hold any, input = 2 output + offset, offsets in {-1, 0, 1}^3.

    Attributes:
        weight: Shape [27, in_channels, out_channels]; offset k as in
        :mod:`vd.kernels.sparse.coordinate_maps`.
    """

    def __init__(self, in_channels: int, out_channels: int, *, stride: Literal[1, 2] = 1):
        super().__init__()
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(KERNEL, in_channels, out_channels))
        # He et al., fan out: keeps the variance of gradients through ReLU.
        nn.init.normal_(self.weight, std=math.sqrt(2.0 / (KERNEL * out_channels)))

    def forward(self, features: torch.Tensor, sites: Sites) -> torch.Tensor:
        """Convolve ``features`` [M, C_in]; rows of the result are of ``sites``, or of ``sites.coarser``."""
        if torch.is_autocast_enabled(features.device.type):
            features = features.to(torch.get_autocast_dtype(features.device.type))
        table = sites.strided if self.stride == 2 else sites.neighbours
        if not torch.is_grad_enabled():  # autograd's bookkeeping is a twentieth of a cloud's time on a CPU
            return gather_multiply(features, table, self.weight.to(features.dtype))
        back = sites.strided_back if self.stride == 2 and features.requires_grad else None
        return _Convolution.apply(features, self.weight, table, back)


class SparseMaxPool3d(nn.Module):
    """Largest value in each 2x2x2 window, stride 2, over its occupied cells."""

    def forward(self, features: torch.Tensor, sites: Sites) -> torch.Tensor:
        """Pool ``features`` [M, C] to [coarser M, C]."""
        return gather_rows(features, sites.windows, -math.inf).max(dim=1).values


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
