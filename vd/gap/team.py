"""Worker processes that fit: each holds the recording and simulates joints on request."""

import multiprocessing
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import warp as wp

from vd.gap.fit import JointProblem
from vd.gap.jitter import fit_jitter
from vd.gap.recording import Recording
from vd.gap.rollout import Chain, Rollouts

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


class Bench:
    """The problems of a recording, made when they are first asked for."""

    def __init__(self, recording: Recording, chains: Sequence[Chain], dt: float, device: str):
        self.recording, self.chains, self.dt, self.device = recording, chains, dt, device
        self._rollouts: dict[tuple[int, int | None], Rollouts] = {}
        self._problems: dict[tuple[int, int], JointProblem] = {}

    def problem(self, spec: JointSpec) -> JointProblem:
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

    def call(self, spec: JointSpec, call: Call) -> tuple[Any, int]:
        """Run a method of the problem: its result, and the trajectories simulated."""
        problem = self.problem(spec)
        before = problem.simulated
        if call[0] == "fit_jitter":
            result = fit_jitter(problem, **call[1])
        else:
            result = getattr(problem, call[0])(**call[1])
        return result, problem.simulated - before


_bench: Bench | None = None
"""Of a worker process."""


def _start(bench: Bench) -> None:
    global _bench
    wp.config.log_level = wp.LOG_WARNING
    _bench = bench


def _work(spec: JointSpec, call: Call) -> tuple[Any, int]:
    assert _bench is not None
    return _bench.call(spec, call)


class Team:
    """Runs calls in worker processes, or in this one with ``workers`` below 2.

    Attributes:
        simulated: Trajectories simulated so far.
        busy_s: Time in which some call was running [s].
    """

    def __init__(self, bench: Bench, workers: int):
        self.bench, self.workers = bench, workers
        self.simulated = 0
        self._lock = threading.Lock()
        self._begun = time.perf_counter()
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Team":
        if self.workers > 1:
            # Not forked: Warp and its threads may be running.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(
                self.workers, mp_context=context, initializer=_start, initargs=(self.bench,)
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    @property
    def rate(self) -> float:
        """Simulated trajectories per second of wall time."""
        return self.simulated / max(time.perf_counter() - self._begun, 1e-9)

    def run(self, spec: JointSpec, calls: Sequence[Call]) -> list[Any]:
        """Results of the calls, in order. May be used from several threads."""
        if self._pool is None:
            with self._lock:
                answers = [self.bench.call(spec, call) for call in calls]
        else:
            waiting: list[Future] = [self._pool.submit(_work, spec, call) for call in calls]
            answers = [future.result() for future in waiting]
        with self._lock:
            self.simulated += sum(count for _, count in answers)
        return [result for result, _ in answers]
