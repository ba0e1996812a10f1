"""The near end of a twin's side: its true state, its depth camera, and a hand to place the object."""

import json
import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import CameraModel, Intrinsics
from vd.deploy.camera.camera import DepthFrame, StaleCamera
from vd.deploy.twin.child import TwinError
from vd.deploy.twin.twin_side import Arrays, receive

ANSWER_S = 5.0
"""Longest wait for an answer that the loop does not depend on."""


@dataclass(frozen=True)
class TwinState:
    """The true state of the simulated hand; D joints."""

    time_s: float
    """When, by the monotonic clock [s]."""
    cpu_s: float
    """Processor time of the twin since its start [s]."""
    joint_q: np.ndarray
    """Joints [rad] [D]."""
    joint_qd: np.ndarray
    """Their velocities [rad/s] [D]."""
    object_pose: np.ndarray
    """Position [m] and quaternion xyzw of the object in the world frame [7]."""
    object_velocity: np.ndarray
    """Its linear [m/s] and angular [rad/s] velocity [6]."""


class TwinLink:
    """A connection to the side of a twin.

    Args:
        path: Its socket.

    Raises:
        TwinError: Nobody serves there.
    """

    def __init__(self, path: Path):
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._lock = threading.Lock()
        try:
            self._socket.connect(str(path))
        except OSError as error:
            raise TwinError(f"no twin at {path}: {error}") from error

    def __enter__(self) -> "TwinLink":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, ask: str, timeout_s: float = ANSWER_S, **values: Any) -> Arrays:
        """One request on the side.

        Raises:
            TwinError: No answer.
        """
        with self._lock:
            try:
                self._socket.settimeout(timeout_s)
                self._socket.sendall(json.dumps({"ask": ask, **values}).encode())
                return receive(self._socket)
            except OSError as error:
                raise TwinError(f"the twin does not answer: {error}") from error

    def state(self) -> TwinState:
        """The true state.

        Raises:
            TwinError: No answer.
        """
        answer = self.ask("state")
        q, qd = answer["joint_q"], answer["joint_qd"]
        return TwinState(float(answer["time_s"]), float(answer["cpu_s"]), q[:-7], qd[:-6], q[-7:], qd[-6:])

    def place_object(self, quat: Sequence[float]) -> None:
        """Put the object where an episode starts, turned as wanted (xyzw); it falls from there."""
        self.ask("object", quat=[float(value) for value in quat])

    def place_table(self, *, present: bool) -> None:
        """Put the table back, or take it away."""
        self.ask("table", present=present)

    def close(self) -> None:
        """End the connection; the twin goes on."""
        self._socket.close()


class SdkTwinCamera:
    """The camera of a twin behind the RealSense SDK's software device: its images come as a real camera's do.

    Args:
        twin: Makes the images.

    Raises:
        CameraError: The SDK is not installed.
    """

    def __init__(self, twin: "TwinCamera"):
        from vd.deploy.camera.realsense import FilterCfg, RealSense, RealSenseCfg
        from vd.deploy.twin.camera_twin import CameraTwin

        lens = twin.intrinsics
        self._twin, self._device = twin, CameraTwin(lens)
        cfg = RealSenseCfg(width=lens.width, height=lens.height, filters=FilterCfg(decimation=1))
        self._eye = RealSense(self._device.device, cfg)

    @property
    def intrinsics(self) -> Intrinsics:
        """Of its images."""
        return self._eye.intrinsics

    def read(self, timeout_s: float) -> DepthFrame:
        """An image of the present, in the SDK's millimetres.

        Raises:
            StaleCamera: None came in time.
        """
        image = self._twin.read(timeout_s)
        self._device.show(image.depth_m, image.time_s)
        return self._eye.read(timeout_s)

    def close(self) -> None:
        """Stop the device."""
        self._eye.close()


class TwinCamera:
    """The depth camera of a twin: an image whenever one is wanted.

    Args:
        twin: The twin.
        camera: The camera it was told to have.
    """

    def __init__(self, twin: TwinLink, camera: CameraModel):
        self._twin, self._camera = twin, camera

    @property
    def intrinsics(self) -> Intrinsics:
        """Of its images."""
        return self._camera

    def read(self, timeout_s: float) -> DepthFrame:
        """An image of the present.

        Raises:
            StaleCamera: None came in time.
        """
        try:
            answer = self._twin.ask("depth", timeout_s)
        except TwinError as error:
            raise StaleCamera(str(error)) from error
        return DepthFrame(answer["depth"], float(answer["time_s"]))

    def close(self) -> None:
        """Nothing to stop: the twin goes on."""
