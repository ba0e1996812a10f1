"""Worker processes that each hold the problems of a recording."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any

from vd.command.warp_quiet import quiet_warp
from vd.command.workers import begin_worker, end_worker

ProblemOf = Callable[[Any], Any]
"""The problem of a joint, by what specifies it."""
Call = Callable[[Any], Any]
"""What is asked of a problem; it is sent to another process."""

_problem_of: ProblemOf | None = None
"""Of a worker process."""


def _start(problem_of: ProblemOf, parent: int) -> None:
    global _problem_of
    begin_worker(parent)
    quiet_warp()
    _problem_of = problem_of


def _work(spec: Any, call: Call) -> Any:
    assert _problem_of is not None
    return call(_problem_of(spec))


class WorkerPool:
    """Runs calls in worker processes, or one by one with ``workers`` below 2.

    Args:
        problem_of: Where they have their problems from.
        workers: Processes.
    """

    def __init__(self, problem_of: ProblemOf, workers: int):
        self.problem_of = problem_of
        self.workers = workers
        self._lock = threading.Lock()
        self._processes: ProcessPoolExecutor | None = None

    def __enter__(self) -> "WorkerPool":
        if self.workers > 1:
            context = get_context("spawn")  # Warp and its threads may be running
            self._processes = ProcessPoolExecutor(
                self.workers,
                mp_context=context,
                initializer=_start,
                initargs=(self.problem_of, os.getpid()),
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._processes is not None:
            end_worker(self._processes)

    def run(self, spec: Any, calls: Sequence[Call]) -> list[Any]:
        """Results of the calls, in order. For several threads.

        Raises:
            ChildProcessError: A worker process was killed.
        """
        if self._processes is None:
            with self._lock:
                return [call(self.problem_of(spec)) for call in calls]
        try:
            waiting = [self._processes.submit(_work, spec, call) for call in calls]
            return [future.result() for future in waiting]
        except BrokenProcessPool as error:
            raise ChildProcessError(
                f"one of {self.workers} processes was killed, most often since memory ran out: "
                "free some, or give fewer processors (taskset), and run the same command again"
            ) from error


def parallel(work: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Results in order; threads, since the work waits for processes."""
    threads = ThreadPoolExecutor(max(len(items), 1))
    try:
        return list(threads.map(work, items))
    finally:
        # Nobody waits for the others after a failure or Ctrl-C: they end with the pool's processes.
        threads.shutdown(wait=False, cancel_futures=True)
