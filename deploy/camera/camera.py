"""Depth images for the control loop, whatever they come from: a RealSense, a recording, a simulated camera.

Times are seconds of :func:`time.monotonic`, the clock of the loop. Depth is along the optical axis (x right,
y down, z forward) [m]; 0 means no value, as RealSense cameras report it.
"""

import time
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from vd.assets_usd.hand_data import Intrinsics

MAX_AGE_S = 0.25
"""Age from which an image is stale [s]: three control periods. The latency of a D415 is below 0.1 s."""


AHEAD_S = 0.02
"""An image cannot be newer than the moment it came [s]; what the SDK makes of its clock is off by some ms."""


class CameraError(RuntimeError):
    """A camera that cannot be used as asked; names the remedy."""


class StaleCamera(CameraError):  # noqa: N818 - it names the state, as the reports of the loop do
    """No image that is new enough to act upon."""


@dataclass(frozen=True)
class DepthFrame:
    """One depth image."""

    depth_m: np.ndarray
    """Depth along the optical axis [m], 0 for none, float32 [H, W]."""
    time_s: float
    """When it was exposed [s], on the clock of :func:`time.monotonic`."""


@dataclass(frozen=True)
class GrayFrame:
    """One picture, for finding markers."""

    image: np.ndarray
    """Brightness, uint8 [H, W]."""
    time_s: float
    """When it was exposed [s], on the clock of :func:`time.monotonic`."""


Frame = TypeVar("Frame", DepthFrame, GrayFrame)


class DepthSource(Protocol):
    """Where depth images come from."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the images that :meth:`read` returns."""

    def read(self, timeout_s: float) -> DepthFrame:
        """The newest image, waiting for one that was not returned before.

        Args:
            timeout_s: How long to wait [s].

        Raises:
            StaleCamera: No new image came in time, or it is too old.
        """

    def close(self) -> None:
        """Stop the camera; no :meth:`read` after this."""


def check_fresh(frame: Frame, max_age_s: float = MAX_AGE_S) -> Frame:
    """The frame, if it is new enough.

    Raises:
        StaleCamera: It is older than ``max_age_s``.
    """
    age = time.monotonic() - frame.time_s
    if age > max_age_s:
        raise StaleCamera(
            f"the newest image is {age:.2f} s old, more than {max_age_s:.2f} s; "
            "check the camera's cable (USB 3), and that no filter or other program takes the processor"
        )
    return frame
