"""Processes for many long tasks of unequal length: one that hangs or dies costs its own task only."""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection, get_context
from typing import Any

from vd.interrupt import end_with_parent

SINGLE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Variables that keep the linear algebra of a worker to one thread; it reads them when it starts."""
LONGEST_WAIT_S = 1.0
"""Between two looks at the clock [s]."""
GRACE_S = 5.0
"""Time for an idle worker to end by itself [s]."""


def one_thread_without_gpu(device: str) -> None:
    """Keep torch to one thread where it computes on a CPU, unless OMP_NUM_THREADS says how many.

    A second thread gains networks as small as ours little. Where cores are shared it costs them up to
    tenfold: all threads wait for the one that has no core.
    """
    import torch

    if device == "cpu" and SINGLE[0] not in os.environ:
        torch.set_num_threads(1)


@dataclass
class _Worker:
    process: Any
    pipe: connection.Connection
    task: int = -1
    begun: float = 0.0


def run_tasks(
    work: Callable[[Any], Any],
    tasks: Sequence[Any],
    finished: Callable[[Any, Any, str], None],
    *,
    jobs: int,
    limit_s: float,
    stop_after_s: float = float("inf"),
    gpu: bool = False,
) -> int:
    """Run ``work`` on every task in fresh processes, each with one thread of linear algebra.

    Args:
        work: Function that can be pickled; it should not raise.
        tasks: Its arguments.
        finished: Called with a task, its result and ``""``, or with None and what became of the task:
            it took longer than ``limit_s``, or its process died.
        jobs: Processes.
        limit_s: Longest time of a task [s].
        stop_after_s: Time [s] after which all ends; tasks that run then are as if never begun.
        gpu: Whether the workers may see a GPU; a context each would fill it.

    Returns:
        The tasks left over.
    """
    end = time.monotonic() + stop_after_s
    pool = _Pool(work, tasks, finished, limit_s)
    try:
        with _environment(gpu):
            for _ in range(min(jobs, len(tasks))):
                pool.start()
            while pool.busy and time.monotonic() < end:
                pool.look()
        return len(pool.waiting) + len(pool.busy)
    finally:
        pool.stop()


class _Pool:
    """The workers of :func:`run_tasks`, whose arguments it takes, and the tasks that wait for them."""

    def __init__(
        self,
        work: Callable[[Any], Any],
        tasks: Sequence[Any],
        finished: Callable[[Any, Any, str], None],
        limit_s: float,
    ):
        self.waiting = deque(range(len(tasks)))
        self._work, self._tasks, self._finished, self._limit_s = work, tasks, finished, limit_s
        self._workers: list[_Worker] = []
        self._context = get_context("spawn")  # Warp and a CUDA context do not survive a fork

    @property
    def busy(self) -> list[_Worker]:
        """Workers that have a task."""
        return [worker for worker in self._workers if worker.task >= 0]

    def start(self) -> None:
        """Start a worker and give it a task."""
        mine, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(self._work, theirs, os.getpid()), daemon=True)
        process.start()
        theirs.close()
        self._workers.append(_Worker(process, mine))
        self._give(self._workers[-1])

    def look(self) -> None:
        """Wait for workers that have finished or died, at most ``LONGEST_WAIT_S``, and for those too slow."""
        busy = self.busy
        ready = connection.wait([worker.pipe for worker in busy], LONGEST_WAIT_S)
        for worker in busy:
            if worker.pipe in ready:
                self._receive(worker)
            elif time.monotonic() - worker.begun > self._limit_s:
                self._replace(worker, f"it took longer than {self._limit_s:.0f} s")

    def stop(self) -> None:
        """End all workers, those at work at once."""
        for worker in self.busy:
            worker.process.kill()
        for worker in self._workers:
            worker.pipe.close()  # an idle worker ends when it sees this
        for worker in self._workers:
            worker.process.join(GRACE_S)
            if worker.process.is_alive():
                worker.process.kill()

    def _give(self, worker: _Worker) -> None:
        worker.task, worker.begun = self.waiting.popleft(), time.monotonic()
        worker.pipe.send(self._tasks[worker.task])

    def _receive(self, worker: _Worker) -> None:
        try:
            result = worker.pipe.recv()
        except (EOFError, OSError):
            self._replace(worker, "its process died: out of memory, or killed")
            return
        self._finished(self._tasks[worker.task], result, "")
        worker.task = -1
        if self.waiting:
            self._give(worker)

    def _replace(self, worker: _Worker, why: str) -> None:
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()
        self._workers.remove(worker)
        self._finished(self._tasks[worker.task], None, why)
        if self.waiting:
            self.start()


def _serve(work: Callable[[Any], Any], pipe: connection.Connection, parent: int) -> None:
    """A worker: tasks in, results out, until the other end closes."""
    end_with_parent(parent)
    try:
        while True:
            pipe.send(work(pipe.recv()))
    except (EOFError, OSError, KeyboardInterrupt):
        return


@contextmanager
def _environment(gpu: bool) -> Iterator[None]:
    """What processes started meanwhile inherit."""
    change = dict.fromkeys(SINGLE, "1")
    if not gpu:
        change["CUDA_VISIBLE_DEVICES"] = ""
    before = {name: os.environ.get(name) for name in change}
    os.environ.update(change)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
