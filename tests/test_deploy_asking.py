"""Only what is typed after a question answers it, and the end of the input is no yes."""

import os
import pty
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from simulated_hand import energised, simulated_bus

from vd.assets_usd.hands import load_hand
from vd.deploy.hardware.check import confirm
from vd.deploy.hardware.joints import read_joints
from vd.deploy.loop.run import place
from vd.deploy.safety.limits import SafetyCfg
from vd.deploy.safety.safety import SafeHand, StoppedError

END = b"\x04"
"""Ctrl-D: the end of the input."""
PASS_S = 0.1
"""What is typed takes a moment through the terminal."""
THINK_S = 3.0
"""A person takes so long to put the object into the hand."""


@pytest.fixture
def typed(monkeypatch):
    """Types at a terminal that is the standard input."""
    near, far = pty.openpty()
    with os.fdopen(far, "r") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)

        def write(keys: bytes) -> None:
            os.write(near, keys)
            time.sleep(PASS_S)

        yield write
    os.close(near)


@pytest.mark.parametrize(
    ("before", "after", "moves"),
    [
        (b"", b"y\n", True),
        (b"", b"yes\n", True),
        (b"y\n", b"\n", False),
        (b"y\ny\n", b"n\n", False),
        (b"y", b"\n", False),
        (b"", END, False),
        (b"y\n", END, False),
    ],
)
def test_a_yes_is_typed_after_the_question(typed, before, after, moves):
    typed(before)
    timer = threading.Timer(0.3, typed, [after])
    timer.start()
    if moves:
        confirm("It moves.", yes=False)
    else:
        with pytest.raises(RuntimeError, match="not confirmed"):
            confirm("It moves.", yes=False)
    timer.join()


@pytest.fixture
def safe():
    joints = read_joints(load_hand("dclaw3"))
    with simulated_bus(joints.hand, joints) as (line, bus):
        line.plant.position[:] = joints.hand.start
        bus.clock.sleep(0.01)
        with SafeHand(bus, joints, SafetyCfg(hold_s=0.05), lambda text: None) as hand:
            hand.arm()
            yield hand
        assert energised(line) == []


def test_the_object_is_in_the_hand_once_somebody_says_so_there(safe, typed):
    """Enter twice at the question before, or once on the way to the start, says nothing of it."""
    typed(b"\n\n")
    begin = safe.bus.clock.now()
    safe.bus.clock.every(THINK_S, lambda: typed(b"\n"))
    place(safe, safe.hand.start, None, yes=False)
    assert safe.bus.clock.now() - begin >= THINK_S


def test_other_words_are_no_enter(safe, typed, capsys):
    said = iter([b"wait\n", b"\n"])
    begin = safe.bus.clock.now()
    safe.bus.clock.every(THINK_S, lambda: typed(next(said, b"\n")))
    place(safe, safe.hand.start, None, yes=False)
    assert safe.bus.clock.now() - begin >= 2 * THINK_S
    assert capsys.readouterr().err.count("press Enter alone") == 2


def test_the_end_of_the_input_is_no_object_in_the_hand(safe, typed):
    safe.bus.clock.every(THINK_S, lambda: typed(END))
    with pytest.raises(StoppedError, match="input has ended"):
        place(safe, safe.hand.start, None, yes=False)


def test_without_a_terminal_nobody_says_that_the_object_is_there(safe, monkeypatch):
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        with pytest.raises(StoppedError, match="nobody is there"):
            place(safe, safe.hand.start, None, yes=False)
