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
    waiting, end = deque(range(len(tasks))), time.monotonic() + stop_after_s
    workers: list[_Worker] = []
    context = get_context("spawn")  # Warp and a CUDA context do not survive a fork

    def start() -> _Worker:
        mine, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(work, theirs, os.getpid()), daemon=True)
        process.start()
        theirs.close()
        return _Worker(process, mine)

    def give(worker: _Worker) -> None:
        worker.task, worker.begun = waiting.popleft(), time.monotonic()
        worker.pipe.send(tasks[worker.task])

    def replace(worker: _Worker, why: str) -> None:
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()
        workers.remove(worker)
        finished(tasks[worker.task], None, why)
        if waiting:
            workers.append(start())
            give(workers[-1])

    try:
        with _environment(gpu):
            for _ in range(min(jobs, len(tasks))):
                workers.append(start())
                give(workers[-1])
            while any(worker.task >= 0 for worker in workers) and time.monotonic() < end:
                busy = [worker for worker in workers if worker.task >= 0]
                ready = connection.wait([worker.pipe for worker in busy], LONGEST_WAIT_S)
                for worker in busy:
                    if worker.pipe in ready:
                        try:
                            result = worker.pipe.recv()
                        except (EOFError, OSError):
                            replace(worker, "its process died: out of memory, or killed")
                            continue
                        finished(tasks[worker.task], result, "")
                        worker.task = -1
                        if waiting:
                            give(worker)
                    elif time.monotonic() - worker.begun > limit_s:
                        replace(worker, f"it took longer than {limit_s:.0f} s")
        return len(waiting) + sum(worker.task >= 0 for worker in workers)
    finally:
        for worker in workers:
            if worker.task >= 0:
                worker.process.kill()
            worker.pipe.close()  # an idle worker ends when it sees this
        for worker in workers:
            worker.process.join(GRACE_S)
            if worker.process.is_alive():
                worker.process.kill()


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
