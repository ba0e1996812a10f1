"""The ways a run ends: Ctrl-C, SIGTERM, a deadline that all processes agree on, and divergence."""

import contextlib
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from types import FrameType

import torch
from torch import nn

from vd import interrupt


class Interrupted(Exception):  # noqa: N818  # not an error: the run was asked to stop and has saved
    """Ctrl-C or SIGTERM; the run is saved."""


class TrainingDivergedError(RuntimeError):
    """Observations, rewards, losses or parameters are no longer finite."""


def check_update(losses: Mapping[str, float | None], networks: nn.Module, remedy: str) -> None:
    """Stop when a loss, a gradient or a parameter is not finite; one wait for the device.

    Raises:
        TrainingDivergedError: It names what is not, and the remedy.
    """
    bad = [name for name, value in losses.items() if value is None or not math.isfinite(value)]
    # A sum is finite only if all its terms are.
    if not math.isfinite(float(torch.stack([p.detach().sum() for p in networks.parameters()]).sum())):
        bad.append("parameters")
    if bad:
        raise TrainingDivergedError(f"{', '.join(bad)} not finite after the update; {remedy}")


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

    def time_left(self, done: int, left: int) -> float:
        """Time for ``left`` iterations at the pace of the ``done``, at most to the deadline [s]."""
        estimate = (time.monotonic() - self._started) / max(done, 1) * left
        return estimate if self._deadline is None else min(estimate, self._deadline - time.monotonic())
