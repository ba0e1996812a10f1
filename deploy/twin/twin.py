"""A simulated motor bus behind a pseudo-terminal.

Programs talk to it as to a serial port with motors on it.

``python -m vd.deploy.twin.twin`` owns such a port and prints its path. The motors of
:mod:`vd.deploy.twin.line` answer byte by byte; behind them stands any
:class:`vd.deploy.twin.plant.Plant`. Motors hear what arrives when it arrives, however long the
plant takes: they have processors of their own.
"""

import contextlib
import os
import pty
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.command import interrupt
from vd.command.line import parse
from vd.command.warp_quiet import quiet_warp
from vd.deploy.timely import undisturbed
from vd.deploy.twin.line import Faults, MotorLine
from vd.deploy.twin.motor import Motor, make_motors
from vd.deploy.twin.plant import Plant
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.deploy.twin.newton_hand import NewtonHand

IDLE_S = 0.005
"""Longest wait for bytes: the plant goes on in steps of this size at most."""
LONGEST = 4096
"""Bytes that are taken at once."""


class Twin(MotorLine):
    """Motors on a line, stepped in real time, behind a pseudo-terminal.

    Args:
        motors: As of :class:`MotorLine`, as are ``plant`` and ``faults``.
        pipe: To the program that started it, if one did: requests come by it, and it ends with its
            other end.
        answer: To each request.
    """

    def __init__(
        self,
        motors: Sequence[Motor],
        plant: Plant | None = None,
        faults: Faults | None = None,
        pipe: Connection | None = None,
        answer: Callable[[str], Any] | None = None,
    ):
        """Open the pseudo-terminal; serves once started."""
        super().__init__(motors, plant, faults, put=self._write)
        self._pipe, self._answer = pipe, answer or (lambda request: None)
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._heard: SimpleQueue[tuple[float, bytes | str]] = SimpleQueue()
        self._near, self._far = pty.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.path = os.ttyname(self._far)
        """Device for a program to open."""

    def __enter__(self) -> "Twin":
        self._thread = threading.Thread(target=self.serve, name="twin", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving and close the pseudo-terminal."""
        self.end()
        if self._thread is not None:
            self._thread.join()
        for end in (self._near, self._far):
            os.close(end)

    def end(self) -> None:
        """Have :meth:`serve` return."""
        self._end.set()

    def serve(self) -> None:
        """Answer until it has to end."""
        listener = threading.Thread(target=self._listen, name="listener", daemon=True)
        listener.start()
        try:
            while not self._end.is_set():
                self._serve_once()
        finally:
            self.end()
            listener.join()

    def _serve_once(self) -> None:
        wait_s = max(0.0, min(IDLE_S, self.due_s - self._clock.now()))
        try:
            at, heard = self._heard.get(timeout=wait_s)
        except Empty:
            self.go_on()
            return
        if isinstance(heard, bytes):
            self.go_on(heard, at=at)
        elif self._pipe is not None:
            self.go_on()
            with contextlib.suppress(OSError):  # who asked is gone, which the listener hears
                self._pipe.send(self._answer(heard))

    def _listen(self) -> None:
        """Pass on what arrives, with the time at which it did.

        Meanwhile the plant may be in a step.
        """
        sources: list[Any] = [self._near] if self._pipe is None else [self._near, self._pipe]
        while not self._end.is_set():
            for source in select.select(sources, [], [], IDLE_S)[0]:
                at = self._clock.now()
                try:
                    heard = os.read(source, LONGEST) if source is self._near else source.recv()
                except (EOFError, OSError):
                    if source is self._pipe:
                        self.end()
                else:
                    self._heard.put((at, heard))

    def _write(self, data: bytes) -> None:
        try:
            os.write(self._near, data)
        except BlockingIOError:  # nobody reads: as on a wire, what is not read is lost
            termios.tcflush(self._far, termios.TCIFLUSH)


@dataclass(frozen=True)
class TwinCommand:
    """Serve a bus of simulated motors on a pseudo-terminal until interrupted."""

    hand: str = "dclaw3"
    """Hand that its motors move, simulated in Newton: dclaw3, dclaw4, an imported hand or a hand's
    USD.
    """
    hand_layer: Path | None = None
    """Identified servo model over it (identified.usda), whose effects act."""
    physics_hz: float = PAPER.scene.physics_hz
    """Rate of its simulation."""
    calibration: Path | None = None
    """Calibration file of that hand's motors."""
    object: str | None = None
    """Object on the table or in the hand: name of a built-in set, or a file."""
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the depth camera in the hand's base frame, position [m] and quaternion xyzw; the
    hand's own.
    """
    realistic: bool = False
    """Give the depth images the errors of a real camera."""
    model: str | None = None
    """Model of all motors, in place of what the hand's USD says."""
    faults: Annotated[Faults, tyro.conf.arg(name="")] = field(default_factory=Faults)
    realtime: bool = False
    """Run before all ordinary programs, where that is permitted."""

    def serve(self, pipe: Connection | None = None) -> None:
        """Serve until interrupted, or until a pipe's other end is gone.

        Args:
            pipe: Takes the path of the port, which is printed without one. Answers ``object`` with
                its position [m], quaternion xyzw, velocity [m/s] and spin [rad/s] [13], ``scene``
                with its pose [7] and the joints [rad] [D] of one moment, ``depth`` with an image
                [m] [H, W] and its time [s], and ``place``, by which the object is where an episode
                starts.

        Raises:
            ValueError: Options that cannot be.
        """
        plant = self._plant()
        motors = make_motors(plant.joints)
        tell: Callable[[str], None] = partial(print, flush=True) if pipe is None else pipe.send
        answer = None if pipe is None else self._beside(plant)
        with (
            contextlib.closing(Twin(motors, plant, self.faults, pipe, answer)) as twin,
            undisturbed(self.realtime, level=1),
        ):
            tell(twin.path)  # once it can answer at once: the collector takes a while
            twin.serve()

    def _plant(self) -> "NewtonHand":
        """The simulated hand and its motors."""
        from vd.assets_usd.hands import load_hand
        from vd.deploy.hardware.joints import read_joints
        from vd.deploy.loop.goals import one_object
        from vd.deploy.twin.newton_hand import NewtonHand
        from vd.sim.cfg import SimCfg

        quiet_warp()
        hand = load_hand(self.hand, layer=self.hand_layer)
        joints = read_joints(hand, self.calibration, self.model)
        item = None if self.object is None else one_object(self.object)
        return NewtonHand(hand, joints, SimCfg(physics_hz=self.physics_hz), item=item)

    def _beside(self, hand: "NewtonHand") -> Callable[[str], Any] | None:
        """What answers requests, of a hand with an object.

        Eyes and a helping hand, which no real one has.
        """
        if hand.scene is None:
            return None
        from vd.sensors.cfg import DepthCameraCfg, DepthSensorCfg
        from vd.sensors.depth_camera import DepthCamera

        camera: DepthCamera | None = None
        if hand.hand.mounted_camera is not None:
            sensor = DepthSensorCfg.realistic() if self.realistic else DepthSensorCfg()
            cfg, place = DepthCameraCfg(points=0, sensor=sensor), hand.hand.camera.at(self.camera)
            camera = DepthCamera.of_scene(
                hand.scene, hand.body_q, cfg, place, seed=self.faults.seed
            )
            camera.capture()  # loads kernels

        def answer(request: str) -> Any:
            match request:
                case "object":
                    return np.concatenate([hand.joint_q[-7:], hand.joint_qd[-6:]])
                case "scene":
                    return hand.joint_q[-7:], hand.joint_q[:-7]
                case "depth" if camera is not None:
                    camera.capture()
                    return camera.depth.numpy()[0].copy(), time.monotonic()
                case "place":
                    hand.place_object((0.0, 0.0, 0.0, 1.0))
            return None

        return answer


@interrupt.command("vd.deploy.twin.twin")
def main() -> int:
    """Entry point of ``python -m vd.deploy.twin.twin``; returns the exit status."""
    parse(TwinCommand, prog="python -m vd.deploy.twin.twin", description=__doc__).serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
