"""Newton's own Allegro example, stepped with its own settings, as the yardstick of ``vd-bench sim``."""

import time
from typing import Any

import newton
import warp as wp

FRAMES = 24
"""Timed frames of the example (1/50 s each, eight physics steps)."""


def allegro_rate(worlds: int, device: str) -> tuple[float, float]:
    """Physics steps per second of the example over all worlds, and the length of its step [s].

    Raises:
        RuntimeError: The example's hand is not in Newton's asset cache and cannot be fetched.
    """
    from newton.examples.robot.example_robot_allegro_hand import Example

    arguments = Example.create_parser().parse_args(["--viewer", "null", "--world-count", str(worlds)])
    viewer: Any = newton.viewer.ViewerNull(num_frames=FRAMES)
    with wp.ScopedDevice(device):
        try:
            example = Example(viewer, arguments)
        except Exception as error:
            raise RuntimeError(f"Newton's Allegro example cannot start here: {error}") from error
        for _ in range(FRAMES):
            example.step()
        wp.synchronize_device(device)
        start = time.perf_counter()
        for _ in range(FRAMES):
            example.step()
        wp.synchronize_device(device)
        elapsed = time.perf_counter() - start
    return worlds * FRAMES * example.sim_substeps / elapsed, example.sim_dt
