"""Weights of a student in a third of the space, to ship or to carry to another machine.

Convolutions, three quarters of a student, are kept in 8 bits with a scale for each output channel, other
matrices in half precision. Vectors (scales, statistics) stay as they are, and so do the teacher's layers,
by which a student knows its teacher again.
"""

from typing import Any

import torch

LEVELS = 127
"""Steps of 8 bits on each side of zero."""
EXACT = "state.teacher."
"""Prefix of the weights that nothing may be lost of."""

Packed = dict[str, Any]
"""Tensors, or for a convolution ``{"levels": int8 [K, in, out], "scale": [1, 1, out]}``, by name."""


def pack(weights: dict[str, torch.Tensor]) -> Packed:
    """Weights of a network in little space."""
    return {name: _packed(name, value.detach().cpu()) for name, value in weights.items()}


def unpack(packed: Packed) -> dict[str, torch.Tensor]:
    """Weights in single precision, from what :func:`pack` made or from weights that never were packed."""
    return {name: _unpacked(value) for name, value in packed.items()}


def _packed(name: str, value: torch.Tensor) -> Any:
    if not value.is_floating_point() or value.ndim < 2 or name.startswith(EXACT):
        return value
    if value.ndim < 3:
        return value.half()
    scale = value.abs().amax(dim=(0, 1), keepdim=True).clamp(min=torch.finfo(value.dtype).tiny) / LEVELS
    return {"levels": (value / scale).round().to(torch.int8), "scale": scale}


def _unpacked(value: Any) -> torch.Tensor:
    if isinstance(value, dict):
        return value["levels"].float() * value["scale"]
    return value.float() if value.dtype == torch.half else value
