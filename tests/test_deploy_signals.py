"""Signals to a process that drives a hand: none leaves its torque on, or its motors unnamed."""

import contextlib
import hashlib
import multiprocessing
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from motor_line import Faults
from motor_model import make_motors
from motor_terminal import MotorTerminal
from simulated_hand import energised

from vd.assets_usd.hands import load_hand
from vd.command import interrupt
from vd.deploy import cli
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.joints import read_joints
from vd.deploy.safety.limits import PERIOD_S, SafetyCfg
from vd.deploy.safety.safety import SafeHand

PATIENT = SafetyCfg(lost_s=20.0, misses=240, watchdog_s=2.5, hold_s=0.3)
"""For a machine with other work: late steps are not what is tried here."""
HANGING = replace(PATIENT, misses=12)
"""Where they are: a second."""
IMPATIENT = (0.0, 0.03, *[0.01] * 40)
"""Pauses between signals of somebody who leans on the keys: some come while motors are asked [s]."""
END_S = 20.0
"""Longest end of a process; one that is suspended, or hangs, has none."""
HANG_ROUNDS = 10**9
"""Of a hash in a library that hears no signal: a quarter of an hour."""


def drive(path: str, what: str, words: str) -> None:
    """A process that drives the hand on a port as ``what`` says; its words go to a file."""
    sys.stderr = Path(words).open("w", buffering=1)  # noqa: SIM115

    @interrupt.command("vd-deploy")
    def run() -> int:
        if what == "home":
            flags = ["--port", path, "--yes", "--speed", "0.02", "--safety.lost-s", "20"]
            flags += ["--safety.misses", "240", "--safety.watchdog-s", "2.5"]
            return int(cli.main.__wrapped__(["home", *flags]))
        joints = read_joints(load_hand("dclaw3"))
        with MotorBus(path, joints.ids, joints.models, retries=5) as bus:
            bus.configure(joints.settings())
            with SafeHand(bus, joints, HANGING if what == "hang" else PATIENT) as safe:
                safe.arm()
                for _ in range(round(60.0 / PERIOD_S)):
                    safe.command(safe.read().position)
                    safe.beat()
                    time.sleep(PERIOD_S)
                    if what == "hang":
                        hashlib.pbkdf2_hmac("sha256", b"", b"", HANG_ROUNDS)
        return 0

    os._exit(run())


@pytest.fixture(scope="module")
def start():
    """Starts such processes; what they import is imported once.

    Their server has its path from the environment alone, and passes over what it does not find.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["test_deploy_signals", "vd.deploy.hardware.home"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        yield context.Process


class Driver:
    """A hand on a simulated line, and a process that drives it."""

    def __init__(self, start, twin, words, what):
        self.twin, self._words = twin, words
        self.process = start(target=drive, args=(twin.path, what, str(words)), daemon=True)
        self.process.start()
        self.until(lambda: len(energised(twin)) == 9)
        time.sleep(0.3)  # on the way

    def until(self, true) -> None:
        """Wait for something."""
        end = time.monotonic() + 60.0
        while not true():
            assert time.monotonic() < end and self.process.is_alive(), self.words()
            time.sleep(0.01)

    def press(self, number: int, *pauses: float) -> int:
        """Send a signal after each pause [s]; the exit status of the process."""
        for pause in pauses:
            time.sleep(pause)
            with contextlib.suppress(ProcessLookupError):  # it has ended
                os.kill(self.process.pid, number)
        self.process.join(END_S)
        assert self.process.exitcode is not None, f"it does not end: {self.words()}"
        return self.process.exitcode

    def words(self) -> str:
        """What it said so far."""
        return self._words.read_text()


@pytest.fixture
def driver(start, tmp_path):
    """Makes a driver that does something."""
    joints = read_joints(load_hand("dclaw3"))
    drivers = []
    with MotorTerminal(make_motors(joints), faults=Faults(seed=1)) as twin:
        twin.plant.position[:] = joints.to_motor(joints.hand.start + 0.1)
        twin.go_on()

        def make(what: str) -> Driver:
            drivers.append(Driver(start, twin, tmp_path / "words", what))
            return drivers[-1]

        yield make
        for one in drivers:
            one.process.kill()
            one.process.join()


@pytest.mark.parametrize(
    ("number", "pauses"),
    [
        (signal.SIGINT, IMPATIENT),
        (signal.SIGTERM, (0.0, 0.03, 0.33)),
        (signal.SIGHUP, IMPATIENT),
        (signal.SIGQUIT, IMPATIENT),
        (signal.SIGTSTP, (0.0,)),
    ],
)
def test_no_signal_cuts_off_the_stop(driver, number, pauses):
    driven = driver("loop")
    # What comes after the motors are off and the handlers are gone may end the process itself.
    assert driven.press(number, *pauses) in (128 + number, -number)
    assert energised(driven.twin) == []
    assert "torque off" in driven.words() and "may still be" not in driven.words()


def test_a_command_is_stopped_whole(driver):
    driven = driver("home")
    assert driven.press(signal.SIGINT, *IMPATIENT) == 130, driven.words()
    assert energised(driven.twin) == [] and "stopped: Ctrl-C; torque off" in driven.words()


@pytest.mark.parametrize("pauses", [(0.0, 0.1, 0.1), (2.0,)])
def test_a_policy_that_hangs_where_no_signal_is_heard_is_stopped_and_ended(driver, pauses):
    driven = driver("hang")
    assert driven.press(signal.SIGINT, *pauses) == 130
    assert energised(driven.twin) == [] and "torque off" in driven.words()


def test_a_policy_that_hangs_does_not_keep_the_torque_on(driver):
    driven = driver("hang")
    driven.until(lambda: not energised(driven.twin) and "torque off" in driven.words())
    assert "stopping: the loop stands" in driven.words()
    assert driven.press(signal.SIGTERM, 0.0) == 143


def test_motors_that_cannot_be_reached_are_named_however_often_it_is_asked_to_end(driver):
    driven = driver("loop")
    driven.twin.faults.lose = 1.0
    driven.twin.faults.cut_off.update(motor.id for motor in driven.twin.motors)
    assert driven.press(signal.SIGINT, 0.5, 0.3, 0.3) in (1, 130)
    for motor in driven.twin.motors:
        assert f"motor {motor.id} may still be on, " in driven.words()
