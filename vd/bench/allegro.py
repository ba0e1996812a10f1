"""Newton's own Allegro example, stepped with its own settings, as the yardstick of ``vd-bench sim``."""

import sys
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

import warp as wp

FRAMES = 24
"""Timed frames of the example (1/50 s each, eight physics steps)."""


@dataclass(frozen=True)
class AllegroRate:
    """What the example did."""

    physics_steps_s: float
    """Physics steps per second over all environments."""
    dt_s: float
    """Length of its physics step [s]."""


def allegro_rate(envs: int, device: str) -> AllegroRate:
    """Physics steps per second of the example over so many environments.

    Newton downloads the hand (17.8 MB) where it is not in its cache.

    Raises:
        RuntimeError: The example cannot run here: it has no hand, is not installed, or fails on this device.
    """
    # A yardstick that is missing must not end the benchmark, for whatever reason it is missing.
    try:
        with wp.ScopedDevice(device), redirect_stdout(sys.stderr):  # standard output is for the rows
            example = make_example(envs)
            seconds = [_seconds(example, device) for _ in range(2)][1]  # the first time kernels are loaded
    except Exception as error:
        raise RuntimeError(f"Newton's Allegro example cannot run here: {error}") from error
    return AllegroRate(envs * FRAMES * example.sim_substeps / seconds, example.sim_dt)


def make_example(envs: int) -> Any:
    """The example, with a viewer that shows nothing."""
    import newton.viewer
    from newton.examples.robot.example_robot_allegro_hand import Example

    arguments = Example.create_parser().parse_args(["--viewer", "null", "--world-count", str(envs)])
    return Example(newton.viewer.ViewerNull(num_frames=FRAMES), arguments)


def _seconds(example: Any, device: str) -> float:
    """Time of the frames [s]."""
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(FRAMES):
        example.step()
    wp.synchronize_device(device)
    return time.perf_counter() - start
