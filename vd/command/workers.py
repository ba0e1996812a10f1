"""Processes for many long tasks of unequal length.

One that hangs or dies costs its own task only.
"""

import os
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any
from unittest.mock import patch

from vd.command.interrupt import end_with_parent

SINGLE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Variables that keep the linear algebra of a worker to one thread; it reads them when it
starts.
"""
LONGEST_WAIT_S = 1.0
"""Between two looks at the clock [s]."""


def shard(tasks: Sequence[Any], part: str | None) -> list[Any]:
    """Every N-th of the tasks from the I-th on, counted from 0, for a ``part`` ``I/N``.

    All without.

    Raises:
        ValueError: It is no such part.
    """
    if part is None:
        return list(tasks)
    index, _, count = part.partition("/")
    if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
        raise ValueError(
            f"--shard is {part!r}; it has to be I/N, with I from 0 to N - 1, such as 0/8"
        )
    return list(tasks[int(index) :: int(count)])


def one_thread_without_gpu(device: str) -> None:
    """Keep torch to one thread where it computes on a CPU, unless OMP_NUM_THREADS says how many.

    A second thread gains networks as small as ours little. Where cores are shared it costs them up
    to tenfold: all threads wait for the one that has no core.
    """
    import torch

    if device == "cpu" and SINGLE[0] not in os.environ:
        torch.set_num_threads(1)


def run_tasks(
    work: Callable[[Any], Any],
    tasks: Sequence[Any],
    finished: Callable[[Any, Any, str], None],
    *,
    jobs: int,
    limit_s: float,
    gpu: bool = False,
    threads: int = 1,
) -> None:
    """Run ``work`` on every task in fresh processes, each with one thread of linear algebra.

    Args:
        work: Function that can be pickled.
        tasks: Its arguments.
        finished: Called with a task, its result and ``""``, or with None and what became of the
            task: it took longer than ``limit_s``, raised an error, or its process died.
        jobs: Processes.
        limit_s: Longest time of a task [s].
        gpu: Whether the workers may see a GPU; a context each would fill it.
        threads: OpenMP's threads of a worker.
    """
    waiting = deque(tasks)
    # A pool for each process: one that dies takes its pool along.
    idle = [_worker() for _ in range(min(jobs, len(tasks)))]
    running: dict[Future[Any], tuple[Any, ProcessPoolExecutor, float]] = {}
    try:
        inherited = dict.fromkeys(SINGLE, "1") | {SINGLE[0]: str(threads)}
        with patch.dict(os.environ, inherited if gpu else inherited | {"CUDA_VISIBLE_DEVICES": ""}):
            while waiting or running:
                while idle and waiting:
                    worker = idle.pop()
                    task = waiting.popleft()
                    running[worker.submit(work, task)] = task, worker, time.monotonic()
                wait(running, LONGEST_WAIT_S, FIRST_COMPLETED)
                for future, (task, worker, begun) in list(running.items()):
                    if future.done() or time.monotonic() - begun > limit_s:
                        del running[future]
                        idle.append(_end(future, task, worker, finished, limit_s))
    finally:
        for worker in (*idle, *(worker for _, worker, _ in running.values())):
            end_worker(worker)


def _worker() -> ProcessPoolExecutor:
    """One process, which starts with its first task."""
    context = get_context("spawn")  # Warp and a CUDA context do not survive a fork
    return ProcessPoolExecutor(
        1, mp_context=context, initializer=begin_worker, initargs=(os.getpid(),)
    )


def begin_worker(parent: int) -> None:
    """Have a process leave Ctrl-C to its parent, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(parent)


def _end(
    future: Future[Any],
    task: Any,
    worker: ProcessPoolExecutor,
    finished: Callable[[Any, Any, str], None],
    limit_s: float,
) -> ProcessPoolExecutor:
    """Tell what became of a task that is done or too slow.

    Returns the worker, or one in its place.
    """
    why = f"it took longer than {limit_s:.0f} s"
    if future.done():
        error = future.exception()
        if error is None:
            finished(task, future.result(), "")
            return worker
        why = f"{type(error).__name__}: {error}"
        if isinstance(error, BrokenProcessPool):
            why = "its process died: out of memory, or killed"
    end_worker(worker)
    finished(task, None, why)
    return _worker()


def end_worker(worker: ProcessPoolExecutor) -> None:
    """End the processes of a pool, whatever they do."""
    for process in list((worker._processes or {}).values()):
        process.kill()
    worker.shutdown(wait=False, cancel_futures=True)
