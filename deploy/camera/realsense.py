"""Depth and infrared images of an Intel RealSense through its SDK, live or from a recording.

Whatever the SDK calls a device serves: a camera on the bus, a recording (``.db3``, or ``.bag`` of earlier
SDKs), or its software device, behind which :mod:`vd.deploy.twin.camera_twin` puts our own renderer. The depth
image is that of the left infrared imager, so both have the same optical frame.
"""

import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import (
    AHEAD_S,
    MAX_AGE_S,
    CameraError,
    DepthFrame,
    GrayFrame,
    StaleCamera,
    check_fresh,
)

Preset = Literal["default", "hand", "high_accuracy", "high_density", "medium_density"]
HoleFilling = Literal["none", "left", "farthest", "nearest"]
HOLE_MODES: dict[HoleFilling, int] = {"left": 0, "farthest": 1, "nearest": 2}
"""Numbers that the SDK has for them."""

CLOCK_WINDOW = 300
"""Frames from which the offset between two clocks is found: ten seconds, in which crystals part by 0.2 ms."""
MILLISECOND = 1e-3
INSTALL = "pip install -e '.[hardware]'"


@dataclass(frozen=True)
class FilterCfg:
    """Filters of the SDK, in the order in which they are applied; those of the SDK's manual."""

    decimation: int = 2
    """Pixels a side that become one: from 640 x 360 the 320 x 180 that students are trained with. The SDK
    takes the median of 2 or 3 a side, the mean of more, which puts points between near and far things."""
    threshold_m: tuple[float, float] | None = None
    """Least and largest depth that is kept [m]."""
    spatial: bool = False
    """Smooth along rows and columns, in disparity, keeping edges."""
    spatial_alpha: float = 0.5
    """Share of the new value; 1 smooths nothing."""
    spatial_delta: float = 20.0
    """Step of disparity from which it is an edge [SDK's unit]."""
    spatial_passes: int = 2
    """How often, 1 to 5."""
    temporal: bool = False
    """Smooth from image to image, in disparity. Moving things are late then."""
    temporal_alpha: float = 0.4
    """Share of the new value; 1 smooths nothing."""
    temporal_delta: float = 20.0
    """Step of disparity from which it is another surface [SDK's unit]."""
    hole_filling: HoleFilling = "none"
    """Pixels without depth take that of a neighbour. Policies are trained without."""

    def validate(self) -> None:
        """Raise ``ValueError`` for what the SDK would refuse, naming field and remedy."""
        if not 1 <= self.decimation <= 8:
            raise ValueError(f"filters.decimation = {self.decimation}; choose 1 (off) to 8")
        for name in ("spatial_alpha", "temporal_alpha"):
            least = 0.25 if name == "spatial_alpha" else 0.0
            if not least <= getattr(self, name) <= 1.0:
                raise ValueError(f"filters.{name} = {getattr(self, name)}; choose {least:g} to 1")
        if not 1 <= self.spatial_passes <= 5:
            raise ValueError(f"filters.spatial_passes = {self.spatial_passes}; choose 1 to 5")
        if not (1.0 <= self.spatial_delta <= 50.0 and 1.0 <= self.temporal_delta <= 100.0):
            raise ValueError("filters.spatial_delta must be in 1 to 50, temporal_delta in 1 to 100")
        if self.threshold_m is not None and not 0.0 <= self.threshold_m[0] < self.threshold_m[1] <= 16.0:
            raise ValueError(f"filters.threshold_m = {self.threshold_m}; name two depths, the least first")


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
    preset: Preset | None = None
    """The camera's own tuning of its stereo matching; None leaves it as it is."""
    emitter: bool | None = None
    """The pattern that it projects; None leaves it as it is."""
    depth_unit_m: float | None = None
    """Step of the depth values [m]; None leaves it as it is (a D415: 1 mm). Decimated by 4 and more, images
    are about 0.4 of it too near: the SDK cuts off what is left."""
    filters: FilterCfg = field(default_factory=FilterCfg)
    """What the SDK does with images before we see them."""
    max_age_s: float = MAX_AGE_S
    """Age from which an image is stale [s]."""
    record: Path | None = None
    """Record what the camera sends, before filters, to this file (.db3)."""

    def validate(self) -> None:
        """Raise ``ValueError`` naming field and remedy."""
        self.filters.validate()
        if min(self.width, self.height, self.fps) < 1 or not self.max_age_s > 0.0:
            raise ValueError("camera.width, height, fps and max_age_s must be positive")
        if self.record is not None and self.record.suffix != ".db3":
            raise ValueError(f"camera.record = {self.record}; the SDK records to .db3, give it that suffix")


def sdk() -> ModuleType:
    """The SDK's Python package.

    Raises:
        CameraError: It is not installed.
    """
    try:
        import pyrealsense2
    except ImportError as error:
        # Its wheel takes one library from the system.
        remedy = "apt install libusb-1.0-0" if "libusb" in str(error) else INSTALL
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
            "no RealSense camera answers; check its cable and port (USB 3), the udev rules of librealsense, "
            "and that no other program holds it"
        )
    if serial not in devices and (serial or len(devices) > 1):
        raise CameraError(f"no RealSense {serial!r}; connected: {', '.join(devices)}. Name one with serial")
    return devices[serial] if serial else next(iter(devices.values()))


def describe(device: Any) -> str:
    """Name, serial number and USB of a device, as far as it tells them."""
    info = sdk().camera_info
    asked = (("", info.name), ("", info.serial_number), ("USB ", info.usb_type_descriptor))
    return ", ".join(f"{what}{device.get_info(one)}" for what, one in asked if device.supports(one))


def open_recording(path: Path) -> Any:
    """A recording as a device that plays in real time, once.

    Raises:
        CameraError: The file is missing or no recording.
    """
    rs = sdk()
    if not Path(path).is_file():
        raise CameraError(f"{path}: no such recording; name a .db3 or .bag that the RealSense SDK recorded")
    try:
        return rs.context().load_device(str(path))
    except RuntimeError as error:
        raise CameraError(f"{path}: not a recording that the SDK reads ({error}); record it again") from error


class ClockMap:
    """From the time stamps of a device to :func:`time.monotonic`.

    Stamps on the computer's clock are only moved. For those of a clock of its own (the camera's, or that of
    a recording) the fastest of the last frames tells the offset, so that ages leave out its own latency,
    about 20 ms of a D415.
    """

    def __init__(self, own_clock: bool = False):
        """Begin; ``own_clock`` says that stamps are no computer's time, whatever they say they are."""
        self._own = own_clock
        self._offsets: deque[float] = deque(maxlen=CLOCK_WINDOW)

    def __call__(self, stamp_s: float, arrival_s: float, *, host_clock: bool) -> float:
        """Time of a stamp [s].

        Args:
            stamp_s: The frame's stamp [s].
            arrival_s: When it arrived, on the monotonic clock [s].
            host_clock: Whether the stamp is the computer's time since 1970.
        """
        if host_clock and not self._own:
            return stamp_s + time.monotonic() - time.time()
        self._offsets.append(arrival_s - stamp_s)
        return stamp_s + min(self._offsets)


class _Stream:
    """One stream of a device; keeps the newest frame and when it came."""

    def __init__(self, device: Any, stream: Any, pixels: Any, cfg: RealSenseCfg):
        cfg.validate()
        rs = sdk()
        self._rs, self._cfg = rs, cfg
        playback = device.is_playback()
        self._clock = ClockMap(own_clock=playback)
        if cfg.record is not None:
            device = rs.recorder(str(cfg.record), device)
        self._device = device  # held: the SDK closes what nobody holds
        self._sensor, profile = self._choose(stream, pixels, exactly=not playback)
        self.profile = profile.as_video_stream_profile()
        self.playback = playback
        self._newest: tuple[Any, float] | None = None
        self._arrived = threading.Condition()
        if not playback:
            self._configure()
        self._sensor.open(profile)
        self._sensor.start(self._take)

    def _choose(self, stream: Any, pixels: Any, *, exactly: bool) -> tuple[Any, Any]:
        """Sensor and profile of the wanted size; of a recording whichever it has."""
        cfg, found = self._cfg, []
        for sensor in self._device.query_sensors():
            for profile in sensor.get_stream_profiles():
                if (
                    profile.stream_type() != stream
                    or profile.format() != pixels
                    or profile.stream_index() > 1
                ):
                    continue
                video = profile.as_video_stream_profile()
                size = (video.width(), video.height(), video.fps())
                if size == (cfg.width, cfg.height, cfg.fps) or not exactly:
                    return sensor, profile
                found.append(size)
        sizes = ", ".join(f"{w} x {h} at {fps} Hz" for w, h, fps in sorted(set(found), reverse=True))
        raise CameraError(
            f"the camera has no {stream.name} images of {cfg.width} x {cfg.height} at {cfg.fps} Hz; "
            f"it has {sizes or 'none at all'}. On USB 2 it has fewer: use a USB 3 cable and port"
        )

    def _configure(self) -> None:
        rs, cfg = self._rs, self._cfg
        for name, option, value in (
            (
                "preset",
                rs.option.visual_preset,
                None if cfg.preset is None else int(getattr(rs.rs400_visual_preset, cfg.preset)),
            ),
            ("emitter", rs.option.emitter_enabled, cfg.emitter),
            ("depth_unit_m", rs.option.depth_units, cfg.depth_unit_m),
        ):
            if value is None:
                continue
            if not self._sensor.supports(option):  # a D405 has no projector
                print(f"{describe(self._device)} has no {name}: it is left out", file=sys.stderr, flush=True)
                continue
            try:
                self._sensor.set_option(option, float(value))
            except RuntimeError as error:
                raise CameraError(f"the camera refuses {name} = {value} ({error}); leave it out") from error

    def _take(self, frame: Any) -> None:
        """Called by the SDK's thread with every frame."""
        with self._arrived:
            self._newest = (frame, time.monotonic())
            self._arrived.notify()

    def next(self, timeout_s: float) -> tuple[Any, float]:
        """The newest frame, once, and when it was exposed [s]; waits for one.

        Raises:
            StaleCamera: None came in time.
            CameraError: It is from the future: its clock is not to be relied on.
        """
        with self._arrived:
            if not self._arrived.wait_for(lambda: self._newest is not None, timeout_s):
                why = "has the recording ended?" if self.playback else "check its cable (USB 3) and power"
                raise StaleCamera(f"no image from the camera within {timeout_s:.2f} s; {why}")
            assert self._newest is not None
            frame, arrival = self._newest
            self._newest = None
        domain = frame.get_frame_timestamp_domain()
        host_clock = domain != self._rs.timestamp_domain.hardware_clock
        time_s = self._clock(frame.get_timestamp() * MILLISECOND, arrival, host_clock=host_clock)
        if time_s > arrival + AHEAD_S:
            raise CameraError(
                f"an image is stamped {time_s - arrival:.2f} s later than it came, by the camera's clock "
                f"{domain.name}, so nobody knows its age: wait until the computer's clock is set (NTP), then "
                "plug the camera in again"
            )
        return frame, min(time_s, arrival)

    def close(self) -> None:
        """Stop the stream; a recording is whole from here on."""
        self._sensor.stop()
        self._sensor.close()
        self._newest = None
        del self._sensor, self._device


def _intrinsics(profile: Any) -> Intrinsics:
    """Of a stream. The SDK's pixel centres are at whole numbers, ours at halves."""
    lens = profile.get_intrinsics()
    if any(abs(c) > 0.0 for c in lens.coeffs):
        raise CameraError(
            f"the camera's images are distorted ({lens.model.name}, {list(lens.coeffs)}); "
            "use its rectified depth or left infrared stream"
        )
    return Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.ppx + 0.5, lens.ppy + 0.5)


class RealSense:
    """Depth images of a RealSense device, filtered by the SDK; a :class:`DepthSource`."""

    def __init__(self, device: Any, cfg: RealSenseCfg | None = None):
        """Start the depth stream.

        Args:
            device: A device of the SDK: :func:`find_device`, :func:`open_recording`, or a software device.
            cfg: Settings.

        Raises:
            CameraError: The camera has no such images, or refuses a setting.
            ValueError: A setting that cannot be.
        """
        self.cfg = cfg = cfg or RealSenseCfg()
        rs = sdk()
        self._stream = _Stream(device, rs.stream.depth, rs.format.z16, cfg)
        self._filters = _filters(rs, cfg.filters)
        lens, side = _intrinsics(self._stream.profile), cfg.filters.decimation
        self._height, self._width = lens.height // side, lens.width // side
        self._intrinsics = replace(
            lens,
            width=self._width,
            height=self._height,
            fx=lens.fx / side,
            fy=lens.fy / side,
            cx=lens.cx / side,
            cy=lens.cy / side,
        )

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the images after the filters.

        They follow from the stream's: those that the SDK gives for a decimated image are off by up to half
        a pixel, since it scales the principal point as if pixels had no width.
        """
        return self._intrinsics

    def read(self, timeout_s: float) -> DepthFrame:
        """The newest image that was not returned yet, filtered.

        Raises:
            StaleCamera: None came within ``timeout_s``, or it is older than ``cfg.max_age_s``.
        """
        frame, time_s = self._stream.next(timeout_s)
        for step in self._filters:
            frame = step.process(frame)
        depth = frame.as_depth_frame()
        raw = np.asarray(depth.get_data())
        # The SDK pads decimated images to multiples of four; the padding has no depth.
        metres = raw[: self._height, : self._width] * np.float32(depth.get_units())
        return check_fresh(DepthFrame(metres, time_s), self.cfg.max_age_s)

    def close(self) -> None:
        """Stop the camera."""
        self._stream.close()


class RealSenseInfrared:
    """Images of the left infrared imager, whose optical frame is that of the depth images."""

    def __init__(self, device: Any, cfg: RealSenseCfg | None = None):
        """Start the stream; filters and ``emitter`` of ``cfg`` do not count: the pattern is turned off.

        Raises:
            CameraError: The camera has no such images.
        """
        rs = sdk()
        cfg = cfg or RealSenseCfg()
        self._max_age_s = cfg.max_age_s
        self._stream = _Stream(device, rs.stream.infrared, rs.format.y8, replace(cfg, emitter=False))
        self.intrinsics = _intrinsics(self._stream.profile)
        """Of the images."""

    def read(self, timeout_s: float) -> GrayFrame:
        """The newest image that was not returned yet.

        Raises:
            StaleCamera: None came within ``timeout_s``, or it is too old.
        """
        frame, time_s = self._stream.next(timeout_s)
        image = np.array(np.asarray(frame.get_data()), dtype=np.uint8)
        return check_fresh(GrayFrame(image, time_s), self._max_age_s)

    def close(self) -> None:
        """Stop the camera."""
        self._stream.close()


def _filters(rs: Any, cfg: FilterCfg) -> list[Any]:
    """The SDK's filters that are on, in their order."""
    steps = []
    if cfg.decimation > 1:
        steps.append(rs.decimation_filter(cfg.decimation))
    if cfg.threshold_m is not None:
        steps.append(rs.threshold_filter(*cfg.threshold_m))
    smooth = []
    if cfg.spatial:
        smooth.append(rs.spatial_filter(cfg.spatial_alpha, cfg.spatial_delta, cfg.spatial_passes, 0))
    if cfg.temporal:
        smooth.append(rs.temporal_filter(cfg.temporal_alpha, cfg.temporal_delta, 3))
    if smooth:
        steps += [rs.disparity_transform(True), *smooth, rs.disparity_transform(False)]
    if cfg.hole_filling != "none":
        steps.append(rs.hole_filling_filter(HOLE_MODES[cfg.hole_filling]))
    return steps
