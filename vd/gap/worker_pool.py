"""Who fits: worker processes that each hold the recording."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any

from vd.gap.chain import Chain
from vd.gap.fit import JointProblem
from vd.gap.jitter import CALLS
from vd.gap.recording import Recording
from vd.gap.rollout import Rollouts
from vd.warp_quiet import quiet_warp
from vd.workers import begin_worker, end_worker

Call = tuple[str, dict[str, Any]]


@dataclass(frozen=True, eq=False)
class JointSpec:
    """What makes the problem of one joint.

    Attributes:
        chain: Index of the chain.
        joint: Index of the joint in the chain.
        trajectories: Indices of the trajectories used.
        folds: Fold of each.
        floor: Noise floor [rad].
        baseline: Keys of the fitted baseline parameters.
        pieces: Samples ``(first, end)`` of each trajectory that are analysed; empty: all.
    """

    chain: int
    joint: int
    trajectories: tuple[int, ...]
    folds: tuple[int, ...]
    floor: float
    baseline: tuple[str, ...]
    pieces: tuple[tuple[int, int], ...] = ()


class Problems:
    """The problems of a recording, made when they are first asked for.

    Args:
        recording: The recording.
        chains: Its chains.
        dt: Time step of the rollouts [s].
        device: Warp device.
    """

    def __init__(self, recording: Recording, chains: Sequence[Chain], dt: float, device: str):
        self.recording, self.chains, self.dt, self.device = recording, chains, dt, device
        self._rollouts: dict[tuple[int, int | None], Rollouts] = {}
        self._problems: dict[tuple[int, int], JointProblem] = {}

    def of(self, spec: JointSpec) -> JointProblem:
        """The problem of a joint."""
        key = spec.chain, spec.joint
        if key not in self._problems:
            # Whole trajectories are shared by the joints of a chain, pieces are each joint's own.
            shared = spec.chain, None if not spec.pieces else spec.joint
            if shared not in self._rollouts:
                parts = dict(zip(spec.trajectories, spec.pieces, strict=bool(spec.pieces)))
                recording, chain = self.recording.cut(parts), self.chains[spec.chain]
                self._rollouts[shared] = Rollouts(chain, recording, dt=self.dt, device=self.device)
            self._problems[key] = JointProblem(
                self._rollouts[shared],
                spec.joint,
                spec.trajectories,
                spec.folds,
                spec.floor,
                spec.baseline,
            )
        return self._problems[key]

    def call(self, spec: JointSpec, call: Call) -> Any:
        """The result of a method of the problem, its samples weighted if its arguments say how."""
        name, options = call[0], dict(call[1])
        weighting, problem = options.pop("weighting", None), self.of(spec)
        problem = problem if weighting is None else problem.weighted(weighting)
        method = partial(CALLS[name], problem) if name in CALLS else getattr(problem, name)
        return method(**options)


_problems: Problems | None = None
"""Of a worker process."""


def _start(problems: Problems, parent: int) -> None:
    global _problems
    begin_worker(parent)
    quiet_warp()
    _problems = problems


def _work(spec: JointSpec, call: Call) -> Any:
    assert _problems is not None
    return _problems.call(spec, call)


class WorkerPool:
    """Runs calls in worker processes, or one by one with ``workers`` below 2.

    Args:
        problems: The problems.
        workers: Processes.
    """

    def __init__(self, problems: Problems, workers: int):
        self.problems, self.workers = problems, workers
        self._lock = threading.Lock()
        self._processes: ProcessPoolExecutor | None = None

    def __enter__(self) -> "WorkerPool":
        if self.workers > 1:
            context = get_context("spawn")  # Warp and its threads may be running
            self._processes = ProcessPoolExecutor(
                self.workers,
                mp_context=context,
                initializer=_start,
                initargs=(self.problems, os.getpid()),
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._processes is not None:
            end_worker(self._processes)

    def run(self, spec: JointSpec, calls: Sequence[Call]) -> list[Any]:
        """Results of the calls, in order. For several threads.

        Raises:
            ChildProcessError: A worker process was killed.
        """
        if self._processes is None:
            with self._lock:
                return [self.problems.call(spec, call) for call in calls]
        try:
            waiting = [self._processes.submit(_work, spec, call) for call in calls]
            return [future.result() for future in waiting]
        except BrokenProcessPool as error:
            raise ChildProcessError(
                f"one of {self.workers} processes was killed, most often since memory ran out: "
                f"free "
                "some, or give fewer processors (taskset), and run the same command again"
            ) from error


def parallel(work: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Results in order; threads, since the work waits for processes."""
    threads = ThreadPoolExecutor(max(len(items), 1))
    try:
        return list(threads.map(work, items))
    finally:
        # Nobody waits for the others after a failure or Ctrl-C: they end with the pool's processes.
        threads.shutdown(wait=False, cancel_futures=True)
