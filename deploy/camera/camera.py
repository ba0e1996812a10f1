"""Images for the control loop and the calibration, from a RealSense or a simulated camera."""

import threading
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from vd.assets_usd.hand_data import Intrinsics


class CameraError(RuntimeError):
    """A camera that cannot be used as asked; names the remedy."""


class StaleCamera(CameraError):  # noqa: N818 - it names the state, as the reports of the loop do
    """No new image came in time."""


@dataclass(frozen=True)
class Frame:
    """One image."""

    image: np.ndarray
    """Depth along the optical axis [m], 0 for none, float32 [H, W]; of infrared brightness, uint8
    [H, W].
    """
    time_s: float
    """When it was exposed [s], on the clock of :func:`time.monotonic`."""


class ImageSource(Protocol):
    """Where images come from. Optical frame: x right, y down, z forward."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the images that :meth:`read` returns."""

    def read(self, timeout_s: float) -> Frame:
        """The newest image, waiting [s] for one that was not returned before.

        Raises:
            StaleCamera: No new image came in time.
        """

    def close(self) -> None:
        """Stop the camera; no :meth:`read` after this."""


class NewestImage:
    """The newest image of a thread that brings them."""

    def __init__(self) -> None:
        self._image: Any = None
        self._arrived = threading.Condition()

    def put(self, image: Any) -> None:
        """Called with every image."""
        with self._arrived:
            self._image = image
            self._arrived.notify()

    def take(self, timeout_s: float, nothing: str) -> Any:
        """The one that was not taken yet.

        Raises:
            StaleCamera: ``nothing`` came within ``timeout_s``.
        """
        with self._arrived:
            if not self._arrived.wait_for(lambda: self._image is not None, timeout_s):
                raise StaleCamera(f"{nothing} within {timeout_s:.2f} s")
            image = self._image
            self._image = None
        return image
