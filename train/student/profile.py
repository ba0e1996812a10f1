"""Where the time of an iteration goes: ``vd-train profile``."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import torch

from vd.train.student import dagger as loop
from vd.train.student.dagger import Dagger


class PartTimes:
    """Wall time [s] of parts of a program, each without the parts that run inside of it.

    The device is waited for at both ends of a part, so that its work is counted where it was asked for: the
    whole is slower than without.

    Attributes:
        seconds: Time of each part, by its name after that of the outermost part around it.
    """

    def __init__(self, device: torch.device) -> None:
        self.seconds: dict[str, float] = {}
        self._device = device
        self._around: list[str] = []
        self._inside: list[float] = []

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, whose calls count for part ``name``."""

        def call(*arguments: Any, **options: Any) -> Any:
            start = self._now()
            self._around.append(name)
            self._inside.append(0.0)
            try:
                return function(*arguments, **options)
            finally:
                passed = self._now() - start
                key = name if len(self._around) == 1 else f"{self._around[0]}: {name}"
                self._around.pop()
                self.seconds[key] = self.seconds.get(key, 0.0) + passed - self._inside.pop()
                if self._inside:
                    self._inside[-1] += passed

        return call

    def _now(self) -> float:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()


def profile_iteration(dagger: Dagger, *, warm_up: int = 1) -> dict[str, float]:
    """Times of the parts of one iteration of imitation [s], the largest first.

    Args:
        dagger: The learner; it learns meanwhile.
        warm_up: Iterations before, in which kernels are compiled and memory is taken.
    """
    for _ in range(warm_up):
        dagger.iterate(lambda: False)
    times, view, env = PartTimes(dagger.device), dagger.view, dagger.env
    parts = [
        (env, "step", "simulation"),
        (dagger, "_label", "teacher"),
        (view, "frame", "frames, depth images"),
        (view, "_sense", "finding the object"),
        (view, "sites", "clouds"),
        (view, "_voxelise", "voxels"),
        (loop, "taken", "gathering of sequences"),
        (dagger, "_look", "maps, encoder"),
        (dagger.student.turn, "forward", "learned rotation"),
        (dagger, "_run", "memory, heads"),
        (dagger.optimizer, "step", "optimiser"),
        (torch.Tensor, "backward", "backward"),
        (loop, "descend", "norm of the gradient"),
        (dagger, "collect", "acting"),
        (dagger, "update", "learning"),
        (dagger, "validate", "validation"),
    ]
    with ExitStack() as stack:
        for owner, name, part in parts:
            if getattr(owner, name, None) is not None:
                stack.enter_context(patch.object(owner, name, times.timed(part, getattr(owner, name))))
        dagger.iterate(lambda: False)
    return dict(sorted(times.seconds.items(), key=lambda item: -item[1]))
