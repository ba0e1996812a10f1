"""Depth images of a topic of ROS 2."""

import threading
import time
from typing import Any, cast

import numpy as np

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import CameraError, Frame, NewestImage
from vd.deploy.clock import from_future, of_unix

IMAGES, LENS = "depth/image_rect_raw", "depth/camera_info"
FIRST_S = 5.0
"""Longest wait for a first message."""
DEPTHS: dict[str, tuple[str, float]] = {"16UC1": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Encodings of depth: type, and what one is in metres."""


def monotonic(stamp: Any) -> float:
    """A time of ROS on the clock of :func:`time.monotonic` [s]."""
    return of_unix(stamp.sec + 1e-9 * stamp.nanosec)


class RosCamera:
    """Depth images of a topic, as :class:`vd.deploy.camera.camera.ImageSource`.

    Raises:
        CameraError: There is no camera_info, or its images are distorted.
    """

    def __init__(self, node: Any):
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo, Image

        self._node = node
        self._lens = cast(Any, None)
        self._newest = NewestImage()
        self._arrived = threading.Condition()
        self._held = [
            node.create_subscription(kind, topic, take, qos_profile_sensor_data)
            for kind, topic, take in (
                (CameraInfo, LENS, self._see_by),
                (Image, IMAGES, self._newest.put),
            )
        ]
        with self._arrived:
            if not self._arrived.wait_for(lambda: self._lens is not None, FIRST_S):
                where = node.resolve_topic_name(LENS)
                raise CameraError(f"no camera_info on {where}: start the camera, or remap {LENS}")
        if any(abs(c) > 0.0 for c in self._lens.d):
            raise CameraError(
                f"the images are distorted ({list(self._lens.d)}); remap to rectified ones"
            )
        k = self._lens.k  # centres of pixels are at whole numbers there
        self.intrinsics = Intrinsics(
            self._lens.width, self._lens.height, k[0], k[4], k[2] + 0.5, k[5] + 0.5
        )

    def _see_by(self, lens: Any) -> None:
        with self._arrived:
            self._lens = lens
            self._arrived.notify_all()

    def read(self, timeout_s: float) -> Frame:
        """The newest image that was not returned yet.

        Raises:
            StaleCamera: None came within ``timeout_s``.
            CameraError: It is no depth image, or from the future.
        """
        where = self._node.resolve_topic_name(IMAGES)
        image = self._newest.take(timeout_s, f"no image on {where}")
        if image.encoding not in DEPTHS:
            raise CameraError(
                f"images are {image.encoding}; depth is {' or '.join(DEPTHS)}: remap {IMAGES}"
            )
        time_s = monotonic(image.header.stamp)
        if ahead := from_future(time_s, time.monotonic()):
            raise CameraError(f"an image on {where} is {ahead}, and stamp it when it is exposed")
        kind, unit = DEPTHS[image.encoding]
        order = ">" if image.is_bigendian else "<"
        rows = np.frombuffer(image.data, dtype=order + kind).reshape(image.height, -1)
        depth = np.nan_to_num(
            rows[:, : image.width].astype(np.float32) * np.float32(unit), posinf=0.0
        )
        return Frame(depth, time_s)

    def close(self) -> None:
        """Listen no more."""
        for subscription in self._held:
            self._node.destroy_subscription(subscription)
