"""The serial port of the motors, for one program at a time.

Two on one line undo what the other does.
"""

import errno
import fcntl
import os
import termios
from pathlib import Path
from types import ModuleType
from typing import Any

from vd.command import interrupt
from vd.deploy.hardware.answers import BusError

BAUD_RATE = 1_000_000
"""Of the port, where the options name none."""
WAIT_S = 0.002
"""How long a read of the port sleeps at most until its bytes are there. The SDK's own does not
sleep but asks again and again, which takes a core, and keeps whatever shares it from answering."""
FULL_S = 0.1
"""Longest wait for a port that takes no bytes any more: of a dead adapter, or a twin that hangs."""
DEVICES = Path("/dev")
"""Where the devices of serial adapters are."""
PSEUDO_TERMINALS = "/dev/pts/"
"""A twin holds its own end of these open, so exclusive use by one program is for the lock alone."""


def sdk() -> ModuleType:
    """The motors' SDK.

    Raises:
        BusError: It is not installed.
    """
    try:
        import dynamixel_sdk
    except ImportError as error:
        raise BusError(f"motors need dynamixel-sdk: {interrupt.remedy('dynamixel_sdk')}") from error
    return dynamixel_sdk


def open_port(path: str, baud_rate: int = BAUD_RATE) -> Any:
    """A serial port as the SDK takes it, locked for this process until it is closed.

    Args:
        path: Device, such as /dev/ttyUSB0.
        baud_rate: Of the port; the motors' own has to be the same.

    Raises:
        BusError: It cannot be opened, another program has it, or there is no SDK.
    """
    handler = sdk().PortHandler(path)
    import serial

    if handler.getCFlagBaud(baud_rate) < 0:
        raise BusError(f"{path}: no baud rate {baud_rate}")
    try:
        # The SDK's own opening drops what has come for whoever has the port.
        handler.ser = serial.Serial(
            path, baud_rate, timeout=WAIT_S, write_timeout=FULL_S, exclusive=True
        )
        if not pseudo(path):
            fcntl.ioctl(handler.ser.fileno(), termios.TIOCEXCL)
    except OSError as error:
        raise BusError(f"cannot open {path}: {_why(path, error)}") from error
    handler.baudrate = baud_rate
    handler.tx_time_per_byte = 1e4 / baud_rate
    handler.is_open = True
    return handler


def pseudo(path: str) -> bool:
    """Whether a port is a pseudo-terminal, as a twin's is.

    It has no baud rate, so motors answer at each.
    """
    return os.path.realpath(path).startswith(PSEUDO_TERMINALS)


def serial_ports() -> list[str]:
    """Devices of serial adapters that are plugged in, by name."""
    kinds = ("ttyUSB*", "ttyACM*")
    return sorted(str(device) for kind in kinds for device in DEVICES.glob(kind))


def find_port() -> str:
    """The port of the only serial adapter that is plugged in.

    Raises:
        BusError: There is none, or there are several; names the flag to give.
    """
    there = serial_ports()
    if not there:
        raise BusError(
            f"no serial adapter in {DEVICES} (ttyUSB*, ttyACM*): plug the motors' in, name it by "
            "--port, or give --twin for a simulated hand"
        )
    if len(there) > 1:
        raise BusError(f"there are {', '.join(there)}: name the motors' by --port")
    return there[0]


def _why(path: str, error: OSError) -> str:
    """Why a port cannot be opened, with the remedy."""
    if error.errno in (errno.EBUSY, errno.EWOULDBLOCK):
        return f"another program drives the motors; `fuser -v {path}` names it, end it"
    if error.errno == errno.EACCES:
        group = Path(path).group()  # dialout on Debian and Ubuntu, uucp elsewhere
        return (
            f"permission denied: it belongs to the group {group}; "
            f"`sudo usermod -aG {group} $USER`, then log out and in again"
        )
    if error.errno == errno.ENOENT:
        there = ", ".join(serial_ports()) or "none"
        return f"there is no such device; is the adapter plugged in? There are: {there}"
    return f"{error}; is it the motors' adapter?"
