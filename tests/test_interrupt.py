"""How commands end by a signal: every entry point, whatever it was doing."""

import importlib
import io
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
import tyro

from vd.command import interrupt

PROJECT = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text())
SCRIPTS: dict[str, str] = PROJECT["project"]["scripts"]
FIRST = {"vd-train": "teacher", "vd-deploy": "home"}
"""A command of those that have commands, before its options are read."""
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


@pytest.mark.parametrize("number", STATUS)
@pytest.mark.parametrize("script", SCRIPTS)
def test_every_command_ends_with_128_and_the_signals_number(script, number, monkeypatch, capsys):
    module, function = SCRIPTS[script].split(":")
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(tyro, "cli", lambda *_, **__: os.kill(os.getpid(), number))
    monkeypatch.setattr(sys, "argv", [script, *([FIRST[script]] if script in FIRST else [])])
    assert getattr(importlib.import_module(module), function)() == STATUS[number]
    said = capsys.readouterr().err
    assert "stopped" in said or "interrupted" in said
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("number", STATUS)
def test_a_signal_that_arrives_in_a_finaliser_is_not_lost(number):
    class Finalised:
        def __del__(self) -> None:
            os.kill(os.getpid(), number)

    @interrupt.command("vd-some")
    def works() -> None:
        Finalised()
        time.sleep(10.0)

    assert works() == STATUS[number]


def test_an_error_is_one_line_and_with_vd_debug_the_place_in_the_code(monkeypatch, capsys):
    @interrupt.command("vd-some")
    def fails() -> None:
        raise ValueError("--flag is 3")

    for debug, shown in (("", False), ("1", True)):
        monkeypatch.setenv("VD_DEBUG", debug)
        assert fails() == interrupt.FAILED
        said = capsys.readouterr().err
        assert said.endswith("vd-some: --flag is 3\n") and ("test_interrupt.py" in said) == shown


def test_what_an_ascii_terminal_cannot_show_costs_no_result(monkeypatch):
    shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", shown)

    @interrupt.command("vd-x")
    def main():
        print("12.3 % \N{EN DASH}")
        return 0

    assert main() == 0
    shown.flush()
    assert shown.buffer.getvalue() == b"12.3 % ?\n"


def test_what_a_command_forks_ends_by_the_signal_itself():
    """A pool ends its workers with SIGTERM; they have nothing to say about it."""

    @interrupt.command("vd-some")
    def forks() -> int:
        child = os.fork()
        if not child:
            os.kill(os.getpid(), signal.SIGTERM)
            os._exit(0)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    assert forks() == -signal.SIGTERM


def test_a_command_below_nohup_outlives_its_terminal():
    @interrupt.command("vd-some")
    def goes_on() -> int:
        os.kill(os.getpid(), signal.SIGHUP)
        return 0

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert goes_on() == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_child_whose_library_swallows_the_first_signal_ends_with_its_parent_still():
    """Some catch everything, the exception of a signal's handler too."""
    script = """
import signal, sys, time
from vd.command import interrupt
interrupt.ENDING_S = interrupt.PARENT_S = 0.1
signal.signal(signal.SIGTERM, lambda *_: sys.exit(3))
interrupt.end_with_parent(-1)
try:
    time.sleep(60)
except BaseException:
    pass
time.sleep(60)
"""
    assert subprocess.run([sys.executable, "-c", script], timeout=50).returncode == 3
