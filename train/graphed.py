"""Gradients as a CUDA graph: recorded once, replayed with one launch."""

import gc
from collections.abc import Callable, Sequence

import torch
from torch import nn

WARMUP_RUNS = 3
"""Runs before the recording, on a stream of their own, in which libraries allocate what they
need.
"""


class Recorded:
    """A function that computes gradients, recorded at its first call and then replayed.

    A graph repeats launches with the addresses that it was recorded with, so the function has to
    read inputs and weights that stay where they are, has to change nothing but the gradients, and
    must not wait for the device. The gradients lie in the graph's memory and are overwritten by the
    next call.

    Args:
        function: Computes ``grad`` of ``parameters``, which it has emptied, and returns a tensor.
        parameters: What gets gradients.
    """

    def __init__(
        self, function: Callable[[], torch.Tensor], parameters: Sequence[nn.Parameter]
    ) -> None:
        self._function = function
        self._parameters = parameters
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> torch.Tensor:
        """Compute the gradients; returns what the function returns, in memory of its own."""
        if self._graph is None:
            self._graph = self._record()
        self._graph.replay()
        for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
            parameter.grad = gradient
        return self._result.clone()

    def _record(self) -> torch.cuda.CUDAGraph:
        """Record the function; recording runs nothing."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARMUP_RUNS):
                self._function()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # Whatever the collector frees meanwhile could be of the simulator, whose freeing is no part
        # of this.
        gc.collect()
        gc.disable()
        try:
            # Threads that watch over other processes go on asking the device meanwhile.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self._result = self._function()
        finally:
            gc.enable()
        self._gradients = [parameter.grad for parameter in self._parameters]
        return graph
