"""The motors' port: one program at a time has it, and who has it is named."""

import errno
import fcntl
import os
import subprocess
import sys

import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from vd.deploy.hardware import port
from vd.deploy.hardware.answers import BusError
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.control_table import MODELS
from vd.deploy.twin.motor import Motor
from vd.deploy.twin.twin import Twin

IDS, MODEL = (10, 11, 12), "XH430-V210"


@pytest.fixture
def twin():
    with Twin([Motor(MODELS[MODEL], id) for id in IDS]) as served:
        yield served


HOLDER = """
import sys
from vd.deploy.hardware.port import open_port
port = open_port(sys.argv[1])
print("open", flush=True)
sys.stdin.read()
"""


def test_a_port_is_for_one_program_at_a_time(twin):
    """And is free again however that one ended."""
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, twin.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert holder.stdout.readline() == b"open\n"
        with pytest.raises(BusError, match=rf"in use by process {holder.pid} \(.*python.*end that one first"):
            MotorBus(twin.path, IDS, MODEL)
    finally:
        holder.kill()
        holder.communicate()
    with MotorBus(twin.path, IDS, MODEL):
        with pytest.raises(BusError, match=f"in use by process {os.getpid()} "):
            MotorBus(twin.path, IDS, MODEL)


def test_a_serial_device_is_exclusive_and_refused_where_a_program_has_it_without_a_lock(twin, monkeypatch):
    monkeypatch.setattr(port, "PSEUDO_TERMINALS", "/nowhere/")
    with MotorBus(twin.path, IDS, MODEL) as bus:
        answer = fcntl.ioctl(bus._port.ser.fileno(), 0x80045440, bytes(4))  # TIOCGEXCL
        assert int.from_bytes(answer, "little") == 1
    careless = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(1, flush=True); input()"
    other = subprocess.Popen(
        [sys.executable, "-c", careless, twin.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        other.stdout.readline()
        with pytest.raises(BusError, match=f"in use by process {other.pid} "):
            MotorBus(twin.path, IDS, MODEL)
    finally:
        other.kill()
        other.communicate()


def test_a_port_that_cannot_be_opened_names_the_remedy(twin, monkeypatch):
    with pytest.raises(BusError, match=r"no such device; is the adapter plugged in\? There are: "):
        MotorBus("/dev/ttyUSB99", IDS, MODEL)
    monkeypatch.setattr(port, "_group", lambda path: "dialout")
    monkeypatch.setattr(os, "open", lambda *_: (_ for _ in ()).throw(PermissionError(errno.EACCES, "no")))
    with pytest.raises(BusError, match=r"group dialout; `sudo usermod -aG dialout \$USER`, then log out"):
        MotorBus(twin.path, IDS, MODEL)
