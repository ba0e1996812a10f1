"""A line of simulated motors.

Bytes of a program in, bytes of the motors out, and what they move goes on.

:mod:`motor_terminal` puts a pseudo-terminal and the computer's clock around it. Faults can be
injected.
"""

import functools
import itertools
import operator
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from motor_model import Motor
from motor_packets import (
    BROADCAST,
    Failure,
    Instruction,
    Packet,
    PacketReader,
    encode,
    status,
)
from motor_plant import FirstOrderPlant, Plant

from vd.deploy.clock import MONOTONIC, Clock

RETURN_DELAY_UNIT_S = 2e-6
SILENCE_S = 0.01
"""A packet that has begun and not gone on for this long was cut off."""


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


class MotorLine:
    """Motors on a line.

    Args:
        motors: Motors in the order of the plant's axes.
        plant: What they move; axes without mass by default.
        faults: What goes wrong; may be changed while it runs.
        clock: Time.
        put: Takes the bytes that arrive at the program's end.
    """

    def __init__(
        self,
        motors: Sequence[Motor],
        plant: Plant | None = None,
        faults: Faults | None = None,
        *,
        clock: Clock = MONOTONIC,
        put: Callable[[bytes], None],
    ):
        """Power on."""
        self.motors = list(motors)
        self.plant = plant or FirstOrderPlant(len(self.motors))
        self.faults = faults or Faults()
        self.put = put
        self.clock, self._then = clock, clock.now()
        self._random = random.Random(self.faults.seed)
        self._reader = PacketReader()
        self._held: list[tuple[float, bytes]] = []
        self._heard_at = 0.0
        self._sense(0.0)

    @property
    def due_s(self) -> float:
        """When the next late packet arrives [s]; infinite without one."""
        return min((at for at, _ in self._held), default=float("inf"))

    def go_on(self, heard: bytes = b"", *, at: float | None = None) -> None:
        """Go on to the present, or the moment ``at`` [s], in which bytes arrive at the motors, or none."""
        now = max(self.clock.now() if at is None else at, self._then)
        seconds, self._then = now - self._then, now
        if seconds > 0.0:
            self.plant.advance(seconds, [motor.drive() for motor in self.motors])
            self._sense(seconds)
        packets: list[Packet] = []
        if heard:
            self._heard_at, packets = now, self._reader.feed(heard)
        elif self._reader.waiting and now - self._heard_at > SILENCE_S:
            packets = self._reader.give_up()
        for packet in packets:
            self._handle(packet)
        for at, data in [held for held in self._held if held[0] <= self.clock.now()]:
            self._held.remove((at, data))
            self.put(data)

    def _handle(self, packet: Packet) -> None:
        """Carry out one instruction and send what the motors answer."""
        named = list(packet.parameters[4:]) if packet.instruction == Instruction.SYNC_READ else []
        # Motors that a packet names answer in its order; each waits for the one before.
        answers: dict[int, list[bytes]] = {}
        for motor in sorted(
            self.motors, key=lambda m: named.index(m.id) if m.id in named else len(named)
        ):
            if (
                motor.id not in self.faults.cut_off
                and (answer := _answer(motor, packet)) is not None
            ):
                answers.setdefault(motor.id, []).append(encode(answer))
        for id, at_once in answers.items():
            delay = next(motor for motor in self.motors if motor.id == id).get("return_delay_time")
            self.clock.sleep(delay * RETURN_DELAY_UNIT_S)
            self._send(collide(at_once))

    def _send(self, frame: bytes) -> None:
        data, draw, faults = bytearray(frame), self._random.random, self.faults
        if draw() < faults.lose:
            return
        if draw() < faults.corrupt:
            data[self._random.randrange(len(data))] ^= self._random.randrange(1, 256)
        if draw() < faults.truncate:
            del data[self._random.randrange(1, len(data)) :]
        if draw() < faults.late:
            self._held.append((self.clock.now() + faults.late_s, bytes(data)))
            return
        self.put(bytes(data))

    def _sense(self, seconds: float) -> None:
        state = zip(*self.plant.read(), strict=True)
        for motor, (position, velocity, torque) in zip(self.motors, state, strict=True):
            motor.sense(seconds, float(position), float(velocity), float(torque))


def collide(frames: Sequence[bytes]) -> bytes:
    """What is on the line when motors of one ID answer at once.

    A zero of any of them pulls it down.

    Equal answers, such as those to a ping, are not told from one.
    """
    return bytes(
        functools.reduce(operator.and_, column)
        for column in itertools.zip_longest(*frames, fillvalue=0xFF)
    )


def _answer(motor: Motor, packet: Packet) -> Packet | None:
    """What one motor makes of a packet on the bus; None for silence."""
    broadcast, kind = packet.id == BROADCAST, packet.instruction
    if kind == Instruction.STATUS or not (broadcast or packet.id == motor.id):
        return None
    motor.heard()
    level = motor.get("status_return_level")
    if broadcast and kind == Instruction.SYNC_WRITE:
        _sync_write(motor, packet.parameters)
        return None
    if broadcast and kind == Instruction.SYNC_READ:
        return _sync_read(motor, packet.parameters) if level else None
    failure, data = _single(motor, kind, packet.parameters)
    quiet = broadcast or level == 0 or (level == 1 and kind != Instruction.READ)
    if quiet and kind != Instruction.PING:
        return None
    return status(motor.id, failure | motor.alert, data)


def _single(motor: Motor, kind: int, parameters: bytes) -> tuple[int, bytes]:
    """Carry out an instruction to one motor: error number and data."""
    match kind, len(parameters):
        case Instruction.PING, 0:
            return Failure.NONE, motor.read(0, 2)[1] + motor.read(6, 1)[1]
        case Instruction.READ, 4:
            return motor.read(_word(parameters), _word(parameters, 2))
        case Instruction.WRITE, _:
            return motor.write(_word(parameters), parameters[2:]), b""
        case ((Instruction.PING | Instruction.READ), _):
            return Failure.LENGTH, b""
    return Failure.INSTRUCTION, b""


def _sync_read(motor: Motor, parameters: bytes) -> Packet | None:
    if len(parameters) < 5 or motor.id not in parameters[4:]:
        return None
    failure, data = motor.read(_word(parameters), _word(parameters, 2))
    return status(motor.id, failure | motor.alert, data)


def _sync_write(motor: Motor, parameters: bytes) -> None:
    address, length, rows = _word(parameters), _word(parameters, 2), parameters[4:]
    if length and len(rows) % (length + 1) == 0:
        for start in range(0, len(rows), length + 1):
            if rows[start] == motor.id:
                motor.write(address, rows[start + 1 : start + 1 + length])


def _word(data: bytes, at: int = 0) -> int:
    return int.from_bytes(data[at : at + 2], "little")
