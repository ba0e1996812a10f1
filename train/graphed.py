"""Gradients as a CUDA graph: recorded once, replayed with one launch."""

import gc
from collections.abc import Callable, Sequence

import torch
from torch import nn

WARMUP_RUNS = 3
"""Runs before the recording, on a stream of their own, in which libraries allocate what they need."""


class Recorded:
    """A function that computes gradients, run as it is or replayed from a CUDA graph.

    A graph repeats launches with the addresses that it was recorded with, so the function has to read inputs
    and weights that stay where they are, has to change nothing but the gradients, and must not wait for the
    device. The gradients lie in the graph's memory and are overwritten by the next call.

    Args:
        function: Computes ``grad`` of ``parameters`` from ``inputs`` and returns a tensor.
        inputs: Tensors that each call copies its arguments into.
        parameters: What gets gradients.
        record: Record at the first call; otherwise run the function in every call.
    """

    def __init__(
        self,
        function: Callable[[], torch.Tensor],
        inputs: Sequence[torch.Tensor],
        parameters: Sequence[nn.Parameter],
        *,
        record: bool,
    ) -> None:
        self._function, self._inputs, self._parameters, self._record = function, inputs, parameters, record
        self._graph: torch.cuda.CUDAGraph | None = None
        self._gradients: list[torch.Tensor | None] = []
        self._result = torch.empty(0)

    def __call__(self, *arguments: torch.Tensor) -> torch.Tensor:
        """Compute the gradients for these inputs.

        Returns:
            What the function returns, in memory of its own.
        """
        for own, given in zip(self._inputs, arguments, strict=True):
            own.copy_(given)
        if not self._record:
            return self._run()
        if self._graph is None:
            self._graph = self._recorded()
        self._graph.replay()
        for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
            parameter.grad = gradient
        return self._result.clone()

    def _run(self) -> torch.Tensor:
        for parameter in self._parameters:
            parameter.grad = None
        return self._function()

    def _recorded(self) -> torch.cuda.CUDAGraph:
        """Record the function; recording runs nothing."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARMUP_RUNS):
                self._run()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # Whatever the collector frees meanwhile could be of the simulator, whose freeing is no part of this.
        collecting = gc.isenabled()
        gc.collect()
        gc.disable()
        try:
            # Threads that watch over other processes go on asking the device meanwhile.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self._result = self._run()
        finally:
            if collecting:
                gc.enable()
        self._gradients = [parameter.grad for parameter in self._parameters]
        return graph
