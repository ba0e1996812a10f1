"""A hand's motors at the far end of a simulated line, on a simulated clock.

dynamixel-sdk talks to the port as to any other, and bytes take their time on the line.
"""

import contextlib
from collections.abc import Iterator, Sequence

import dynamixel_sdk
import numpy as np
from motor_line import MotorLine
from motor_model import make_motors
from motor_plant import Plant
from simulated_clock import SimulatedClock

from vd.assets_usd.hand_model import HandModel
from vd.deploy.hardware.bus import BAUD_RATE, MotorBus
from vd.deploy.hardware.control_table import to_angle
from vd.deploy.hardware.joints import JointMotors

BYTE_S = 10.0 / BAUD_RATE
"""Eight bits, a start bit and a stop bit."""
TICK_S = 0.005
"""How often the plant goes on where nobody asks, as in the twin."""
POLL_S = 0.0005
"""Time that a program spends on asking for bytes that are not there."""


class SimulatedPort(dynamixel_sdk.PortHandler):
    """The SDK's port, with a line in place of a device."""

    def __init__(self, clock: SimulatedClock):
        super().__init__("simulated")
        self.clock, self.line = clock, None
        self.is_open, self.tx_time_per_byte = True, 1e3 * BYTE_S
        self.starved_s = 0.0
        """How long this program does not run, whenever it waits for what has not come."""
        self.lag_s = 0.0
        """How much later than that bytes of the motors arrive."""
        self._coming: list[tuple[float, int]] = []
        self._free_s = 0.0

    def put(self, data: bytes) -> None:
        """Bytes of the motors, one after the other."""
        for byte in data:
            self._free_s = max(self._free_s, self.clock.now() + self.lag_s) + BYTE_S
            self._coming.append((self._free_s, byte))

    def clearPort(self) -> None:  # noqa: N802 (the SDK's name)
        """Forget what has come."""
        self._coming = [one for one in self._coming if one[0] > self.clock.now()]

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802
        """The motors hear a packet once its last byte is out."""
        self._check()
        self.clock.sleep(len(packet) * BYTE_S)
        self.line.go_on(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """What has come; waits a little for the first byte."""
        self._check()
        if not self._coming or self._coming[0][0] > self.clock.now():
            self.clock.sleep(POLL_S + self.starved_s)
        here = [byte for at, byte in self._coming[:length] if at <= self.clock.now()]
        del self._coming[: len(here)]
        return bytes(here)

    def getCurrentTime(self) -> float:  # noqa: N802
        """Milliseconds."""
        return 1e3 * self.clock.now()

    def closePort(self) -> None:  # noqa: N802
        """Pull the plug."""
        self.is_open = False

    def _check(self) -> None:
        if not self.is_open:
            raise OSError("the plug is out")


@contextlib.contextmanager
def simulated_bus(
    hand: HandModel, joints: JointMotors, plant: Plant | None = None
) -> Iterator[tuple[MotorLine, MotorBus]]:
    """A line of a hand's motors, and a configured bus to it."""
    clock = SimulatedClock()
    port = SimulatedPort(clock)
    port.line = line = MotorLine(make_motors(joints), plant, clock=clock, put=port.put)
    line.port = port
    stop = clock.every(TICK_S, line.go_on)
    with MotorBus(port, joints.ids, joints.models, clock=clock) as bus:
        bus.configure(joints.settings())
        yield line, bus
    stop()


def energised(line: MotorLine) -> list[int]:
    """Motors that have torque, by ID."""
    return [motor.id for motor in line.motors if motor.get("torque_enable")]


def push(line: MotorLine) -> np.ndarray:
    """How far each motor's goal is from where it is [rad]; none if its torque is off."""
    error = [
        to_angle(m.get("goal_position")) - to_angle(m.get("present_position")) for m in line.motors
    ]
    return np.abs(error) * [motor.get("torque_enable") for motor in line.motors]
