"""Threads that simulate together: what all of them wait for goes through one launch.

A rollout on a GPU takes as long as its time steps, one after the other, and thousands take no longer than
one. So fits that run side by side wait for each other at every simulation: one launch for the perturbed
parameters of every candidate, start, fold and joint.
"""

import threading
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np


class Rollouts(Protocol):
    """What makes several calls in one launch (:class:`vd.gap.rollout.Rollouts`)."""

    def simulate(self, calls: Sequence[Any]) -> list[np.ndarray]:
        """Their results, in order."""
        ...


class _Waiting:
    """A call that waits for its result."""

    def __init__(self, rollouts: Rollouts, call: Any):
        self.rollouts, self.call = rollouts, call
        self.result: np.ndarray | Exception | None = None


class LaunchBatch:
    """Threads whose calls are simulated together once all that are at work wait for one."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._working = 0
        self._waiting: list[_Waiting] = []

    def join(self, threads: int) -> None:
        """Threads are about to start, and the others wait for them at every simulation."""
        with self._condition:
            self._working += threads

    def leave(self) -> None:
        """One of them has finished."""
        with self._condition:
            self._working -= 1
            self._launch_if_all_wait()

    def simulate(self, rollouts: Rollouts, call: Any) -> np.ndarray:
        """The result of a call, once the others that are at work have made theirs.

        Raises:
            Exception: Whatever the launch raised.
        """
        own = _Waiting(rollouts, call)
        with self._condition:
            self._waiting.append(own)
            self._launch_if_all_wait()
            while own.result is None:
                self._condition.wait()
        if isinstance(own.result, Exception):
            raise own.result
        return own.result

    def _launch_if_all_wait(self) -> None:
        if not self._waiting or len(self._waiting) < self._working:
            return
        groups: dict[int, list[_Waiting]] = {}
        for each in self._waiting:
            groups.setdefault(id(each.rollouts), []).append(each)
        self._waiting = []
        for group in groups.values():
            try:
                results: list[np.ndarray | Exception] = list(
                    group[0].rollouts.simulate([each.call for each in group])
                )
            except Exception as error:  # each of those who wait has to hear of it
                results = [error] * len(group)
            for each, result in zip(group, results, strict=True):
                each.result = result
        self._condition.notify_all()
