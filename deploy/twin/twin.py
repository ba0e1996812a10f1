"""A simulated motor bus behind a pseudo-terminal: programs talk to it as to a serial port with motors on it.

``python -m vd.deploy.twin.twin`` owns such a port and prints its path. The motors are those of
:mod:`vd.deploy.twin.line`, which answer byte by byte; behind them stands any
:class:`vd.deploy.twin.plant.Plant`. Motors hear what arrives when it arrives, however long the plant takes:
they have processors of their own.
"""

import contextlib
import os
import pty
import select
import socket
import struct
import sys
import termios
import threading
import tty
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vd.deploy.hardware.control_table import MODELS
from vd.deploy.hardware.packets import MAX_ID
from vd.deploy.timely import Priority, real_time, undisturbed
from vd.deploy.twin.line import Faults, MotorLine
from vd.deploy.twin.motor import Motor
from vd.deploy.twin.plant import Plant
from vd.paper import PAPER
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.assets_usd.objects.model import ObjectModel
    from vd.deploy.twin.newton_hand import NewtonHand
    from vd.deploy.twin.twin_side import TwinSide

IDLE_S = 0.005
"""Longest wait for bytes: the plant goes on in steps of this size at most."""
STAMP = struct.Struct("d")
"""Time before bytes that arrived."""
LONGEST = 4096
"""Bytes that are taken at once."""


class Twin(MotorLine):
    """Motors on a line, stepped in real time, behind a pseudo-terminal.

    Args:
        motors: Motors in the order of the plant's axes.
        plant: What they move; axes without mass by default.
        faults: What goes wrong; may be changed while it runs.
        side: What it tells beside the motors, if anything.
    """

    def __init__(
        self,
        motors: Sequence[Motor],
        plant: Plant | None = None,
        faults: Faults | None = None,
        side: "TwinSide | None" = None,
    ):
        """Open the pseudo-terminal; serves once started."""
        super().__init__(motors, plant, faults, put=self._write)
        self._side = side
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._mouth, self._ear = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
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
        self._mouth.close()
        self._ear.close()
        if self._side is not None:
            self._side.close()

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
        beside = {} if self._side is None else {one.fileno(): one for one in self._side.sockets}
        wait_s = max(0.0, min(IDLE_S, self.due_s - self._clock.now()))
        ready, _, _ = select.select([self._ear.fileno(), *beside], [], [], wait_s)
        if self._ear.fileno() in ready:
            heard = self._ear.recv(STAMP.size + LONGEST)
            self.go_on(heard[STAMP.size :], at=STAMP.unpack_from(heard)[0])
        else:
            self.go_on()
        for one in ready:
            if one in beside and self._side is not None:
                self._side.serve(beside[one])

    def _listen(self) -> None:
        """Pass on what arrives, with the time at which it did: meanwhile the plant may be in a step."""
        while not self._end.is_set():
            if select.select([self._near], [], [], IDLE_S)[0]:
                at = self._clock.now()
                with contextlib.suppress(BlockingIOError, OSError):
                    self._mouth.send(STAMP.pack(at) + os.read(self._near, LONGEST))

    def _write(self, data: bytes) -> None:
        try:
            os.write(self._near, data)
        except BlockingIOError:  # nobody reads: as on a wire, what is not read is lost
            termios.tcflush(self._far, termios.TCIFLUSH)


def spoil(motors: Sequence[Motor], put: Sequence[str], heat: Sequence[str]) -> None:
    """Have motors not be as they should be.

    Args:
        motors: The motors.
        put: Items of theirs, each as ID:ITEM=VALUE.
        heat: How fast they warm [deg C/s], each as ID=DEGREES.

    Raises:
        ValueError: Names what cannot be.
    """
    by_id = {str(motor.id): motor for motor in motors}
    for text in put:
        id, _, rest = text.partition(":")
        item, _, value = rest.partition("=")
        if id not in by_id or item not in by_id[id].items or not value.lstrip("-").isdigit():
            raise ValueError(f"--put {text}: give motor, item and whole number, such as 11:id=13")
        by_id[id].put(item, int(value))
    for text in heat:
        id, _, degrees = text.partition("=")
        try:
            by_id[id].heat_c_per_s = float(degrees)
        except (KeyError, ValueError):
            raise ValueError(f"--heat {text}: give motor and degrees a second, such as 21=50") from None


def _end_with_input(twin: Twin) -> None:
    sys.stdin.read()
    twin.end()


@dataclass(frozen=True)
class TwinCommand:
    """Serve a bus of simulated motors on a pseudo-terminal until interrupted."""

    ids: tuple[int, ...] = (10, 11, 12, 20, 21, 22, 30, 31, 32)
    """IDs of the motors, on axes without mass; without --hand."""
    hand: str | None = None
    """Hand that the motors move, simulated in Newton: dclaw3, dclaw4 or a hand's USD."""
    hand_layer: Path | None = None
    """Identified servo model over it (identified.usda), whose effects act."""
    physics_hz: float = PAPER.scene.physics_hz
    """Rate of its simulation."""
    calibration: Path | None = None
    """Calibration file of that hand's motors; IDs 10, 11, 12, 20, ... by default."""
    object: str | None = None
    """Object on the table, with --hand: name of a built-in set, or a file."""
    side: Path | None = None
    """Unix socket to make, with --object: true state, depth images, placing the object."""
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the depth camera in the hand's base frame, position [m] and quaternion xyzw; the hand's own."""
    realistic: bool = False
    """Give the depth images the errors of a real camera."""
    model: str = "XH430-V210"
    """Their model."""
    lose: float = 0.0
    """Share of status packets that never arrives."""
    corrupt: float = 0.0
    """Share with one byte changed."""
    truncate: float = 0.0
    """Share that is cut off."""
    late: float = 0.0
    """Share that is held back for 0.1 s."""
    cut_off: tuple[int, ...] = ()
    """IDs of motors with a loose cable."""
    put: tuple[str, ...] = ()
    """Items that are not as they should be, each as ID:ITEM=VALUE: 11:id=13, 22:hardware_error_status=32."""
    heat: tuple[str, ...] = ()
    """Motors that warm by themselves, each as ID=DEGREES a second: 21=50."""
    seed: int = 0
    """Of the faults."""
    realtime: Priority = "off"
    """Run before all ordinary programs: where that is permitted, always, or never."""
    attached: bool = False
    """End when standard input does: with the program that started it, however that ended."""

    def run(self) -> int:
        """Serve."""
        if self.model not in MODELS:
            raise ValueError(f"--model {self.model}: no such motor; choose of {', '.join(MODELS)}")
        wrong = [id for id in self.ids if not 0 <= id <= MAX_ID]
        if wrong:
            raise ValueError(f"--ids {wrong[0]}: an ID lies within 0 and {MAX_ID}")
        faults = Faults(
            self.lose, self.corrupt, self.truncate, self.late, cut_off=set(self.cut_off), seed=self.seed
        )
        ids, plant, side = self.ids, None, None
        if self.hand is not None:
            from vd.assets_usd.hands import load_hand
            from vd.deploy.hardware.joints import read_joints, uncalibrated
            from vd.deploy.twin.newton_hand import NewtonHand
            from vd.sim.cfg import SimCfg

            quiet_warp()
            hand = load_hand(self.hand, layer=self.hand_layer)
            joints = uncalibrated(hand) if self.calibration is None else read_joints(self.calibration, hand)
            ids, plant = (
                joints.ids,
                NewtonHand(hand, joints, SimCfg(physics_hz=self.physics_hz), item=self._item()),
            )
            side = self._beside(plant)
        motors = [Motor(MODELS[self.model], id) for id in ids]
        spoil(motors, self.put, self.heat)
        twin = Twin(motors, plant, faults, side=side)
        if self.attached:
            threading.Thread(target=_end_with_input, args=(twin,), daemon=True).start()
        try:
            with undisturbed(), real_time(self.realtime, level=1):
                print(twin.path, flush=True)  # once it can answer at once: the collector takes a while
                twin.serve()
        except KeyboardInterrupt:
            pass
        finally:
            twin.close()
        return 0

    def _item(self) -> "ObjectModel | None":
        """The object that is named."""
        if self.object is None:
            return None
        from vd.assets_usd.objects.sets import load_set

        found = load_set(self.object)
        if len(found) > 1:
            raise ValueError(f"--object {self.object} holds {len(found)} objects; name the file of one")
        return found[0]

    def _beside(self, plant: "NewtonHand") -> "TwinSide | None":
        """The socket, if one is asked for."""
        if self.side is None:
            return None
        if plant.scene is None:
            raise ValueError("--side needs --object")
        from vd.deploy.twin.twin_side import TwinSide
        from vd.sensors.cfg import DepthSensorCfg

        camera = plant.hand.camera
        if self.camera is not None:
            place = np.array(self.camera)
            camera = replace(camera, position=place[:3], quaternion=place[3:])
        sensor = DepthSensorCfg.realistic() if self.realistic else None
        return TwinSide(self.side, plant, camera, sensor=sensor, seed=self.seed)


def main() -> None:
    """Entry point of ``python -m vd.deploy.twin.twin``."""
    import tyro

    command = tyro.cli(TwinCommand, prog="python -m vd.deploy.twin.twin", description=__doc__)
    try:
        sys.exit(command.run())
    except (ValueError, OSError) as error:
        sys.exit(f"vd.deploy.twin.twin: {error}")


if __name__ == "__main__":
    main()
