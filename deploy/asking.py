"""Questions to the person at the terminal: only what is typed after a question answers it."""

import contextlib
import os
import select
import sys
import termios


def attended() -> bool:
    """Whether a person can answer: at a terminal, with this program not in its background."""
    if sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
        return False
    with contextlib.suppress(OSError):  # a terminal without job control
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    return True


def ask(question: str) -> None:
    """Forget what was typed so far, and ask."""
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    print(f"{question} ", end="", file=sys.stderr, flush=True)


def answered() -> bool:
    """Whether a line was typed since, or the input has ended."""
    return bool(select.select([sys.stdin], [], [], 0.0)[0])


def answer() -> str | None:
    """The line that is typed; None at the end of the input, which is no answer."""
    line = sys.stdin.readline()
    return line.strip() if line else None
