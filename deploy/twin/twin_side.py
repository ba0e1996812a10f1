"""What the twin tells beside its motors: the true state, depth images of it, and where the object goes.

A Unix socket. A request is a line of JSON, ``{"ask": "depth"}``; an answer is its length in eight bytes and
NumPy arrays by name (.npz). Nothing on a real hand answers to this: it stands for eyes and a helping hand.
"""

import io
import json
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import CameraModel
from vd.deploy.twin.newton_hand import NewtonHand
from vd.sensors.cfg import DepthCameraCfg, DepthSensorCfg

LENGTH_BYTES = 8

Arrays = dict[str, np.ndarray]


class TwinSide:
    """The far end of the socket, served by the thread that runs the twin.

    Args:
        path: Where the socket is made.
        hand: The simulated hand, with an object.
        camera: Its depth camera; its pose is that in the hand's base.
        sensor: Errors of the camera; none by default.
        seed: Of those errors.
        clock: Time [s].
    """

    def __init__(
        self,
        path: Path,
        hand: NewtonHand,
        camera: CameraModel,
        *,
        sensor: DepthSensorCfg | None = None,
        seed: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ):
        from vd.sensors.depth_camera import DepthCamera
        from vd.sensors.surfaces import scene_surfaces

        assert hand.scene is not None, "a hand with an object"
        self._hand, self._clock = hand, clock
        self._camera = DepthCamera(
            scene_surfaces(hand.scene),
            camera,
            hand.body_q,
            cfg=DepthCameraCfg(points=0, sensor=sensor or DepthSensorCfg()),
            camera_body=int(hand.scene.link_body[0]),
            seed=seed,
        )
        self._camera.capture()  # loads kernels
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        self._open: list[socket.socket] = []

    @property
    def sockets(self) -> list[socket.socket]:
        """What to wait for."""
        return [self._listener, *self._open]

    def serve(self, ready: socket.socket) -> None:
        """Take a connection, or answer a request."""
        if ready is self._listener:
            self._open.append(self._listener.accept()[0])
            return
        try:
            line = ready.recv(4096)
            if line:
                send(ready, self._answer(json.loads(line)))
                return
        except OSError:  # whoever asked is gone
            pass
        self._open.remove(ready)
        ready.close()

    def close(self) -> None:
        """Close the socket."""
        for one in self.sockets:
            one.close()

    def _answer(self, request: dict[str, Any]) -> Arrays:
        """What comes back; every answer has the time [s] and the processor time of the twin [s]."""
        answer: Arrays = {}
        match request["ask"]:
            case "state":
                answer = {"joint_q": self._hand.joint_q, "joint_qd": self._hand.joint_qd}
            case "depth":
                self._camera.capture()
                answer = {"depth": self._camera.depth.numpy()[0]}
            case "object":
                self._hand.place_object(request["quat"])
            case "table":
                self._hand.place_table(present=bool(request["present"]))
        return {**answer, "time_s": np.array(self._clock()), "cpu_s": np.array(time.process_time())}


def send(to: socket.socket, arrays: Arrays) -> None:
    """Send arrays by name."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    data = buffer.getvalue()
    to.sendall(len(data).to_bytes(LENGTH_BYTES, "little") + data)


def receive(source: socket.socket) -> Arrays:
    """Receive what :func:`send` sent.

    Raises:
        OSError: The other end is gone, or the socket's time limit is over.
    """
    size = int.from_bytes(_exactly(source, LENGTH_BYTES), "little")
    with np.load(io.BytesIO(_exactly(source, size)), allow_pickle=False) as found:
        return dict(found)


def _exactly(source: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        part = source.recv(size - len(data))
        if not part:
            raise ConnectionResetError("the twin is gone")
        data += part
    return bytes(data)
