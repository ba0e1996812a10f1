"""Worker processes that each hold the problems of a recording.

Each has a pipe of its own, and nothing is shared: one that dies, or is killed, leaves no lock that
another or its parent could wait for.
"""

import os
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from typing import Any

from vd.command.warp_quiet import quiet_warp
from vd.command.workers import begin_worker

ProblemOf = Callable[[Any], Any]
"""The problem of a joint, by what specifies it."""
Call = Callable[[Any], Any]
"""What is asked of a problem; it is sent to another process."""


def _serve(connection: Connection, problem_of: ProblemOf, parent: int) -> None:
    """Answer calls until the parent is gone."""
    begin_worker(parent)
    quiet_warp()
    while True:
        try:
            spec, call = connection.recv()
        except EOFError:
            return
        try:
            answer = (True, call(problem_of(spec)))
        except Exception as error:  # the parent raises it
            answer = (False, error)
        connection.send(answer)


class WorkerPool:
    """Runs calls in worker processes, or one by one with ``workers`` below 2.

    Args:
        problem_of: Where they have their problems from.
        workers: Processes.
    """

    def __init__(self, problem_of: ProblemOf, workers: int):
        self.problem_of = problem_of
        self.workers = workers
        self._processes: list[Any] = []
        self._connections: list[Connection] = []

    def __enter__(self) -> "WorkerPool":
        if self.workers > 1:
            context = get_context("spawn")  # Warp and its threads may be running
            for _ in range(self.workers):
                connection, far = context.Pipe()
                arguments = (far, self.problem_of, os.getpid())
                process = context.Process(target=_serve, args=arguments, daemon=True)
                process.start()
                far.close()
                self._processes.append(process)
                self._connections.append(connection)
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()

    def run(self, spec: Any, calls: Sequence[Call]) -> list[Any]:
        """Results of the calls, in order.

        Args:
            spec: What specifies the problem.
            calls: What is asked of it.

        Raises:
            ChildProcessError: A worker process was killed.
        """
        if not self._connections:
            return [call(self.problem_of(spec)) for call in calls]
        results: list[Any] = [None] * len(calls)
        waiting = deque(range(len(calls)))
        idle: list[Any] = [*self._connections]
        running: dict[Any, int] = {}
        while waiting or running:
            while waiting and idle:
                connection = idle.pop()
                running[connection] = waiting.popleft()
                self._send(connection, (spec, calls[running[connection]]))
            for ready in wait(list(running)):
                results[running.pop(ready)] = self._answer(ready)
                idle.append(ready)
        return results

    def _send(self, connection: Connection, call: Any) -> None:
        try:
            connection.send(call)
        except OSError as error:
            raise self._killed() from error

    def _answer(self, connection: Any) -> Any:
        try:
            succeeded, result = connection.recv()
        except (EOFError, OSError) as error:
            raise self._killed() from error
        if not succeeded:
            raise result
        return result

    def _killed(self) -> ChildProcessError:
        return ChildProcessError(
            f"one of {self.workers} processes was killed, most often since memory ran out: "
            "free some, or give fewer processors (taskset), and run the same command again"
        )
