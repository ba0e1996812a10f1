"""Launching and counting."""

from collections.abc import Sequence
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


def launch(
    kernel: wp.Kernel, dim: int | Sequence[int], inputs: list[Any], outputs: Sequence[wp.array]
) -> None:
    """Launch a kernel on the device of the arrays that it writes, one at least."""
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=outputs[0].device)


@wp.kernel
def count_kernel(
    # In/Out:
    number: wp.array[int],  # [1] of a step or a frame
):
    """Count one more, on the device, so that a CUDA graph can be replayed. Launch: [1]."""
    number[0] = number[0] + 1
