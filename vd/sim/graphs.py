"""Sequences of kernel launches, as graphs of a device."""

from collections.abc import Callable
from typing import Any

import warp as wp


class Graphs:
    """Replays what was launched before.

    ``captured``: nothing of it is the host's work, so that it can.
    """

    def __init__(self, device: str, *, captured: bool = True):
        self._device = device
        self._captured = captured
        self._known: dict[str, Any] = {}

    def replay(self, launch: Callable[[], None]) -> None:
        """Launch what a function launches.

        At first as it is, which loads the kernels, then as a graph.
        """
        name = launch.__name__
        if not self._captured or name not in self._known:
            self._known[name] = None
            launch()
            return
        if self._known[name] is None:
            with wp.ScopedCapture(device=self._device) as capture:
                launch()
            self._known[name] = capture.graph
        wp.capture_launch(self._known[name])

    def clear(self) -> None:
        """Release the graphs."""
        self._known.clear()
