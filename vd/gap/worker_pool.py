"""Who fits: worker processes that each hold the recording, or on a GPU threads that simulate together."""

import copy
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import Any

from vd.gap.chain import Chain
from vd.gap.fit import JointProblem
from vd.gap.fit_cache import FitCache, digest_of
from vd.gap.jitter import CALLS
from vd.gap.launch_batch import LaunchBatch
from vd.gap.recording import Recording
from vd.gap.rollout import Rollouts
from vd.interrupt import end_with_parent
from vd.warp_quiet import quiet_warp

Call = tuple[str, dict[str, Any]]
SHORT_S = 0.1
"""Kinds of calls that took less in all are not worth a word."""
THREADS = 128
"""Calls side by side on a GPU: more than the candidates of all joints of a hand."""


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


@dataclass(frozen=True, eq=False)
class Made:
    """What a call returned, how many trajectories it simulated, and how long it took [s]."""

    result: Any
    simulated: int
    seconds: float


class Problems:
    """The problems of a recording, made when they are first asked for.

    Args:
        recording: The recording.
        chains: Its chains.
        dt: Time step of the rollouts [s].
        device: Warp device.
        batch: Threads whose simulations are made together.
    """

    def __init__(
        self,
        recording: Recording,
        chains: Sequence[Chain],
        dt: float,
        device: str,
        batch: LaunchBatch | None = None,
    ):
        self.recording, self.chains, self.dt, self.device = recording, chains, dt, device
        self.batch = batch
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
                self._rollouts[shared] = Rollouts(
                    chain, recording, dt=self.dt, device=self.device, batch=self.batch
                )
            self._problems[key] = JointProblem(
                self._rollouts[shared],
                spec.joint,
                spec.trajectories,
                spec.folds,
                spec.floor,
                spec.baseline,
            )
        return self._problems[key]

    def call(self, spec: JointSpec, call: Call) -> Made:
        """Run a method of the problem, its samples weighted if its arguments say how."""
        name, options = call[0], dict(call[1])
        weighting, problem = options.pop("weighting", None), self.of(spec)
        # Calls side by side count, and change the time step.
        problem = copy.copy(problem) if weighting is None else problem.weighted(weighting)
        problem.simulated, begin = 0, time.perf_counter()
        method = partial(CALLS[name], problem) if name in CALLS else getattr(problem, name)
        result = method(**options)
        return Made(result, problem.simulated, time.perf_counter() - begin)


_problems: Problems | None = None
"""Of a worker process."""


def _start(problems: Problems, parent: int) -> None:
    global _problems
    end_with_parent(parent)
    quiet_warp()
    _problems = problems


def _work(spec: JointSpec, call: Call) -> Made:
    assert _problems is not None
    return _problems.call(spec, call)


class WorkerPool:
    """Runs calls in worker processes, on a GPU in threads, or one by one with ``workers`` below 2.

    Args:
        problems: The problems.
        workers: Processes.
        cache: Results of calls that were made before, and where new ones go.

    Attributes:
        simulated: Trajectories simulated so far.
        spent: Trajectories simulated and time taken [s], summed over workers, by kind of call.
    """

    def __init__(self, problems: Problems, workers: int, cache: FitCache | None = None):
        self.problems, self.workers = problems, workers
        self.cache = FitCache() if cache is None else cache
        self.simulated = 0
        self.spent: dict[str, tuple[int, float]] = {}
        self._lock = threading.Lock()
        self._executor: Executor | None = None

    def __enter__(self) -> "WorkerPool":
        if self.problems.batch is not None:
            self._executor = ThreadPoolExecutor(THREADS)
        elif self.workers > 1:
            # Not forked: Warp and its threads may be running.
            context = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(
                self.workers, mp_context=context, initializer=_start, initargs=(self.problems, os.getpid())
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)

    @property
    def summary(self) -> str:
        """Where the time went, in words."""
        parts = sorted(self.spent.items(), key=lambda item: -item[1][1])
        times = [f"{name} {seconds:.1f} s ({rolls})" for name, (rolls, seconds) in parts if seconds > SHORT_S]
        summed = f"; summed over workers: {', '.join(times)}" if times else ""
        return f"{self.simulated} motions simulated{summed}"

    def run(self, spec: JointSpec, calls: Sequence[Call]) -> list[Any]:
        """Results of the calls, in order; of a call that was made before, the same. For several threads."""
        # Searches that meet ask for the same fits.
        keys = [digest_of(spec.chain, spec.joint, call) for call in calls]
        with self._lock:
            new = {key: call for key, call in zip(keys, calls, strict=True) if key not in self.cache}
        made = dict(zip(new, self._made(spec, list(new.values())), strict=True))
        with self._lock:
            for key, one in made.items():
                name = new[key][0]
                rollouts, seconds = self.spent.get(name, (0, 0.0))
                self.spent[name] = rollouts + one.simulated, seconds + one.seconds
                self.simulated += one.simulated
                self.cache.add(key, one.result)
            return [self.cache[key] for key in keys]

    def _made(self, spec: JointSpec, calls: Sequence[Call]) -> list[Made]:
        """Run calls.

        Raises:
            ChildProcessError: A worker process was killed.
        """
        if self._executor is None:
            with self._lock:
                return [self.problems.call(spec, call) for call in calls]
        batch = self.problems.batch
        if batch is not None:
            with self._lock:
                self.problems.of(spec)  # made once, before threads ask for it
            batch.join(len(calls))
        work = _work if batch is None else self._together
        try:
            waiting: list[Future] = [self._executor.submit(work, spec, call) for call in calls]
            return [future.result() for future in waiting]
        except BrokenProcessPool as error:
            raise ChildProcessError(
                f"one of {self.workers} processes was killed, most often since memory ran out: free some, or "
                "give fewer processors (taskset), and run the same command again, which goes on with its step"
            ) from error

    def _together(self, spec: JointSpec, call: Call) -> Made:
        """Run a call in one of the threads that simulate together."""
        assert self.problems.batch is not None
        try:
            return self.problems.call(spec, call)
        finally:
            self.problems.batch.leave()


def parallel(work: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Results in order; threads, since the work waits for processes."""
    threads = ThreadPoolExecutor(max(len(items), 1))
    try:
        return list(threads.map(work, items))
    finally:
        # Nobody waits for the others after a failure or Ctrl-C: they end with the pool's processes.
        threads.shutdown(wait=False, cancel_futures=True)
