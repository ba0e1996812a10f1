"""Work in a process of its own, so that a bad mesh can neither hang nor crash the caller."""

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from typing import Any, Literal

from vd.interrupt import ENDING_S, end_with_parent


class ChildError(RuntimeError):
    """A child ended without an answer.

    Attributes:
        code: Its exit code, negative for a signal; None if it was still running at its limit.
    """

    def __init__(self, code: int | None):
        super().__init__("no answer in time" if code is None else f"exit code {code}")
        self.code = code


def _end(number: int, _frame: Any) -> None:
    sys.exit(128 + number)


def _work(answer: Any, parent: int, in_order: bool, work: Callable[..., Any], *arguments: Any) -> None:
    """Do the work and answer, or die with the parent."""
    os.setsid()  # Ctrl-C reaches the first parent alone, which then ends its children
    signal.signal(signal.SIGTERM, _end if in_order else signal.SIG_DFL)
    end_with_parent(parent)
    answer.send(work(*arguments))


def in_child(
    work: Callable[..., Any], *arguments: Any, start: Literal["fork", "spawn"], limit_s: float
) -> Any:
    """What a function answers in a child process, which is gone afterwards.

    A spawned child tidies up when it is ended. One that is forked dies at once: it may be within a library
    that does not listen.

    Args:
        work: The function; it raises nothing.
        *arguments: Its arguments.
        start: How the child begins.
        limit_s: Wall-clock time after which it is taken to hang.

    Raises:
        ChildError: It ended without an answer, or hangs.
    """
    context: Any = multiprocessing.get_context(start)
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_work, args=(sender, os.getpid(), start == "spawn", work, *arguments))
    child.start()
    sender.close()
    try:
        if not receiver.poll(limit_s):
            raise ChildError(None)
        answer = receiver.recv()
        child.join(ENDING_S)  # it tidies up by itself
        return answer
    except EOFError:
        child.join()
        raise ChildError(child.exitcode) from None
    finally:
        child.terminate()
        child.join(ENDING_S)
        child.kill()
        child.join()
        receiver.close()
