"""Poses that come as datagrams: a JSON object each, ``stamp``, ``position`` and ``quaternion``.

::

    {"stamp": 1767225600.25, "position": [0.1, 0.0, 0.4], "quaternion": [0.0, 0.0, 0.0, 1.0]}

``stamp`` is when the object was there, in seconds since 1970 (:func:`time.time`), ``position`` in
metres, ``quaternion`` xyzw. Both are in the frame that --pose-frame places.
"""

import json
import socket

from vd.deploy.clock import of_unix
from vd.deploy.pose.source import PoseSourceError, StampedPose, make_pose

LONGEST = 4096
"""Bytes of a datagram at most."""
FIELDS = {"stamp", "position", "quaternion"}


class UdpPoses:
    """Poses by UDP; the one with the newest stamp counts.

    Args:
        host: Address to listen at: 127.0.0.1 for programs of this computer, 0.0.0.0 for all.
        port: Number of the port.

    Raises:
        PoseSourceError: Nobody may listen there.
    """

    def __init__(self, host: str, port: int):
        self.name = f"udp:{port}"
        self.trouble = ""
        self._newest: StampedPose | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise PoseSourceError(
                f"{self.name}: cannot listen at {host}, port {port} ({error.strerror}); choose "
                "another port, or end who has it"
            ) from error
        self._socket.setblocking(False)

    def read(self) -> StampedPose | None:
        """The newest pose; None before the first one.

        Raises:
            PoseSourceError: What came is no pose.
        """
        while True:
            try:
                data = self._socket.recv(LONGEST)
            except BlockingIOError:
                return self._newest
            came = self._parsed(data)
            if self._newest is None or came.time_s > self._newest.time_s:
                self._newest = came

    def close(self) -> None:
        """Listen no more."""
        self._socket.close()

    def _parsed(self, data: bytes) -> StampedPose:
        """A datagram's pose."""
        try:
            values = json.loads(data)
            stamp = float(values["stamp"])
            pose = make_pose(values["position"], values["quaternion"], self.name)
        except (ValueError, KeyError, TypeError) as error:
            raise PoseSourceError(
                f"{self.name}: no pose: {data[:80]!r}; send a JSON object with "
                f"{', '.join(sorted(FIELDS))}"
            ) from error
        return StampedPose(of_unix(stamp), pose)
