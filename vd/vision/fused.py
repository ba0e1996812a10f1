"""Sparse convolution on a GPU, gathering and multiplying in one kernel: no gathered matrix in memory.

Written in Triton, which comes with torch's builds for CUDA; without it :mod:`vd.vision.sparse` gathers
first. Every output is written by one program, in a fixed order of sums, so results repeat.

Tables are those of :mod:`vd.kernels.sparse.coordinate_maps`; j = k INNER + c counts the rows of the weights
as one matrix [K INNER, OUTER]. Sums are of single precision, products of the inputs' precision.
"""

import torch
import triton
import triton.language as tl
from torch.nn.functional import pad

ROWS = 128
"""Outputs of a program. Sizes here are those that were fastest, or nearly, for most layers on an H200."""
COLUMNS = 128
"""Channels of a program's outputs at most."""
DEPTH = 64
"""Rows of the weights multiplied at once at most."""
LEAST = 16
"""Side of the smallest product of a GPU's matrix units."""
GRADIENT_ROWS = 64
"""Outputs that a gradient of the weights sums at once."""
PROGRAMS = 2048
"""Programs that fill a GPU: a gradient of the weights is summed in so many parts."""
SIZES = ["inputs", "outputs", "part_rows"]
"""Arguments that differ from batch to batch: kernels are not compiled anew for sizes that 16 divides."""


@triton.jit
def gather(
    features,
    table,
    row,
    asked,
    step,
    inputs,
    INNER: tl.constexpr,
    KERNEL: tl.constexpr,
    ROWS: tl.constexpr,
    DEPTH: tl.constexpr,
):
    """Columns step DEPTH on of the gathered matrix [M, KERNEL INNER], for the ``asked`` of ROWS rows."""
    if INNER % DEPTH == 0:  # channels of one offset
        column = step % (INNER // DEPTH) * DEPTH + tl.arange(0, DEPTH)
        source = tl.load(table + row * KERNEL + step // (INNER // DEPTH), mask=asked, other=inputs).to(
            tl.int64
        )
        place = source[:, None] * INNER + column[None, :]
        values = tl.load(features + place, mask=(source < inputs)[:, None], other=0.0)
    else:  # all channels of several offsets
        k = step * (DEPTH // INNER) + tl.arange(0, DEPTH // INNER)
        some = asked[:, None] & (k < KERNEL)[None, :]
        source = tl.load(table + row[:, None] * KERNEL + k[None, :], mask=some, other=inputs).to(tl.int64)
        place = source[:, :, None] * INNER + tl.arange(0, INNER)[None, None, :]
        values = tl.load(features + place, mask=(source < inputs)[:, :, None], other=0.0)
        values = tl.reshape(values, (ROWS, DEPTH))
    return values


@triton.jit(do_not_specialize=SIZES[:2])
def multiply_kernel(
    features,
    table,
    weight,
    output,
    inputs,
    outputs,
    INNER: tl.constexpr,
    OUTER: tl.constexpr,
    KERNEL: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    DEPTH: tl.constexpr,
):
    """output[m, o] = sum over k and c of features[table[m, k], c] weight[k, c, o], a block a program."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    depth = tl.arange(0, DEPTH)
    total = tl.zeros((ROWS, COLUMNS), dtype=tl.float32)
    for step in range((KERNEL * INNER + DEPTH - 1) // DEPTH):
        j = step * DEPTH + depth
        values = gather(features, table, row, row < outputs, step, inputs, INNER, KERNEL, ROWS, DEPTH)
        factors = tl.load(
            weight + j[:, None] * OUTER + column[None, :],
            mask=(j < KERNEL * INNER)[:, None] & (column < OUTER)[None, :],
            other=0.0,
        )
        total = tl.dot(values, factors, total, input_precision="ieee")
    tl.store(
        output + row[:, None] * OUTER + column[None, :],
        total.to(output.dtype.element_ty),
        mask=(row < outputs)[:, None] & (column < OUTER)[None, :],
    )


@triton.jit(do_not_specialize=SIZES)
def weight_gradient_kernel(
    features,
    table,
    gradient,
    partial,
    inputs,
    outputs,
    part_rows,
    INNER: tl.constexpr,
    OUTER: tl.constexpr,
    KERNEL: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    DEPTH: tl.constexpr,
):
    """partial[p, j, o] = sum over the rows m of part p of features[table[m, k], c] gradient[m, o]."""
    j = tl.program_id(0) * DEPTH + tl.arange(0, DEPTH)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    part = tl.program_id(2)
    first = part.to(tl.int64) * part_rows
    last = tl.minimum(first + part_rows, outputs)
    total = tl.zeros((DEPTH, COLUMNS), dtype=tl.float32)
    for start in range(first, last, ROWS):
        row = start + tl.arange(0, ROWS)
        values = gather(
            features, table, row, row < last, tl.program_id(0), inputs, INNER, KERNEL, ROWS, DEPTH
        )
        grads = tl.load(
            gradient + row[:, None] * OUTER + column[None, :],
            mask=(row < last)[:, None] & (column < OUTER)[None, :],
            other=0.0,
        )
        total = tl.dot(tl.trans(values), grads, total, input_precision="ieee")
    tl.store(
        partial + (part.to(tl.int64) * KERNEL * INNER + j[:, None]) * OUTER + column[None, :],
        total,
        mask=(j < KERNEL * INNER)[:, None] & (column < OUTER)[None, :],
    )


def _side(size: int, most: int) -> int:
    """A power of two that holds ``size``, between what matrix units take and ``most``."""
    return min(most, max(LEAST, triton.next_power_of_2(size)))


def _width(features: torch.Tensor) -> int:
    """Half precisions in an entry: blocks of single precision are smaller, to stay in registers."""
    return features.element_size() // 2


def _depth(inner: int, features: torch.Tensor) -> int:
    """Rows of the weights at once: channels of one offset, or of several where there are few."""
    return min(DEPTH // _width(features), inner & -inner) if inner >= LEAST else 2 * LEAST


def _spare(channels: int) -> int:
    """Channels of zeros that make a power of two of few channels, a multiple of 16 of many."""
    return -channels % LEAST if channels > LEAST else triton.next_power_of_2(channels) - channels


def multiply(features: torch.Tensor, table: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Sum over k of ``features[table[:, k]] @ weight[k]``.

    Shapes [F, C_in], [M, K] and [K, C_in, C_out] give [M, C_out].
    """
    if spare := _spare(features.shape[1]):
        features, weight = pad(features, (0, spare)), pad(weight, (0, 0, 0, spare))
    (inputs, inner), (outputs, kernel), outer = features.shape, table.shape, weight.shape[2]
    rows, columns, depth = ROWS // _width(features), _side(outer, COLUMNS), _depth(inner, features)
    output = features.new_empty((outputs, outer))
    if outputs:
        with torch.cuda.device_of(features):
            multiply_kernel[(triton.cdiv(outputs, rows), triton.cdiv(outer, columns))](
                features.contiguous(),
                table,
                weight.contiguous(),
                output,
                inputs,
                outputs,
                INNER=inner,
                OUTER=outer,
                KERNEL=kernel,
                ROWS=rows,
                COLUMNS=columns,
                DEPTH=depth,
            )
    return output


def weight_gradient(features: torch.Tensor, table: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """Gradient [K, C_in, C_out] of the weights for the outputs' [M, C_out], in single precision."""
    channels = features.shape[1]
    if spare := _spare(channels):
        features = pad(features, (0, spare))
    (inputs, inner), (outputs, kernel), outer = features.shape, table.shape, gradient.shape[1]
    rows, columns, depth = GRADIENT_ROWS // _width(features), _side(outer, COLUMNS), _depth(inner, features)
    tiles = triton.cdiv(kernel * inner, depth), triton.cdiv(outer, columns)
    blocks = triton.cdiv(outputs, rows)
    part = max(1, triton.cdiv(blocks * tiles[0] * tiles[1], PROGRAMS))
    parts = triton.cdiv(blocks, part)
    partial = torch.empty((parts, kernel, inner, outer), dtype=torch.float32, device=features.device)
    if parts:
        with torch.cuda.device_of(features):
            weight_gradient_kernel[(*tiles, parts)](
                features.contiguous(),
                table,
                gradient.contiguous(),
                partial,
                inputs,
                outputs,
                part * rows,
                INNER=inner,
                OUTER=outer,
                KERNEL=kernel,
                ROWS=rows,
                COLUMNS=columns,
                DEPTH=depth,
            )
    return partial.sum(dim=0)[:, :channels]
