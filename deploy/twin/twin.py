"""A simulated motor bus behind a pseudo-terminal: programs talk to it as to a serial port with motors on it.

``python -m vd.deploy.twin.twin`` owns such a port and prints its path. The motors of
:mod:`vd.deploy.twin.line` answer byte by byte; behind them stands any :class:`vd.deploy.twin.plant.Plant`.
Motors hear what arrives when it arrives, however long the plant takes: they have processors of their own.
"""

import contextlib
import os
import pty
import select
import sys
import termios
import threading
import tty
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from vd.deploy.hardware.control_table import MODELS
from vd.deploy.hardware.packets import MAX_ID
from vd.deploy.timely import real_time, undisturbed
from vd.deploy.twin.line import Faults, MotorLine
from vd.deploy.twin.motor import Motor
from vd.deploy.twin.plant import Plant
from vd.paper import PAPER
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.deploy.twin.newton_hand import NewtonHand
    from vd.deploy.twin.twin_side import TwinSide

IDLE_S = 0.005
"""Longest wait for bytes: the plant goes on in steps of this size at most."""
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
        self._ear, self._mouth = Pipe(duplex=False)
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
        waited: list[Any] = [self._ear] if self._side is None else [self._ear, self._side.pipe]
        wait_s = max(0.0, min(IDLE_S, self.due_s - self._clock.now()))
        ready, _, _ = select.select(waited, [], [], wait_s)
        if self._ear in ready:
            at, heard = self._ear.recv()
            self.go_on(heard, at=at)
        else:
            self.go_on()
        if self._side is not None and self._side.pipe in ready and not self._side.serve():
            self.end()

    def _listen(self) -> None:
        """Pass on what arrives, with the time at which it did: meanwhile the plant may be in a step."""
        while not self._end.is_set():
            if select.select([self._near], [], [], IDLE_S)[0]:
                at = self._clock.now()
                with contextlib.suppress(BlockingIOError, OSError):
                    self._mouth.send((at, os.read(self._near, LONGEST)))

    def _write(self, data: bytes) -> None:
        try:
            os.write(self._near, data)
        except BlockingIOError:  # nobody reads: as on a wire, what is not read is lost
            termios.tcflush(self._far, termios.TCIFLUSH)


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
    camera: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the depth camera in the hand's base frame, position [m] and quaternion xyzw; the hand's own."""
    realistic: bool = False
    """Give the depth images the errors of a real camera."""
    model: str = "XH430-V210"
    """Their model."""
    faults: Annotated[Faults, tyro.conf.arg(name="")] = field(default_factory=Faults)
    realtime: bool = False
    """Run before all ordinary programs, where that is permitted."""
    side: int | None = None
    """File descriptor of a pipe to the program that started it, with which it ends."""

    def run(self) -> int:
        """Serve."""
        if self.model not in MODELS:
            raise ValueError(f"--model {self.model}: no such motor; choose of {', '.join(MODELS)}")
        wrong = [id for id in self.ids if not 0 <= id <= MAX_ID]
        if wrong:
            raise ValueError(f"--ids {wrong[0]}: an ID lies within 0 and {MAX_ID}")
        ids, plant = (self.ids, None) if self.hand is None else self._hand(self.hand)
        motors = [Motor(MODELS[self.model], id) for id in ids]
        twin = Twin(motors, plant, self.faults, side=self._beside(plant))
        try:
            with undisturbed(), real_time(self.realtime, level=1):
                print(twin.path, flush=True)  # once it can answer at once: the collector takes a while
                twin.serve()
        except KeyboardInterrupt:
            pass
        finally:
            twin.close()
        return 0

    def _hand(self, name: str) -> "tuple[tuple[int, ...], NewtonHand]":
        """The motors and the simulated hand."""
        from vd.assets_usd.hands import load_hand
        from vd.deploy.hardware.joints import read_joints, uncalibrated
        from vd.deploy.loop.goals import one_object
        from vd.deploy.twin.newton_hand import NewtonHand
        from vd.sim.cfg import SimCfg

        quiet_warp()
        hand = load_hand(name, layer=self.hand_layer)
        joints = uncalibrated(hand) if self.calibration is None else read_joints(self.calibration, hand)
        item = None if self.object is None else one_object(self.object)
        return joints.ids, NewtonHand(hand, joints, SimCfg(physics_hz=self.physics_hz), item=item)

    def _beside(self, plant: "NewtonHand | None") -> "TwinSide | None":
        """What answers the program that started it, if one did."""
        if self.side is None:
            return None
        from vd.deploy.twin.twin_side import TwinSide
        from vd.sensors.cfg import DepthSensorCfg

        camera = None if plant is None else plant.hand.camera.at(self.camera)
        sensor = DepthSensorCfg.realistic() if self.realistic else None
        return TwinSide(Connection(self.side), plant, camera, sensor=sensor, seed=self.faults.seed)


def main() -> None:
    """Entry point of ``python -m vd.deploy.twin.twin``."""
    command = tyro.cli(TwinCommand, prog="python -m vd.deploy.twin.twin", description=__doc__)
    try:
        sys.exit(command.run())
    except (ValueError, OSError) as error:
        sys.exit(f"vd.deploy.twin.twin: {error}")


if __name__ == "__main__":
    main()
