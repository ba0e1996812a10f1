"""The ways a run can be asked to end: Ctrl-C, SIGTERM and a deadline, agreed on by all its processes."""

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType

import torch

from vd import interrupt
from vd.train.distributed import ending_together


class Interrupted(Exception):  # noqa: N818  # not an error: the run was asked to stop and has saved
    """Ctrl-C or SIGTERM; the run is saved."""


class TrainingDivergedError(RuntimeError):
    """Observations, rewards, losses or parameters are no longer finite."""


class EndRequest:
    """Whether a run is to end before its last iteration.

    Args:
        deadline: ``time.monotonic()`` at which to save and end; ``None`` for no limit.
        device: Torch device of this process.
        distributed: Whether other processes have to agree.

    Attributes:
        signal: Number of the signal that asked for the end; 0 if none did.
    """

    def __init__(self, deadline: float | None, *, device: str, distributed: bool) -> None:
        self.signal = 0
        self._deadline, self._device, self._distributed = deadline, device, distributed
        self._started = time.monotonic()

    @contextlib.contextmanager
    def signals(self, note: Callable[[str], None]) -> Iterator[None]:
        """Turn Ctrl-C and SIGTERM into a request to stop; a second one stops at once, without saving."""
        self._started = time.monotonic()

        def request(number: int, _frame: FrameType | None) -> None:
            if self.signal:
                raise KeyboardInterrupt
            self.signal = number
            interrupt.note(number)
            note("stopping: saving a checkpoint (again to stop at once, without saving)")

        with interrupt.handled(request, signal.SIGINT, signal.SIGTERM):
            yield

    def due(self) -> bool:
        """Whether a signal or the deadline asks for the end; all processes agree."""
        late = self._deadline is not None and time.monotonic() >= self._deadline
        if not self._distributed:
            return bool(self.signal) or late
        wishes = torch.tensor([float(self.signal), float(late)], device=self._device)
        torch.distributed.all_reduce(wishes, op=torch.distributed.ReduceOp.MAX)
        self.signal = int(wishes[0])
        interrupt.note(self.signal)
        return bool(self.signal) or bool(wishes[1])

    def time_left(self, done: int, left: int) -> float | None:
        """Estimate from this command's own pace, and the deadline if that is nearer [s].

        Args:
            done: Iterations since the start of this command.
            left: Iterations to the end.
        """
        pace = (time.monotonic() - self._started) / max(done, 1)
        estimate = pace * left
        return estimate if self._deadline is None else min(estimate, self._deadline - time.monotonic())


def finished(learn: Callable[[], None], close: Callable[[], None], *, distributed: bool) -> bool:
    """Run a training to its end and close what it simulates.

    Args:
        learn: Trains; raises :class:`Interrupted` once a run that was asked to stop has saved.
        close: Releases the environments, however the training ends.
        distributed: Whether a failure must end the other processes as well.

    Returns:
        Whether it came to its own end, rather than being interrupted.
    """
    try:
        with ending_together(Interrupted) if distributed else contextlib.nullcontext():
            learn()
    except Interrupted:
        return False
    finally:
        close()
    return True
