"""A RealSense without the camera: the SDK's software device, to which images of our renderer are handed.

The SDK treats it as any other device, so streams, filters, recording and our own code are those that meet
a real camera.
"""

import time
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.realsense import sdk

DEPTH_UNIT_M = 0.001
"""Step of the depth values of a D415, unless it is set [m]."""
BASELINE_MM = 55.0
"""Distance of its imagers, which the SDK's filters need for disparities."""
LARGEST = np.iinfo(np.uint16).max


class CameraTwin:
    """A RealSense with a depth stream and a left infrared stream, both of the same lens."""

    def __init__(
        self, intrinsics: Intrinsics, *, fps: int = 30, serial: str = "twin", projector: bool = True
    ):
        """Make the device.

        Args:
            intrinsics: Of the images, before filters.
            fps: Images a second, as the device says; how often it sends is up to ``show``.
            serial: Its serial number.
            projector: Whether it has one; a D405 has none.

        Raises:
            CameraError: The SDK is not installed.
        """
        rs = sdk()
        self._rs = rs
        self.intrinsics, self.fps = intrinsics, fps
        self.device = rs.software_device()
        """The device, for :class:`vd.deploy.camera.realsense.RealSense`."""
        self.device.register_info(rs.camera_info.name, "twin of a RealSense")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self._sensor = self.device.add_sensor("Stereo Module")
        self._depth = self._add(rs.stream.depth, 0, rs.format.z16, 2)
        self._infrared = self._add(rs.stream.infrared, 1, rs.format.y8, 1)
        self._sensor.add_read_only_option(rs.option.stereo_baseline, BASELINE_MM)
        for option, largest, step, value in (
            (rs.option.depth_units, 0.01, 1e-6, DEPTH_UNIT_M),
            (rs.option.emitter_enabled, 1.0, 1.0, 1.0),
            (rs.option.visual_preset, 6.0, 1.0, 0.0),
        ):
            if option == rs.option.emitter_enabled and not projector:
                continue
            choices = rs.option_range()
            choices.min, choices.max, choices.step, choices.default = 0.0, largest, step, value
            self._sensor.add_option(option, choices, True)
        self._shown = 0

    def _add(self, stream: Any, index: int, pixels: Any, size: int) -> Any:
        rs, lens = self._rs, self.intrinsics
        video = rs.video_stream()
        video.type, video.index, video.uid = stream, index, index
        video.width, video.height, video.fps = lens.width, lens.height, self.fps
        video.bpp, video.fmt = size, pixels
        video.intrinsics = _sdk_intrinsics(rs, lens)
        return self._sensor.add_video_stream(video).as_video_stream_profile()

    @property
    def depth_unit_m(self) -> float:
        """Step of the depth values [m]."""
        return float(self._sensor.get_option(self._rs.option.depth_units))

    @property
    def emitter(self) -> bool:
        """Whether the pattern is projected."""
        return bool(self._sensor.get_option(self._rs.option.emitter_enabled))

    def show(
        self, depth_m: np.ndarray, time_s: float | None = None, *, hardware_clock_s: float = 0.0
    ) -> None:
        """Send a depth image.

        Args:
            depth_m: Depth along the optical axis [m], 0 for none, shape [H, W].
            time_s: When it was exposed, on the monotonic clock [s]; now by default.
            hardware_clock_s: What the camera's own clock showed at monotonic zero [s]; with 0 stamps are on
                the computer's clock, as with the SDK's global time.
        """
        steps = np.rint(np.asarray(depth_m) / self.depth_unit_m)
        raw = np.where((steps > 0) & (steps <= LARGEST), steps, 0).astype(np.uint16)
        self._send(raw, self._depth, time_s, hardware_clock_s)

    def show_infrared(self, image: np.ndarray, time_s: float | None = None) -> None:
        """Send an infrared image, uint8 [H, W]."""
        self._send(np.asarray(image, dtype=np.uint8), self._infrared, time_s, 0.0)

    def _send(self, pixels: np.ndarray, profile: Any, time_s: float | None, hardware_clock_s: float) -> None:
        rs, lens = self._rs, self.intrinsics
        if pixels.shape != (lens.height, lens.width):
            raise ValueError(f"the image has shape {pixels.shape}, the camera {(lens.height, lens.width)}")
        time_s = time.monotonic() if time_s is None else time_s
        frame = rs.software_video_frame()
        frame.pixels = np.ascontiguousarray(pixels)
        frame.bpp = pixels.itemsize
        frame.stride = pixels.itemsize * lens.width
        if hardware_clock_s:
            frame.timestamp = 1e3 * (time_s + hardware_clock_s)
            frame.domain = rs.timestamp_domain.hardware_clock
        else:
            frame.timestamp = 1e3 * (time_s - time.monotonic() + time.time())
            frame.domain = rs.timestamp_domain.global_time
        frame.frame_number = self._shown
        frame.profile = profile
        frame.depth_units = self.depth_unit_m
        self._shown += 1
        self._sensor.on_video_frame(frame)


def _sdk_intrinsics(rs: Any, lens: Intrinsics) -> Any:
    """The SDK's form; its pixel centres are at whole numbers, ours at halves."""
    result = rs.intrinsics()
    result.width, result.height = lens.width, lens.height
    result.fx, result.fy, result.ppx, result.ppy = lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5
    result.model, result.coeffs = rs.distortion.none, [0.0] * 5
    return result
