"""Depth and infrared images of an Intel RealSense through its SDK.

The depth image is that of the left infrared imager, so both have the same optical frame.
"""

import time
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import Intrinsics
from vd.command import interrupt
from vd.command.config import require
from vd.deploy.camera.camera import CameraError, Frame, NewestImage

MILLISECOND = 1e-3


@dataclass(frozen=True)
class RealSenseCfg:
    """A RealSense camera; the defaults are for a D415 on USB 3."""

    serial: str = ""
    """Serial number; empty for the only camera."""
    width: int = 640
    """Columns that the camera sends."""
    height: int = 360
    """Rows that the camera sends."""
    fps: int = 30
    """Images a second."""
    decimation: int = 2
    """Pixels a side that become one, in the SDK: from 640 x 360 the 320 x 180 of training. It takes
    the median of 2 or 3 a side, the mean of more, which puts points between near and far things."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming field and remedy."""
        require(self, "camera.", "positive", "width height fps")
        if not 1 <= self.decimation <= 8:
            raise ValueError(f"camera.decimation = {self.decimation}; choose 1 (off) to 8")


def sdk() -> ModuleType:
    """The SDK's Python package.

    Raises:
        CameraError: It is not installed.
    """
    try:
        import pyrealsense2
    except ImportError as error:
        # Its wheel takes one library from the system.
        remedy = (
            "apt install libusb-1.0-0"
            if "libusb" in str(error)
            else interrupt.remedy("pyrealsense2")
        )
        raise CameraError(f"the RealSense SDK cannot be imported ({error}); {remedy}") from error
    return pyrealsense2


def find_device(serial: str = "") -> Any:
    """The RealSense camera that is connected.

    Raises:
        CameraError: There is none, or several and ``serial`` names none of them.
    """
    rs = sdk()
    devices = {d.get_info(rs.camera_info.serial_number): d for d in rs.context().query_devices()}
    if not devices:
        raise CameraError(
            "no RealSense camera answers; check its cable and port (USB 3), the udev rules of "
            "librealsense, and that no other program holds it"
        )
    if serial not in devices and (serial or len(devices) > 1):
        raise CameraError(
            f"no RealSense {serial!r}; connected: {', '.join(devices)}. Name one with serial"
        )
    return devices[serial] if serial else next(iter(devices.values()))


class RealSense:
    """Depth images, decimated, or undecimated infrared ones without the projected pattern.

    Filters other than decimation are off, as in training.

    Args:
        device: Of the SDK.
        cfg: Settings.
        infrared: The left infrared imager in place of depth.

    Attributes:
        intrinsics: Of the images. Those that the SDK gives for a decimated image are off by up to
            half a pixel, since it scales the principal point as if pixels had no width.

    Raises:
        CameraError: The camera has no such images.
        ValueError: A setting that cannot be.
    """

    def __init__(self, device: Any, cfg: RealSenseCfg | None = None, *, infrared: bool = False):
        """Start the stream."""
        cfg = cfg or RealSenseCfg()
        cfg.validate()
        self._rs = rs = sdk()
        self._device = device  # held: the SDK closes what nobody holds
        kind = (rs.stream.infrared, rs.format.y8) if infrared else (rs.stream.depth, rs.format.z16)
        self._sensor, profile = _choose(device, *kind, cfg)
        options = {rs.option.global_time_enabled: 1.0}
        if infrared:
            options[rs.option.emitter_enabled] = 0.0
        for option, value in options.items():
            if self._sensor.supports(option):  # a D405 has no projector
                self._sensor.set_option(option, value)
        side = 1 if infrared else cfg.decimation
        self._infrared = infrared
        self._decimate = rs.decimation_filter(side) if side > 1 else None
        lens = _intrinsics(profile.as_video_stream_profile())
        self.intrinsics = Intrinsics(
            lens.width // side,
            lens.height // side,
            *(value / side for value in (lens.fx, lens.fy, lens.cx, lens.cy)),
        )
        self._newest = NewestImage()
        self._sensor.open(profile)
        self._sensor.start(self._newest.put)

    def read(self, timeout_s: float) -> Frame:
        """The newest image that was not returned yet.

        Raises:
            StaleCamera: None came within ``timeout_s``.
            CameraError: Nobody knows its age.
        """
        nothing = "check the camera's cable (USB 3) and power: no image from it"
        frame = self._newest.take(timeout_s, nothing)
        if frame.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock:
            raise CameraError(
                "the camera stamps its images by a clock of its own, so nobody knows their age: "
                "switch its option global_time_enabled on (realsense-viewer)"
            )
        time_s = frame.get_timestamp() * MILLISECOND + time.monotonic() - time.time()
        if self._infrared:
            return Frame(np.array(np.asarray(frame.get_data()), dtype=np.uint8), time_s)
        if self._decimate is not None:
            frame = self._decimate.process(frame)
        depth = frame.as_depth_frame()
        # The SDK pads decimated images to multiples of four; the padding has no depth.
        raw = np.asarray(depth.get_data())[: self.intrinsics.height, : self.intrinsics.width]
        return Frame(raw * np.float32(depth.get_units()), time_s)

    def close(self) -> None:
        """Stop the stream."""
        self._sensor.stop()
        self._sensor.close()
        del self._sensor, self._device, self._newest


def _choose(device: Any, stream: Any, pixels: Any, cfg: RealSenseCfg) -> tuple[Any, Any]:
    """Sensor and profile of the wanted size.

    Raises:
        CameraError: There is none; names those that there are.
    """
    offered = []
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            wanted = profile.stream_type() == stream and profile.format() == pixels
            if not wanted or profile.stream_index() > 1:
                continue
            video = profile.as_video_stream_profile()
            offered.append((video.width(), video.height(), video.fps()))
            if offered[-1] == (cfg.width, cfg.height, cfg.fps):
                return sensor, profile
    sizes = ", ".join(f"{w} x {h} at {fps} Hz" for w, h, fps in sorted(set(offered), reverse=True))
    raise CameraError(
        f"the camera has no {stream.name} images of {cfg.width} x {cfg.height} at {cfg.fps} Hz; "
        f"it has {sizes or 'none at all'}. On USB 2 it has fewer: use a USB 3 cable and port"
    )


def _intrinsics(profile: Any) -> Intrinsics:
    """Of a stream. The SDK's pixel centres are at whole numbers, ours at halves.

    Raises:
        CameraError: Its images are distorted.
    """
    lens = profile.get_intrinsics()
    if any(abs(c) > 0.0 for c in lens.coeffs):
        raise CameraError(
            f"the camera's images are distorted ({lens.model.name}, {list(lens.coeffs)}); "
            "use its rectified depth or left infrared stream"
        )
    return Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.ppx + 0.5, lens.ppy + 0.5)
