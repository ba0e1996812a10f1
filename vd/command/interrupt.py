"""What all commands do: say that they start, report an error in a line, end by a signal.

The exit status is then 128 and the signal's number: 130 after Ctrl-C, 143 after SIGTERM, and 129
once the terminal is gone.
"""

import functools
import importlib.util
import io
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, ParamSpec

INTERRUPTED = 128 + signal.SIGINT
"""Exit status after Ctrl-C."""

FAILED = 1
"""Exit status after an error that is the user's to mend."""

USAGE_ERROR = 2
"""Exit status after a flag that does not exist."""

PARENT_S = 0.5
"""Between two looks at the parent [s]."""
ENDING_S = 5.0
"""Time for a process to leave things in order before it is asked again, or killed [s]."""
AGAIN_S = 0.1
"""Until a signal that a finaliser swallowed comes again [s]."""

EXTRAS = {
    "train": ("rsl_rl", "tensordict", "tensorboard"),
    "video": ("imageio_ffmpeg",),
    "hardware": ("dynamixel_sdk", "serial", "pyrealsense2", "cv2"),
    "recordings": ("pyarrow", "rosbags"),
    "gym": ("gymnasium",),
    "export": ("onnx", "onnxscript", "onnxruntime"),
}
"""Packages that not every user needs, by the extra that brings them."""

P = ParamSpec("P")

_last = 0
"""The signal that came last; whoever handles one by itself says so with :func:`note`."""


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP. What is tidied up after Ctrl-C is tidied up after these too."""


def note(number: int) -> None:
    """A signal came, and is handled elsewhere."""
    global _last
    _last = number


def need(*packages: str) -> None:
    """Refuse at once what needs packages of :data:`EXTRAS` that are not installed.

    Raises:
        ModuleNotFoundError: The first that is missing, and how to install it.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise ModuleNotFoundError(
                f"{package} is not installed: {remedy(package)}", name=package
            )


def remedy(package: str) -> str:
    """The command that installs a package of :data:`EXTRAS`; empty for others."""
    extra = next((extra for extra, packages in EXTRAS.items() if package in packages), "")
    return extra and f"pip install 'visual-dexterity[{extra}]'"


def command(name: str) -> Callable[[Callable[P, Any]], Callable[P, Any]]:
    """Have the entry point of a command start and end as all commands do.

    ``VD_DEBUG=1`` in the environment adds to an error where in the code it arose. ``name`` is the
    command's.
    """

    def format_warning(message: Warning | str, *_: Any, **__: Any) -> str:
        return f"{name}: {message}\n"  # a user has no use for the line of the source

    def wrap(main: Callable[P, Any]) -> Callable[P, Any]:
        @functools.wraps(main)
        def run(*args: P.args, **kwargs: P.kwargs) -> Any:
            _show_what_can_be_shown()
            given = args[0] if args and isinstance(args[0], Sequence) else sys.argv[1:]
            if given and not {"-h", "--help", "--help-all"} & set(given):
                # What it imports takes seconds.
                print(f"{name}: starting", file=sys.stderr, flush=True)
            warnings.formatwarning = format_warning
            with _terminated():
                try:
                    status = main(*args, **kwargs)
                except SystemExit as end:
                    end.code = _status(end.code)
                    raise
                except (ValueError, OSError, RuntimeError, ModuleNotFoundError) as error:
                    return _failed(name, error)
                except KeyboardInterrupt as error:
                    print(f"\n{name}: stopped", file=sys.stderr)
                    return 128 + _last if isinstance(error, Terminated) else INTERRUPTED
            return _status(status)

        return run

    return wrap


def _show_what_can_be_shown() -> None:
    """Have a terminal that lacks a letter, such as an ASCII one a dash, end no command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _failed(name: str, error: Exception) -> int:
    """Tell a user what is wrong; returns the exit status."""
    if os.environ.get("VD_DEBUG"):
        traceback.print_exc()
    if isinstance(error, ModuleNotFoundError):
        if not (install := remedy(package := (error.name or "").partition(".")[0])):
            raise error
        error = ModuleNotFoundError(f"{package} is not installed: {install}")
    print(f"{name}: {error}", file=sys.stderr)
    asked = int(getattr(error, "signal", 0))  # a moving hand is stopped first
    return 128 + asked if asked else FAILED


def _status(status: Any) -> Any:
    """An exit status; where a command only knows that it was interrupted, by which signal."""
    return 128 + _last if _last and status == INTERRUPTED else status


@contextmanager
def handled(
    handler: Callable[[int, FrameType | None], None], *numbers: signal.Signals
) -> Iterator[None]:
    """Have signals call ``handler``, but for a SIGHUP that is ignored (nohup)."""
    before = {}
    # Signals belong to it; elsewhere are none.
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


@contextmanager
def _terminated() -> Iterator[None]:
    """Have SIGTERM and SIGHUP raise :class:`Terminated`.

    What this process forks ends at once, as without.
    """
    owner = os.getpid()

    def terminate(number: int, _: FrameType | None) -> None:
        if os.getpid() != owner:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        note(number)
        raise Terminated

    note(0)
    before = sys.unraisablehook
    sys.unraisablehook = _come_again
    try:
        with handled(terminate, signal.SIGTERM, signal.SIGHUP):
            yield
    finally:
        sys.unraisablehook = before


def _come_again(lost: Any) -> None:
    """Have a signal come again that arrived in a finaliser, where Python drops what is raised."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        threading.Timer(AGAIN_S, os.kill, (os.getpid(), _last or signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(lost)


def end_with_parent(parent: int) -> None:
    """Have SIGTERM end this process once its parent is gone.

    One that is killed cannot tell its children.

    The parent tells its process ID itself: it may be gone already.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_S)
        while True:  # a library that catches everything may swallow the first
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(ENDING_S)

    threading.Thread(target=watch, daemon=True).start()
