"""The motors of a hand through dynamixel-sdk.

Goals out, states in, gains and limits written and read back.

Angles in radians with zero in the middle of a motor's range, velocities in rad/s, currents in A.
Which states are accepted, :mod:`vd.deploy.hardware.answers` says. Everything goes through one lock.
"""

import contextlib
import termios
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from vd.deploy.clock import MONOTONIC, Clock
from vd.deploy.hardware.answers import (
    CLOCK_TOLERANCE_S,
    OTHER_BYTES,
    STATE_ADDRESS,
    STATE_BYTES,
    Answer,
    BusError,
    GarbledError,
    HandState,
    LateError,
    SilentError,
    StateCheck,
    read_answer,
)
from vd.deploy.hardware.control_table import (
    SIZE,
    WATCHDOG_TRIPPED,
    WATCHDOG_UNIT_S,
    Model,
    describe_hardware_error,
    model_name,
    table,
    to_counts,
)
from vd.deploy.hardware.port import BAUD_RATE, WAIT_S, open_port, sdk
from vd.deploy.hardware.registers import MotorSettings, different

T = TypeVar("T")
HEADER = b"\xff\xff\xfd\x00"
STUFFED = b"\xff\xff\xfd"
"""What within a packet is followed by one more FD, so that no header appears."""
STATUS_BYTES = 11
"""Bytes of a status packet without data."""
STARVED_S = 0.02
"""A read of the port that returns so much too late may have missed an answer: motors answer within
5 ms, and the SDK, once it runs again, finds that its 34 ms are over."""
BUSY = (
    "this computer is busy; end other programs, or give this one real-time priority (ulimit -r 1)"
)
TWICE = (
    "its answers are garbled: two motors have the ID {id} (unplug one, and give the other a new "
    "one with ROBOTIS' DYNAMIXEL Wizard 2.0), or a cable is bad"
)
"""What garbled answers mean."""
RETRIES = 1
"""How often to ask again where no sound answer came."""
LATE_S = 0.02
"""Pause after a question that was asked in vain or again; what arrives meanwhile is dropped."""


class MotorBus:
    """Motors on one serial port.

    Every exchange raises :class:`BusError` where a packet could not be sent, a motor refused, or no
    sound answer came, also not when asked again.

    Args:
        port: Device, such as /dev/ttyUSB0, or an open port of the SDK's kind.
        ids: Motors in the order of the arrays.
        models: Model of each.
        baud_rate: To open the device with.
        retries: How often to ask again where no sound answer came.
        clock: Time.

    Raises:
        BusError: The port cannot be opened, or another program has it.
    """

    def __init__(
        self,
        port: Any,
        ids: Sequence[int],
        models: Sequence[Model],
        *,
        baud_rate: int = BAUD_RATE,
        retries: int = RETRIES,
        clock: Clock = MONOTONIC,
    ):
        """Open the port."""
        self.ids = tuple(ids)
        self.clock = clock
        self._model = dict(zip(self.ids, models, strict=True))
        self._items = {id: table(model) for id, model in self._model.items()}
        self._sdk = sdk()
        self._lock = threading.RLock()
        self._packets = self._sdk.PacketHandler(2.0)
        self.states = StateCheck(self.ids, models)
        """Which answers are states of the motors."""
        self._goals = b""
        self._length = STATE_BYTES
        self._settings: dict[int, MotorSettings] = {}
        self.rejected = 0
        """States that were not accepted."""
        self._port = open_port(port, baud_rate) if isinstance(port, str) else port
        self.retries = retries
        self._late_s = 0.0
        self._listened_s = 0.0
        self._hear = self._port.readPort
        self._port.readPort = self._listen

    def __enter__(self) -> "MotorBus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def port(self) -> str:
        """Name of the port."""
        return str(self._port.getPortName())

    def close(self) -> None:
        """Close the port. Torque stays as it is."""
        with self._lock:
            if self._port.is_open:
                self._port.closePort()

    def _listen(self, length: int) -> bytes:
        """Read the port, and keep by how much this program was later at it than it has to be."""
        data: bytes = self._hear(length)
        now = self.clock.now()
        self._late_s = max(self._late_s, now - self._listened_s - WAIT_S)
        self._listened_s = now
        return data

    @contextlib.contextmanager
    def _line(self) -> Iterator[None]:
        """The bus for one exchange. What the serial port raises becomes a BusError."""
        with self._lock:
            self._late_s = 0.0
            self._listened_s = self.clock.now()
            try:
                yield
            except (OSError, termios.error, TypeError) as error:  # a closed port raises TypeError
                raise BusError(
                    f"{self.port} is lost: {error}; is its adapter still there?"
                ) from error
            finally:
                # Else no packet could follow an exchange that was interrupted.
                self._port.is_using = False

    def _packet(self, id: int, instruction: int, parameters: bytes = b"") -> bytes:
        """A packet of protocol 2.0 on the wire."""
        body = bytes([instruction]) + parameters
        body = body.replace(STUFFED, STUFFED + STUFFED[-1:])
        packet = HEADER + bytes([id]) + _words(len(body) + 2) + body
        return packet + _words(self._packets.updateCRC(0, packet, len(packet)))

    def _ask(
        self, id: int, what: str, instruction: int, parameters: bytes = b"", size: int = 0
    ) -> bytes:
        """One exchange with one motor, again if no sound answer came.

        The ``size`` bytes of its answer.
        """
        packet = self._packet(id, instruction, parameters)
        first_s = self.clock.now()
        for attempt in range(self.retries + 1):
            last_s = self.clock.now()
            try:
                with self._line():
                    self._send(packet, STATUS_BYTES + size)
                    answer = self._answer(id, size, what)
            except (SilentError, LateError, GarbledError) as error:
                # An answer that comes now is none to the next question.
                self.clock.sleep(LATE_S)
                if attempt < self.retries:
                    continue
                if isinstance(error, GarbledError):
                    raise GarbledError(f"{error}: {TWICE.format(id=id)}") from error
                raise
            else:
                if attempt:  # it may have been to the first try, and that to the last is as late
                    self.clock.sleep(LATE_S + last_s - first_s)
                break
        if answer.error:
            raise BusError(f"motor {id}: {what}{self._refused(answer)}")
        return answer.data

    def _refused(self, answer: Answer) -> str:
        """Why a motor did not do it, in the SDK's words."""
        words = self._packets.getRxPacketError(answer.error)
        return f"refused: {words.removeprefix('[RxPacketError] ').rstrip('!.').lower()}"

    def ping_all(self) -> list[int]:
        """IDs of all motors that answer a ping to all."""
        with self._line():
            motors, _ = self._packets.broadcastPing(self._port)
        return list(map(int, motors))

    def missing(self) -> dict[int, str]:
        """What is wrong with the motors that do not answer, or are of another model, by ID."""
        wrong = {}
        for id in self.ids:
            try:
                answer = self._ask(id, "", self._sdk.INST_PING, size=3)
            except (SilentError, LateError, GarbledError) as error:
                wrong[id] = str(error)
                continue
            number = int.from_bytes(answer[:2], "little")
            if number != self._model[id].number:
                wrong[id] = f"motor {id} is {model_name(number)}, not {self._model[id].name}"
        return wrong

    def read(self, id: int, name: str) -> int:
        """Value of one item of the control table."""
        item = self._items[id][name]
        where = _words(item.address, item.size)
        data = self._ask(id, f"read {name}: ", self._sdk.INST_READ, where, item.size)
        return item.from_bytes(data)

    def read_table(self, id: int) -> dict[str, int]:
        """The whole control table of a motor, with one packet: values by item.

        Raises:
            BusError: No sound answer; GarbledError where answers came that were none.
        """
        data = self._ask(id, "read its table: ", self._sdk.INST_READ, _words(0, SIZE), SIZE)
        return {name: item.within(data) for name, item in self._items[id].items()}

    def write(self, id: int, name: str, value: int) -> None:
        """Write one item of the control table."""
        item = self._items[id][name]
        data = _words(item.address) + item.to_bytes(value)
        self._ask(id, f"write {value} to {name}: ", self._sdk.INST_WRITE, data)

    def configure(self, settings: Mapping[int, MotorSettings]) -> None:
        """Torque off, write the registers that are ours to set and differ, and read them back.

        Raises:
            BusError: A motor did not answer, refused, or kept another value; names each.
        """
        wrong = []
        for id in self.ids:
            self.write(id, "torque_enable", 0)
            for _ in range(2):  # another operating mode changes the gains
                for name, (_, wanted) in self._to_set(id, settings[id]).items():
                    self.write(id, name, wanted)
            for name, (value, wanted) in self._to_set(id, settings[id]).items():
                wrong.append(f"motor {id}: {name} is {value}, not {wanted}")
        if wrong:
            raise BusError("; ".join(wrong))
        with self._lock:
            self._settings = dict(settings)
            self.states.fastest[:] = [settings[id].velocity_limit_rad_s for id in self.ids]
            self.states.forget()

    def _to_set(self, id: int, settings: MotorSettings) -> dict[str, tuple[int, int]]:
        """Registers that are ours to set and differ: value, and the wanted one."""
        rows = different(self.read_table(id), self._model[id], settings)
        return {row.name: values for row, values in rows.items() if not row.remedy}

    def torque(self, on: bool, ids: Sequence[int] | None = None) -> dict[int, str]:
        """Switch torque on or off. Goes on to the other motors if one does not answer.

        Returns:
            What failed, by ID: with torque off, those motors may still be on.
        """
        failed = {}
        for id in self.ids if ids is None else ids:
            try:
                self.write(id, "torque_enable", int(on))
            except BusError as error:
                failed[id] = str(error)
        return failed

    def stiffen(self, share: float, ids: Sequence[int] | None = None) -> None:
        """Have motors hold with a share of the position gain that was configured.

        A smaller gain of all motors goes out in one packet, which none answers; else it is written
        to each, which does.
        """
        gains = {}
        for id in self.ids if ids is None else ids:
            gains[id] = round(share * self._settings[id].p_gain)
        if ids is None and share < 1.0:
            self._write_all("position_p_gain", list(gains.values()))
            return
        for id, gain in gains.items():
            self.write(id, "position_p_gain", gain)

    def release(self) -> None:
        """Switch the torque of all motors off with one packet, which none of them answers."""
        self._write_all("torque_enable", [0] * len(self.ids))

    def watch(self, seconds: float) -> None:
        """Have the motors stop where they are once the line was silent for so long.

        0 switches that off.

        A motor that has stopped so refuses goals until this is called again.
        """
        for id in self.ids:
            self.write(id, "bus_watchdog", 0)
            if seconds > 0.0:
                self.write(id, "bus_watchdog", max(1, round(seconds / WATCHDOG_UNIT_S)))

    def freeze(self) -> None:
        """Have the motors stop where they are, without an answer, within two units of silence.

        The shortest bus watchdog, in one packet: what a line that brings no states still can do.
        """
        self._write_all("bus_watchdog", [1] * len(self.ids))
        self.clock.sleep(2.0 * WATCHDOG_UNIT_S)

    def hardware_errors(self) -> dict[int, str]:
        """Hardware errors of the motors that have one, in words, by ID."""
        errors = {}
        for id in self.ids:
            bits = self.read(id, "hardware_error_status")
            if bits:
                errors[id] = describe_hardware_error(bits)
        return errors

    def write_goals(self, goals: np.ndarray, *, with_state: bool = False) -> None:
        """Send all goals in one packet.

        Args:
            goals: Angles [rad], shape [D]; clipped to the limits that were configured where the
                motor refuses goals beyond.
            with_state: Send them in one piece with the question of the next :meth:`read_state`, so
                that both arrive at the same moment; others that are sent before take their place.

        Raises:
            ValueError: A goal that is no number; nothing is sent.
            BusError: The packet could not be sent.
        """
        goals = np.asarray(goals, dtype=float)
        if goals.shape != (len(self.ids),) or not np.isfinite(goals).all():
            raise ValueError(f"goals have to be {len(self.ids)} finite angles, not {goals}")
        counts = []
        for id, goal in zip(self.ids, goals, strict=True):
            known = self._settings.get(id)
            if known is not None and not known.current_based:
                goal = np.clip(goal, known.lower_rad, known.upper_rad)
            counts.append(to_counts(float(goal)))
        self._write_all("goal_position", counts, later=with_state)

    def _write_all(self, name: str, values: Sequence[int], *, later: bool = False) -> None:
        """Write one item of every motor in one packet, now or with the question for their state."""
        item = self._items[self.ids[0]][name]
        parameters = _words(item.address, item.size)
        for id, value in zip(self.ids, values, strict=True):
            parameters += bytes([id]) + item.to_bytes(value)
        packet = self._packet(self._sdk.BROADCAST_ID, self._sdk.INST_SYNC_WRITE, parameters)
        with self._line():
            self._goals = packet if later else b""
            if not later:
                self._send(packet)

    def read_state(self, *, retries: int | None = None) -> HandState:
        """Read all motors at once.

        Args:
            retries: How often to ask again; the bus' own by default.

        Raises:
            BusError: No whole, fresh and possible state came, also not when asked again; names the
                motor.
        """
        return self._again(self._read_state, self.retries if retries is None else retries)

    def _again(self, ask: Callable[[], T], retries: int) -> T:
        """What all motors answer, asked again where no sound answer came."""
        for _ in range(retries):
            with contextlib.suppress(BusError):
                return ask()
        return ask()

    def _read_state(self) -> HandState:
        try:
            with self._line():
                asked = self.clock.now()
                goals = self._goals
                self._goals = b""
                heard, answers = self._ask_all(STATE_ADDRESS, self._length, before=goals)
                took = self.clock.now() - asked
                if took > CLOCK_TOLERANCE_S:
                    # This process did not run: whose time is not known is nothing to compare later
                    # ones with.
                    raise LateError(f"the state took {took:.3f} s: {BUSY}")
                # Motors measure when they have heard it, or not before they answer. A later time
                # than theirs would look like a delay of the goals, which has a name; an earlier one
                # does not.
                return self.states.accept(heard, answers)
        except BusError:
            self.rejected += 1
            self._length = STATE_BYTES + OTHER_BYTES - self._length
            raise

    def read_torque(self) -> np.ndarray:
        """Whether each motor has its torque on, shape [D] bool."""
        return self._read_all("torque_enable") != 0

    def read_tripped(self) -> np.ndarray:
        """Whether each motor was stopped by its bus watchdog, shape [D] bool."""
        return self._read_all("bus_watchdog") == WATCHDOG_TRIPPED

    def _read_all(self, name: str) -> np.ndarray:
        """One item of every motor, with one packet, shape [D]."""
        item = self._items[self.ids[0]][name]

        def ask() -> np.ndarray:
            with self._line():
                _, answers = self._ask_all(item.address, item.size)
            return np.array([item.from_bytes(answer.data) for answer in answers])

        return self._again(ask, self.retries)

    def _ask_all(
        self, address: int, length: int, before: bytes = b""
    ) -> tuple[float, list[Answer]]:
        """Ask all motors for the same bytes with one packet.

        When they heard it [s], and what each answers.

        Args:
            address: First byte.
            length: How many.
            before: Packets to send in one piece with it.
        """
        parameters = _words(address, length) + bytes(self.ids)
        question = self._packet(self._sdk.BROADCAST_ID, self._sdk.INST_SYNC_READ, parameters)
        # One time for all: the SDK counts no time for the answers' bytes.
        heard = self._send(before + question, (STATUS_BYTES + length) * len(self.ids))
        answers = [self._answer(id, length) for id in self.ids]
        for answer in answers:
            if answer.error:
                raise BusError(f"motor {answer.id}: {self._refused(answer)}")
        return heard, answers

    def _send(self, packets: bytes, answer_bytes: int = 0) -> float:
        """Send packets in one piece, and wait from then on for so many bytes.

        When they were sent [s].
        """
        self._port.clearPort()
        if self._port.writePort(packets) != len(packets):
            raise BusError(f"{self.port} did not take what was to be sent")
        self._port.setPacketTimeout(answer_bytes)
        self._listened_s = self.clock.now()
        return self._listened_s

    def _answer(self, id: int, size: int, what: str = "") -> Answer:
        """This motor's next answer of ``size`` bytes, or that it refuses.

        What else comes is late from an exchange before: the time limit is one for all.
        """
        while True:
            frame, result = self._packets.rxPacket(self._port, False)
            if result != self._sdk.COMM_SUCCESS:
                break
            answer = read_answer(bytes(frame))
            if answer is None or answer.id != id:
                continue
            if answer.error or len(answer.data) == size:
                return answer
        if result == self._sdk.COMM_RX_TIMEOUT or self._late_s > STARVED_S:
            raise self._silence(f"{what}motor {id} does not answer")
        words = self._packets.getTxRxResult(result).removeprefix("[TxRxResult] ").rstrip("!.")
        raise GarbledError(f"motor {id}: {what}{words}")

    def _silence(self, what: str) -> BusError:
        """Nobody was heard in the last exchange: by this program's own fault, or the motor's."""
        if self._late_s > STARVED_S:
            return LateError(
                f"{what}: this program was {self._late_s:.3f} s late to listen: {BUSY}"
            )
        return SilentError(
            f"{what}: check its cable, power, baud rate and ID, which may be that of another motor"
        )


def _words(*values: int) -> bytes:
    """Numbers of two bytes, as addresses and lengths are."""
    return b"".join(value.to_bytes(2, "little") for value in values)
