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
        RuntimeError: The example cannot run here: it is not installed, its hand is not in Newton's asset
            cache and cannot be fetched, or it fails on this device.
    """
    # A yardstick that is missing must not end the benchmark, for whatever reason it is missing.
    try:
        with wp.ScopedDevice(device):
            return _measure(worlds, device)
    except Exception as error:
        raise RuntimeError(f"Newton's Allegro example cannot run here: {error}") from error


def _measure(worlds: int, device: str) -> tuple[float, float]:
    from newton.examples.robot.example_robot_allegro_hand import Example

    arguments = Example.create_parser().parse_args(["--viewer", "null", "--world-count", str(worlds)])
    viewer: Any = newton.viewer.ViewerNull(num_frames=FRAMES)
    example = Example(viewer, arguments)
    for _ in range(FRAMES):
        example.step()
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(FRAMES):
        example.step()
    wp.synchronize_device(device)
    elapsed = time.perf_counter() - start
    return worlds * FRAMES * example.sim_substeps / elapsed, example.sim_dt
