"""The motors of a hand through dynamixel-sdk: goals out, states in, gains and limits written and read back.

Angles in radians with zero in the middle of a motor's range, velocities in rad/s, currents in A. A state is
accepted only whole and fresh: right motor, right length, no error number, a clock that went on as ours did,
and no farther from the last one than the motor can turn. Everything goes through one lock.
"""

import contextlib
import termios
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vd.deploy.control_table import (
    FULL_PWM,
    MODELS,
    POSITION_MODE,
    RAD_S_PER_COUNT,
    TICK_MODULUS,
    WATCHDOG_UNIT_S,
    Item,
    Model,
    describe_hardware_error,
    table,
    to_angle,
    to_counts,
)
from vd.deploy.packets import ALERT, MAX_ID, Failure

BAUD_RATE = 1_000_000
P_GAIN, D_GAIN = 200, 10
"""Position gains of the paper's motors, in their units."""
WAIT_S = 0.002
"""How long a read of the port sleeps at most until its bytes are there. The SDK's own does not sleep but asks
again and again, which takes a core, and keeps whatever shares it from answering."""
STATE_ADDRESS, STATE_BYTES = 120, 27
"""From the realtime tick to the temperature: one read for the whole state."""
CLOCK_TOLERANCE_S = 0.04
"""A state whose clock went on by so much more or less than ours is an old one, or from after a restart; the
packet's own time on the line and in the driver is within it."""
LATE_S = 0.02
"""Pause before a motor is asked again; what arrives meanwhile is dropped."""
JUMP_RAD = 0.1
"""Beyond what the largest speed explains, a position that changed by more was not measured."""
SPEED_MARGIN = 1.5
"""Motors turn faster than their limit of speed when pushed."""


class BusError(RuntimeError):
    """The bus or a motor did not do what was asked; says which, and what to try."""


@dataclass(frozen=True)
class BusState:
    """State of all motors at one reading."""

    time_s: float
    """When it was read, by the monotonic clock [s]."""
    position: np.ndarray
    """Angles [rad], shape [D]."""
    velocity: np.ndarray
    """Speeds [rad/s], shape [D]."""
    current: np.ndarray
    """Currents [A], shape [D]."""
    pwm: np.ndarray
    """Duty cycles in [-1, 1], shape [D]."""
    voltage: np.ndarray
    """Voltages of the supply [V], shape [D]."""
    temperature: np.ndarray
    """Temperatures of the motors [deg C], shape [D]."""
    alert: np.ndarray
    """Whether a motor reports a hardware error, shape [D]."""


@dataclass(frozen=True)
class MotorSettings:
    """What is written to a motor at start, and read back."""

    current_limit_a: float
    """Largest current [A]."""
    velocity_limit_rad_s: float
    """Largest speed [rad/s]."""
    lower_rad: float
    """Least angle [rad]."""
    upper_rad: float
    """Largest angle [rad]."""
    p_gain: int = P_GAIN
    d_gain: int = D_GAIN
    return_delay_us: int = 0
    """Wait before an answer [us]; 500 from the factory."""

    def values(self, model: Model) -> dict[str, int]:
        """Values of the control table, by item, in the order to write them."""
        return {
            "operating_mode": POSITION_MODE,
            "return_delay_time": self.return_delay_us // 2,
            "current_limit": int(self.current_limit_a / model.current_unit_a),
            "velocity_limit": int(self.velocity_limit_rad_s / RAD_S_PER_COUNT),
            "min_position_limit": to_counts(self.lower_rad),
            "max_position_limit": to_counts(self.upper_rad),
            "position_p_gain": self.p_gain,
            "position_d_gain": self.d_gain,
        }


class MotorBus:
    """Motors of one model on one serial port.

    Args:
        port: Device, such as /dev/ttyUSB0.
        ids: Motors in the order of the arrays.
        model: Name of their model.
        baud_rate: Of the port; the motors' own has to be the same.
        retries: How often to ask again where no sound answer came.

    Raises:
        BusError: The port cannot be opened.
        ValueError: IDs or model that cannot be.
    """

    def __init__(
        self, port: str, ids: Sequence[int], model: str, *, baud_rate: int = BAUD_RATE, retries: int = 1
    ):
        """Open the port."""
        if model not in MODELS:
            raise ValueError(f"no motor {model!r}; choose of {', '.join(MODELS)}")
        if not ids or len(set(ids)) != len(ids) or not all(0 <= id <= MAX_ID for id in ids):
            raise ValueError(f"ids are {list(ids)}; give each motor's own, within 0 and {MAX_ID}")
        try:
            import dynamixel_sdk
        except ImportError as error:
            raise BusError("motors need dynamixel-sdk: pip install 'visual-dexterity[hardware]'") from error
        self.ids, self.model, self.retries = tuple(ids), MODELS[model], retries
        self._items = table(self.model)
        self._sdk: Any = dynamixel_sdk
        self._lock = threading.RLock()
        self._port = dynamixel_sdk.PortHandler(port)
        self._packets = dynamixel_sdk.PacketHandler(2.0)
        self._last: BusState | None = None
        self._ticks = np.zeros(len(self.ids), dtype=int)
        self._settings: dict[int, MotorSettings] = {}
        self.rejected = 0
        """States that were not accepted."""
        try:
            opened = self._port.setBaudRate(baud_rate)
        except OSError as error:  # the SDK lets errors of the serial port through
            raise BusError(
                f"cannot open {port}: {error}; is the adapter plugged in, and yours to use?"
            ) from error
        if not opened:
            raise BusError(f"{port}: no baud rate {baud_rate}")
        self._port.ser.timeout = WAIT_S

    def __enter__(self) -> "MotorBus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the port. Torque stays as it is."""
        with self._lock:
            if self._port.is_open:
                self._port.closePort()

    @contextlib.contextmanager
    def _line(self) -> Iterator[None]:
        """The bus for one exchange. What the serial port raises becomes a BusError."""
        with self._lock:
            try:
                yield
            except (OSError, termios.error, TypeError) as error:  # a closed port raises TypeError
                name = self._port.getPortName()
                raise BusError(f"{name} is lost: {error}; is its adapter still there?") from error
            finally:
                self._port.is_using = False  # else no packet could follow an exchange that was interrupted

    def _ask(self, ask: Callable[..., tuple[Any, int, int]], *arguments: Any) -> tuple[Any, int, int]:
        """One exchange with one motor, again if no sound answer came: answer, result and error byte."""
        for attempt in range(self.retries + 1):
            with self._line():
                answer, result, error = ask(self._port, *arguments)
            if result == self._sdk.COMM_SUCCESS or attempt == self.retries:
                break
            time.sleep(LATE_S)  # an answer that comes now is none to the next question
        return answer, result, error

    def ping(self, id: int) -> int | None:
        """Model number of a motor, or None if it does not answer."""
        number, result, _ = self._ask(self._packets.ping, id)
        return int(number) if result == self._sdk.COMM_SUCCESS else None

    def ping_all(self) -> dict[int, tuple[int, int]]:
        """Model number and firmware version of every motor that answers a ping to all, by ID."""
        with self._line():
            found, _ = self._packets.broadcastPing(self._port)
        return {int(id): (int(number), int(firmware)) for id, (number, firmware) in found.items()}

    def missing(self) -> dict[int, str]:
        """What is wrong with the motors that do not answer, or are of another model, by ID."""
        wrong = {}
        for id in self.ids:
            number = self.ping(id)
            if number is None:
                wrong[id] = "does not answer: check its cable, power, ID and baud rate"
            elif number != self.model.number:
                names = {model.number: name for name, model in MODELS.items()}
                wrong[id] = f"is {names.get(number, f'model {number}')}, not {self.model.name}"
        return wrong

    def read(self, id: int, name: str) -> int:
        """Value of one item of the control table.

        Raises:
            BusError: No sound answer.
        """
        item = self._items[name]

        def receive(_: Any, motor: int, address: int, size: int) -> tuple[bytes, int, int]:
            result = self._packets.readTx(self._port, motor, address, size)
            if result != self._sdk.COMM_SUCCESS:
                return b"", result, 0
            frame, result = self._packets.rxPacket(self._port, False)
            body = _status_body(bytes(frame)) if result == self._sdk.COMM_SUCCESS else None
            # The SDK's own reading takes any answer, such as one to a write that came late.
            if body is None or body[0] != motor or (not body[1] & ~ALERT and len(body[2]) != size):
                return b"", result if result != self._sdk.COMM_SUCCESS else self._sdk.COMM_RX_CORRUPT, 0
            return body[2], result, body[1]

        data, result, error = self._ask(receive, id, item.address, item.size)
        self._check(id, f"read {name}", result, error)
        return item.from_bytes(data)

    def write(self, id: int, name: str, value: int) -> None:
        """Write one item of the control table.

        Raises:
            BusError: No sound answer, or the motor refused.
        """
        item = self._items[name]
        data = list(item.to_bytes(value))

        def send(*arguments: Any) -> tuple[None, int, int]:
            return None, *self._packets.writeTxRx(*arguments)

        _, result, error = self._ask(send, id, item.address, item.size, data)
        self._check(id, f"write {value} to {name}", result, error)

    def configure(self, settings: Mapping[int, MotorSettings]) -> None:
        """Torque off, write gains, limits and mode, and read all of it back.

        Raises:
            BusError: A motor did not answer, refused, or kept another value; names each.
        """
        wrong = []
        for id in self.ids:
            values = settings[id].values(self.model)
            self.write(id, "torque_enable", 0)
            for name, value in values.items():
                self.write(id, name, value)
            for name, value in values.items():
                found = self.read(id, name)
                if found != value:
                    wrong.append(f"motor {id}: {name} is {found}, not {value}")
        if wrong:
            raise BusError("; ".join(wrong))
        with self._lock:
            self._settings = dict(settings)
            self._last = None

    def torque(self, on: bool, ids: Iterable[int] | None = None) -> dict[int, str]:
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

    def release(self) -> None:
        """Switch the torque of all motors off with one packet, which none of them answers.

        Raises:
            BusError: The packet could not be sent.
        """
        self._write_all("torque_enable", [0] * len(self.ids))

    def watch(self, seconds: float) -> None:
        """Have the motors stop where they are once the line was silent for so long; 0 switches that off.

        A motor that has stopped so refuses goals until this is called again.

        Raises:
            BusError: No sound answer, or a motor refused.
        """
        for id in self.ids:
            self.write(id, "bus_watchdog", 0)
            if seconds > 0.0:
                self.write(id, "bus_watchdog", max(1, round(seconds / WATCHDOG_UNIT_S)))

    def reboot(self, id: int) -> None:
        """Restart a motor: clears its hardware error. Torque is off afterwards; configure it before use."""
        with self._line():
            result, error = self._packets.reboot(self._port, id)
            self._last = None
        self._check(id, "reboot", result, error)

    def hardware_errors(self) -> dict[int, str]:
        """Hardware errors of the motors that have one, in words, by ID."""
        found = {id: self.read(id, "hardware_error_status") for id in self.ids}
        return {id: describe_hardware_error(bits) for id, bits in found.items() if bits}

    def write_goals(self, goals: np.ndarray) -> None:
        """Send all goals in one packet.

        Args:
            goals: Angles [rad], shape [D]; clipped to the limits that were configured.

        Raises:
            ValueError: A goal that is no number; nothing is sent.
            BusError: The packet could not be sent.
        """
        goals = np.asarray(goals, dtype=float)
        if goals.shape != (len(self.ids),) or not np.isfinite(goals).all():
            raise ValueError(f"goals have to be {len(self.ids)} finite angles, not {goals}")
        counts = []
        for id, goal in zip(self.ids, goals, strict=True):
            if id in self._settings:
                goal = np.clip(goal, self._settings[id].lower_rad, self._settings[id].upper_rad)
            counts.append(to_counts(float(goal)))
        self._write_all("goal_position", counts)

    def _write_all(self, name: str, values: Sequence[int]) -> None:
        """Write one item of every motor in one packet."""
        item = self._items[name]
        rows = [
            byte for id, value in zip(self.ids, values, strict=True) for byte in (id, *item.to_bytes(value))
        ]
        with self._line():
            result = self._packets.syncWriteTxOnly(self._port, item.address, item.size, rows, len(rows))
        if result != self._sdk.COMM_SUCCESS:
            raise BusError(f"{name} was not sent: {self._words(result)}")

    def read_state(self, *, retries: int | None = None) -> BusState:
        """Read all motors at once.

        Args:
            retries: How often to ask again; the bus' own by default.

        Raises:
            BusError: No whole, fresh and possible state came, also not when asked again; names the motor.
        """
        retries = self.retries if retries is None else retries
        for attempt in range(retries + 1):
            try:
                return self._read_state()
            except BusError:
                self.rejected += 1
                if attempt == retries:
                    raise
        raise AssertionError("retries are not negative")

    def _read_state(self) -> BusState:
        ids = list(self.ids)
        with self._line():
            asked = time.monotonic()
            result = self._packets.syncReadTx(
                self._port, STATE_ADDRESS, STATE_BYTES, ids, len(ids), fast_option=False
            )
            if result != self._sdk.COMM_SUCCESS:
                raise BusError(f"states were not asked for: {self._words(result)}")
            # One time for all: the SDK counts no time for the answers' bytes.
            answers = [self._answer(id) for id in ids]
            now = time.monotonic()
            if now - asked > CLOCK_TOLERANCE_S:
                # This process did not run: whose time is not known is nothing to compare later ones with.
                raise BusError(f"the state took {now - asked:.3f} s")
            return self._accept(now, answers)

    def _answer(self, id: int) -> tuple[bytes, int]:
        """State and error byte of this motor's next answer."""
        while True:
            frame, result = self._packets.rxPacket(self._port, False)
            if result != self._sdk.COMM_SUCCESS:
                raise BusError(f"motor {id}: no state: {self._words(result)}")
            body = _status_body(bytes(frame))
            if body is None:
                raise BusError(f"motor {id}: what answered is no status packet")
            if body[0] == id:
                break  # others' come late from an exchange before; the time limit is one for all
        _, error, data = body
        if error & ~ALERT:
            raise BusError(f"motor {id}: {_failure(error)}")
        if len(data) != STATE_BYTES:
            raise BusError(f"motor {id}: {len(data)} bytes of state came, not {STATE_BYTES}")
        return data, error

    def _accept(self, now: float, answers: Sequence[tuple[bytes, int]]) -> BusState:
        def column(name: str) -> np.ndarray:
            item: Item = self._items[name]
            start = item.address - STATE_ADDRESS
            return np.array([item.from_bytes(data[start : start + item.size]) for data, _ in answers])

        ticks = column("realtime_tick")
        state = BusState(
            time_s=now,
            position=np.array([to_angle(int(count)) for count in column("present_position")]),
            velocity=column("present_velocity") * RAD_S_PER_COUNT,
            current=column("present_current") * self.model.current_unit_a,
            pwm=column("present_pwm") / FULL_PWM,
            voltage=0.1 * column("present_input_voltage"),
            temperature=column("present_temperature").astype(float),
            alert=np.array([bool(error & ALERT) for _, error in answers]),
        )
        if self._last is not None:
            self._compare(self._last, state, ticks)
        self._last, self._ticks = state, ticks
        return state

    def _compare(self, last: BusState, state: BusState, ticks: np.ndarray) -> None:
        """Refuse a state that cannot follow the last one."""
        elapsed = state.time_s - last.time_s
        gone = (ticks - self._ticks) % TICK_MODULUS / 1000.0
        span = TICK_MODULUS / 1000.0
        difference = (gone - elapsed + 0.5 * span) % span - 0.5 * span
        for id, late in zip(self.ids, difference, strict=True):
            if abs(late) > CLOCK_TOLERANCE_S:
                # A motor that restarted is not heard again before configure(): its gains and limits are gone.
                raise BusError(
                    f"motor {id}: its clock differs from ours by {late:.3f} s since the last state: that "
                    "state was an old one; if this goes on, the motor restarted and has to be configured"
                )
        for axis, id in enumerate(self.ids):
            fastest = self._settings[id].velocity_limit_rad_s if id in self._settings else np.inf
            moved = abs(state.position[axis] - last.position[axis])
            if moved > SPEED_MARGIN * fastest * elapsed + JUMP_RAD:
                raise BusError(f"motor {id}: moved {moved:.2f} rad in {elapsed:.3f} s, which it cannot")

    def _words(self, result: int) -> str:
        """What went wrong in an exchange, in the SDK's words."""
        return str(self._packets.getTxRxResult(result)).removeprefix("[TxRxResult] ").rstrip("!.")

    def _check(self, id: int, what: str, result: int, error: int) -> None:
        if result != self._sdk.COMM_SUCCESS:
            raise BusError(f"motor {id}: {what}: {self._words(result)}")
        if error & ~ALERT:
            raise BusError(f"motor {id}: {what}: {_failure(error)}")


def _failure(error: int) -> str:
    number = error & ~ALERT
    return f"refused: {Failure(number).name.lower() if number in set(Failure) else f'error {number}'}"


def _status_body(frame: bytes) -> tuple[int, int, bytes] | None:
    """ID, error byte and data of a status packet whose stuffing the SDK has removed; None if it is not whole.

    The SDK has checked the CRC of what came before it removed the stuffing; length and instruction it leaves
    to us.
    """
    length = int.from_bytes(frame[5:7], "little")
    if len(frame) < 7 + length or length < 4 or frame[7] != 0x55:
        return None
    return frame[4], frame[8], frame[9 : 5 + length]
