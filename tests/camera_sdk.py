"""The RealSense SDK's software device.

A camera without the camera, to which a test hands images.
"""

import time
from typing import Any

import numpy as np
import pytest

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import CameraError
from vd.deploy.camera.realsense import sdk

try:
    rs = sdk()
except CameraError as error:
    pytest.skip(str(error), allow_module_level=True)

DEPTH_UNIT_M = 0.001
"""Step of the depth values of a D415 [m]."""


class SoftwareCamera:
    """A RealSense with a depth stream and a left infrared stream, of one lens, without a projector."""

    def __init__(self, lens: Intrinsics, *, fps: int = 30):
        self._lens, self._fps = lens, fps
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "software camera")
        self.device.register_info(rs.camera_info.serial_number, "none")
        self._sensor = self.device.add_sensor("Stereo Module")
        self._depth = self._add(rs.stream.depth, 0, rs.format.z16, 2)
        self._infrared = self._add(rs.stream.infrared, 1, rs.format.y8, 1)
        self._sensor.add_read_only_option(rs.option.depth_units, DEPTH_UNIT_M)
        self._shown = 0

    def _add(self, stream: Any, index: int, pixels: Any, size: int) -> Any:
        lens, video = self._lens, rs.video_stream()
        video.type, video.index, video.uid = stream, index, index
        video.width, video.height, video.fps = lens.width, lens.height, self._fps
        video.bpp, video.fmt = size, pixels
        video.intrinsics = rs.intrinsics()
        video.intrinsics.width, video.intrinsics.height = lens.width, lens.height
        given = video.intrinsics
        # The SDK's pixel centres are at whole numbers, ours at halves.
        given.fx, given.fy, given.ppx, given.ppy = lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5
        given.model, given.coeffs = rs.distortion.none, [0.0] * 5
        video.intrinsics = given
        return self._sensor.add_video_stream(video).as_video_stream_profile()

    def show(
        self, image: np.ndarray, time_s: float | None = None, *, own_clock: bool = False
    ) -> None:
        """Send a depth image [m], or of uint8 an infrared one, exposed at a time [s], now by default."""
        lens, infrared = self._lens, image.dtype == np.uint8
        pixels = image if infrared else np.rint(image / DEPTH_UNIT_M).astype(np.uint16)
        time_s = time.monotonic() if time_s is None else time_s
        frame = rs.software_video_frame()
        frame.pixels, frame.bpp = np.ascontiguousarray(pixels), pixels.itemsize
        frame.stride = pixels.itemsize * lens.width
        frame.timestamp = 1e3 * (time_s - time.monotonic() + time.time())
        domains = rs.timestamp_domain
        frame.domain = domains.hardware_clock if own_clock else domains.global_time
        frame.frame_number, frame.depth_units = self._shown, DEPTH_UNIT_M
        frame.profile = self._infrared if infrared else self._depth
        self._shown += 1
        self._sensor.on_video_frame(frame)
