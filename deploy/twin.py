"""A simulated motor bus behind a pseudo-terminal: programs talk to it as to a serial port with motors on it.

``python -m vd.deploy.twin`` owns such a port and prints its path. Packets are read and answered byte by byte;
faults can be injected. Behind the motors stands any :class:`vd.deploy.plant.Plant`.
"""

import os
import pty
import random
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vd.deploy.control_table import MODELS
from vd.deploy.motor import Motor
from vd.deploy.packets import BROADCAST, MAX_ID, Failure, Instruction, Packet, PacketReader, encode, status
from vd.deploy.plant import FirstOrderPlant, Plant
from vd.deploy.timely import Priority, real_time, undisturbed
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.assets_usd.objects.model import ObjectModel
    from vd.deploy.newton_hand import NewtonHand
    from vd.deploy.twin_side import TwinSide

RETURN_DELAY_UNIT_S = 2e-6
SILENCE_S = 0.01
"""A packet that has begun and not gone on for this long was cut off."""
IDLE_S = 0.005
"""Longest wait for bytes: the plant goes on in steps of this size at most."""


@dataclass
class Faults:
    """What goes wrong on the bus. Shares are of status packets, drawn from ``seed``."""

    lose: float = 0.0
    """Share that never arrives."""
    corrupt: float = 0.0
    """Share with one byte changed."""
    truncate: float = 0.0
    """Share that is cut off."""
    late: float = 0.0
    """Share that is held back for ``late_s``."""
    late_s: float = 0.1
    cut_off: set[int] = field(default_factory=set)
    """Motors that neither hear nor answer: a loose cable."""
    seed: int = 0


class Twin:
    """Motors on a bus, stepped in real time, behind a pseudo-terminal.

    Args:
        motors: Motors in the order of the plant's axes.
        plant: What they move; axes without mass by default.
        faults: What goes wrong; may be changed while it runs.
        clock: Time [s].
        side: What it tells beside the motors, if anything.
    """

    def __init__(
        self,
        motors: Sequence[Motor],
        plant: Plant | None = None,
        faults: Faults | None = None,
        clock: Callable[[], float] = time.monotonic,
        side: "TwinSide | None" = None,
    ):
        """Open the pseudo-terminal; serves once started."""
        self.motors = list(motors)
        self.plant = plant or FirstOrderPlant(len(self.motors))
        self.faults = faults or Faults()
        self._clock, self._then, self._side = clock, clock(), side
        self._random = random.Random(self.faults.seed)
        self._reader = PacketReader()
        self._held: list[tuple[float, bytes]] = []
        self._heard_at = 0.0
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._near, self._far = pty.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.path = os.ttyname(self._far)
        """Device for a program to open."""
        self._sense(0.0)

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
        if self._side is not None:
            self._side.close()

    def end(self) -> None:
        """Have :meth:`serve` return."""
        self._end.set()

    def serve(self) -> None:
        """Answer until it has to end."""
        while not self._end.is_set():
            due = min((at for at, _ in self._held), default=float("inf")) - self._clock()
            beside = {} if self._side is None else {one.fileno(): one for one in self._side.sockets}
            ready, _, _ = select.select([self._near, *beside], [], [], max(0.0, min(IDLE_S, due)))
            self._advance()
            for one in ready:
                if one in beside and self._side is not None:
                    self._side.serve(beside[one])
            if self._near in ready:
                self._heard_at = self._clock()
                for packet in self._reader.feed(self._receive()):
                    self.handle(packet)
            elif self._reader.waiting and self._clock() - self._heard_at > SILENCE_S:
                for packet in self._reader.give_up():
                    self.handle(packet)
            self._release()

    def handle(self, packet: Packet) -> None:
        """Carry out one instruction and send what the motors answer."""
        named = list(ORDER[packet.instruction](packet.parameters)) if packet.instruction in ORDER else []
        # Motors that a packet names answer in its order; each waits for the one before.
        for motor in sorted(self.motors, key=lambda m: named.index(m.id) if m.id in named else len(named)):
            if motor.id not in self.faults.cut_off:
                for answer in self._answers(motor, packet):
                    self._send(motor, answer)

    def _answers(self, motor: Motor, packet: Packet) -> list[Packet]:
        """What one motor makes of a packet on the bus."""
        shared = SHARED.get(packet.instruction)
        if packet.id == BROADCAST and shared is not None:
            motor.heard()
            return shared(motor, packet.parameters)
        if packet.id not in (motor.id, BROADCAST) or packet.instruction == Instruction.STATUS:
            return []
        motor.heard()
        single = SINGLE.get(packet.instruction)
        if single is None:
            failure, data = int(Failure.INSTRUCTION), b""
        else:
            failure, data = single(motor, packet.parameters)
        level = motor.get("status_return_level")
        quiet = level == 0 or (level == 1 and packet.instruction != Instruction.READ)
        if packet.instruction != Instruction.PING and (quiet or packet.id == BROADCAST):
            return []
        return [status(motor.id, failure | motor.alert, data)]

    def _receive(self) -> bytes:
        try:
            return os.read(self._near, 4096)
        except (BlockingIOError, OSError):
            return b""

    def _send(self, motor: Motor, packet: Packet) -> None:
        time.sleep(motor.get("return_delay_time") * RETURN_DELAY_UNIT_S)
        data, draw, faults = bytearray(encode(packet)), self._random.random, self.faults
        if draw() < faults.lose:
            return
        if draw() < faults.corrupt:
            data[self._random.randrange(len(data))] ^= self._random.randrange(1, 256)
        if draw() < faults.truncate:
            del data[self._random.randrange(1, len(data)) :]
        if draw() < faults.late:
            self._held.append((self._clock() + faults.late_s, bytes(data)))
            return
        self._put(bytes(data))

    def _release(self) -> None:
        now = self._clock()
        for at, data in [held for held in self._held if held[0] <= now]:
            self._held.remove((at, data))
            self._put(data)

    def _put(self, data: bytes) -> None:
        try:
            os.write(self._near, data)
        except BlockingIOError:  # nobody reads: as on a wire, what is not read is lost
            termios.tcflush(self._far, termios.TCIFLUSH)

    def _advance(self) -> None:
        now = self._clock()
        seconds, self._then = now - self._then, now
        if seconds > 0.0:
            self.plant.advance(seconds, [motor.drive for motor in self.motors])
            self._sense(seconds)

    def _sense(self, seconds: float) -> None:
        state = zip(*self.plant.read(), strict=True)
        for motor, (position, velocity, torque) in zip(self.motors, state, strict=True):
            motor.sense(seconds, float(position), float(velocity), float(torque))


Result = tuple[int, bytes]


def _word(data: bytes, at: int = 0) -> int:
    return int.from_bytes(data[at : at + 2], "little")


def _ping(motor: Motor, parameters: bytes) -> Result:
    if parameters:
        return Failure.LENGTH, b""
    return Failure.NONE, motor.read(0, 2)[1] + motor.read(6, 1)[1]


def _read(motor: Motor, parameters: bytes) -> Result:
    return (
        motor.read(_word(parameters), _word(parameters, 2)) if len(parameters) == 4 else (Failure.LENGTH, b"")
    )


def _write(motor: Motor, parameters: bytes) -> Result:
    return motor.write(_word(parameters), parameters[2:]), b""


def _register(motor: Motor, parameters: bytes) -> Result:
    if len(parameters) < 3:
        return Failure.LENGTH, b""
    motor.registered = _word(parameters), parameters[2:]
    motor.put("registered_instruction", 1)
    return Failure.NONE, b""


def _action(motor: Motor, parameters: bytes) -> Result:
    if motor.registered is None:
        return Failure.RESULT, b""
    failure = motor.write(*motor.registered)
    motor.registered = None
    motor.put("registered_instruction", 0)
    return failure, b""


def _reboot(motor: Motor, parameters: bytes) -> Result:
    motor.reboot()
    return Failure.NONE, b""


def _sync_read(motor: Motor, parameters: bytes) -> list[Packet]:
    if len(parameters) < 5 or motor.id not in parameters[4:]:
        return []
    failure, data = motor.read(_word(parameters), _word(parameters, 2))
    return [status(motor.id, failure | motor.alert, data)]


def _sync_write(motor: Motor, parameters: bytes) -> list[Packet]:
    address, length = _word(parameters), _word(parameters, 2)
    rows = parameters[4:]
    if length and len(rows) % (length + 1) == 0:
        for start in range(0, len(rows), length + 1):
            if rows[start] == motor.id:
                motor.write(address, rows[start + 1 : start + 1 + length])
    return []


def _bulk_read(motor: Motor, parameters: bytes) -> list[Packet]:
    if len(parameters) % 5:
        return []
    answers = []
    for start in range(0, len(parameters), 5):
        if parameters[start] == motor.id:
            failure, data = motor.read(_word(parameters, start + 1), _word(parameters, start + 3))
            answers.append(status(motor.id, failure | motor.alert, data))
    return answers


def _bulk_write(motor: Motor, parameters: bytes) -> list[Packet]:
    while len(parameters) >= 5:
        length = _word(parameters, 3)
        data = parameters[5 : 5 + length]
        if parameters[0] == motor.id and len(data) == length:
            motor.write(_word(parameters, 1), data)
        parameters = parameters[5 + length :]
    return []


SINGLE: dict[int, Callable[[Motor, bytes], Result]] = {
    Instruction.PING: _ping,
    Instruction.READ: _read,
    Instruction.WRITE: _write,
    Instruction.REG_WRITE: _register,
    Instruction.ACTION: _action,
    Instruction.REBOOT: _reboot,
}
"""Instructions to one motor, or broadcast."""
SHARED: dict[int, Callable[[Motor, bytes], list[Packet]]] = {
    Instruction.SYNC_READ: _sync_read,
    Instruction.SYNC_WRITE: _sync_write,
    Instruction.BULK_READ: _bulk_read,
    Instruction.BULK_WRITE: _bulk_write,
}
"""Instructions to many motors, which name them in their parameters."""


ORDER: dict[int, Callable[[bytes], bytes]] = {
    Instruction.SYNC_READ: lambda parameters: parameters[4:],
    Instruction.BULK_READ: lambda parameters: parameters[::5],
}
"""Where the instructions that several motors answer name them."""


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
    """Rate of its simulation; the motors are at most two steps behind."""
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
            import warp as wp

            from vd.assets_usd.hands import load_hand
            from vd.deploy.joints import read_joints, uncalibrated
            from vd.deploy.newton_hand import NewtonHand
            from vd.sim.cfg import SimCfg

            wp.config.log_level = wp.LOG_WARNING  # what is printed is the path
            hand = load_hand(self.hand, layer=self.hand_layer)
            joints = uncalibrated(hand) if self.calibration is None else read_joints(self.calibration, hand)
            ids, plant = (
                joints.ids,
                NewtonHand(hand, joints, SimCfg(physics_hz=self.physics_hz), item=self._item()),
            )
            side = self._beside(plant)
        twin = Twin([Motor(MODELS[self.model], id) for id in ids], plant, faults, side=side)
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
        from vd.assets_usd.objects.model import load_set

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
        from vd.deploy.twin_side import TwinSide
        from vd.sensors.cfg import DepthSensorCfg

        camera = plant.hand.camera
        if self.camera is not None:
            place = np.array(self.camera)
            camera = replace(camera, position=place[:3], quaternion=place[3:])
        sensor = DepthSensorCfg.realistic() if self.realistic else None
        return TwinSide(self.side, plant, camera, sensor=sensor, seed=self.seed)


def main() -> None:
    """Entry point of ``python -m vd.deploy.twin``."""
    import tyro

    command = tyro.cli(TwinCommand, prog="python -m vd.deploy.twin", description=__doc__)
    try:
        sys.exit(command.run())
    except (ValueError, OSError) as error:
        sys.exit(f"vd.deploy.twin: {error}")


if __name__ == "__main__":
    main()
