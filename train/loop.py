"""The training loop of teachers, students and alignment.

Iterations, curves, checkpoints, and all ways to end.
"""

import contextlib
import math
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from vd.command import interrupt
from vd.policy.actor import CHECKPOINT_FORMAT
from vd.train.checkpoint import (
    CHECKPOINT_FOLDER,
    checkpoint_path,
    list_checkpoints,
    prune_checkpoints,
    random_state,
    save_checkpoint,
    saved_worlds,
    set_random_state,
)
from vd.train.config import RunCfg
from vd.train.distributed import ending_together, join_processes, watch_iteration
from vd.train.metrics import ProgressFile
from vd.train.progress import ProgressLines

if TYPE_CHECKING:
    from vd.train.vec_env import ReorientVecEnv


RESUME_HINT = "; --resume goes on from the last checkpoint"
"""What a run that is stopped at once says where it has a checkpoint."""


class Interrupted(Exception):  # noqa: N818  # not an error: the run was asked to stop and has saved
    """Ctrl-C or SIGTERM; the run is saved."""


class TrainingDivergedError(RuntimeError):
    """Observations, rewards, losses or parameters are no longer finite."""


def check_update(losses: Mapping[str, float], networks: nn.Module, remedy: str) -> None:
    """Stop when a loss, a gradient or a parameter is not finite; one wait for the device.

    Raises:
        TrainingDivergedError: It names what is not, and the remedy.
    """
    bad = [name for name, value in losses.items() if not math.isfinite(value)]
    # A sum is finite only if all its terms are.
    if not math.isfinite(
        float(torch.stack([p.detach().sum() for p in networks.parameters()]).sum())
    ):
        bad.append("parameters")
    if bad:
        raise TrainingDivergedError(f"{', '.join(bad)} not finite after the update; {remedy}")


class TrainingLoop:
    """Iterates until steps, time or the user end the run; goes on exactly where it stopped.

    Under ``torchrun`` every process simulates its own environments and gradients are averaged. The
    first process logs and saves, with the random and environment state of all. What an iteration
    does, and what a checkpoint holds of it, is in the subclasses.

    Args:
        run: Run settings.
        device: Torch device of networks and rollouts.
        env: Environments that checkpoints hold, if any.

    Attributes:
        iteration: Iterations completed, over all resumed runs.
        env_steps: Control steps (of others clouds) completed, over all environments and
            processes.
        new_episodes: Why the checkpoint that was loaded could not restore the environments; empty
            if it did.
    """

    def __init__(
        self,
        run: RunCfg,
        *,
        device: str,
        env: "ReorientVecEnv | None" = None,
    ) -> None:
        self.run = run
        self.device = device
        self.env = env
        self.rank, self.world_size = join_processes(device)
        self.iteration = 0
        self.env_steps = 0
        self._elapsed_s = 0.0
        self.new_episodes = ""
        self._deadline: float | None = None
        self._signal = 0

    @property
    def is_distributed(self) -> bool:
        """Whether there are other processes."""
        return self.world_size > 1

    @property
    def is_main(self) -> bool:
        """Whether this process logs and saves."""
        return self.rank == 0

    @property
    def steps_per_iteration(self) -> int:
        """Control steps of an iteration, all environments and processes together."""
        return self._samples() * self.world_size

    @property
    def total_iterations(self) -> int:
        """Iterations at the end of the run, those done included."""
        left = max(0, self.run.max_steps - self.env_steps)
        return self.iteration + math.ceil(left / self.steps_per_iteration)

    def learn(self, iterations: int | None = None) -> None:
        """Train until the steps, the time or the user end it, and save.

        Args:
            iterations: Iterations to do now; up to ``run.max_steps`` if ``None``.

        Raises:
            Interrupted: Ctrl-C or SIGTERM, after saving.
            TrainingDivergedError: Something is not finite any more. The last checkpoint is from
                before.
        """
        first = saved = self.iteration
        total = self.total_iterations if iterations is None else first + iterations
        self._begin()
        lines = ProgressLines(total, enabled=self.is_main)
        started = time.monotonic()
        with contextlib.ExitStack() as stack:
            log: ProgressFile | None = None
            if self.is_main:
                log = ProgressFile(self.run.out, self.run.logger, done=first)
                stack.callback(log.close)
            stack.enter_context(self._signals(lines))
            stack.enter_context(lines)
            while self.iteration < total and (row := self._row()) is not None:
                if self._deadline is None and self.run.max_minutes is not None:
                    self._deadline = time.monotonic() + 60.0 * self.run.max_minutes
                if log is not None:
                    log.write(row)
                pace = (time.monotonic() - started) / (self.iteration - first)
                lines.update(row, self._time_left(pace * (total - self.iteration)))
                if self.iteration % self.run.save_every == 0:
                    self.save()
                    saved = self.iteration
                if self._end_due():
                    break
            if saved < self.iteration or self.iteration == 0:
                self.save()
        if self._signal:
            raise Interrupted

    def save(self) -> None:
        """Write a checkpoint, whole or not at all, and the policy. Every process has to call it."""
        state = self._state()
        if not self.is_main:
            return
        path = checkpoint_path(self.run.out, self.iteration)
        save_checkpoint(path, state)
        self._save_policy(path, state)
        prune_checkpoints(self.run.out, self.iteration)

    def run_to_end(self) -> bool:
        """Train, and release everything.

        Whether it came to its own end, rather than being interrupted.
        """
        whole = True
        try:
            with ending_together(Interrupted) if self.is_distributed else contextlib.nullcontext():
                self.learn()
        except Interrupted:
            whole = False
        finally:
            self.close()
        self.shutdown()
        return whole

    def shutdown(self) -> None:
        """Leave the process group, so that torchrun ends without a warning.

        All processes have to call it, so not after an error of one: see
        :func:`vd.train.distributed.ending_together`.
        """
        if self.is_distributed:
            torch.distributed.destroy_process_group()

    def _row(self) -> dict[str, Any] | None:
        """One iteration.

        Its row for ``progress.jsonl``, or ``None`` if a signal cut its rollout short.
        """
        if self.is_distributed:
            watch_iteration()
        start = time.perf_counter()
        try:
            figures = self._iterate()
        except TrainingDivergedError as error:
            raise TrainingDivergedError(
                f"iteration {self.iteration + 1}: {error}. The last checkpoint in "
                f"{self.run.out / CHECKPOINT_FOLDER} is from before; go on from it with --resume"
            ) from error
        if figures is None:
            return None
        passed = time.perf_counter() - start
        self.iteration += 1
        self.env_steps += self.steps_per_iteration
        self._elapsed_s += passed
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "elapsed_s": round(self._elapsed_s, 3),
            "steps_per_s": self.steps_per_iteration / passed,
            **figures,
        }

    @contextlib.contextmanager
    def _signals(self, lines: ProgressLines) -> Iterator[None]:
        """Turn Ctrl-C and SIGTERM into a request to stop.

        A second one stops at once, without saving.
        """

        def request(number: int, _frame: FrameType | None) -> None:
            if self._signal:
                saved = list_checkpoints(self.run.out)
                raise KeyboardInterrupt(RESUME_HINT if saved else "")
            self._signal = number
            interrupt.note(number)
            lines.note("stopping: saving a checkpoint (again to stop at once, without saving)")

        with interrupt.handled(request, signal.SIGINT, signal.SIGTERM):
            yield

    def _end_due(self) -> bool:
        """Whether a signal or the deadline asks for the end; all processes agree."""
        late = self._time_left(math.inf) <= 0.0
        if self.is_distributed:
            wishes = torch.tensor([float(self._signal), float(late)], device=self.device)
            torch.distributed.all_reduce(wishes, op=torch.distributed.ReduceOp.MAX)
            self._signal = int(wishes[0])
            late = bool(wishes[1])
            interrupt.note(self._signal)
        return bool(self._signal) or late

    def _time_left(self, most: float) -> float:
        """Time to the deadline, at most ``most`` [s]."""
        return most if self._deadline is None else min(most, self._deadline - time.monotonic())

    def _stopping(self) -> bool:
        """Whether to cut a rollout short.

        Not with other processes, which all do the same collectives.
        """
        return bool(self._signal) and not self.is_distributed

    def _state(self) -> dict[str, Any]:
        """Everything a checkpoint holds."""
        mine = {"random": random_state(self.device)} | self._process_state()
        ranks: list[Any] = [mine]
        if self.is_distributed:
            ranks = [None] * self.world_size
            torch.distributed.all_gather_object(ranks, mine)
        return self._shared_state() | {
            "format": CHECKPOINT_FORMAT,
            "iter": self.iteration,
            "env_steps": self.env_steps,
            "elapsed_s": self._elapsed_s,
            "ranks": ranks,
        }

    def _restore(self, state: dict[str, Any]) -> None:
        """Take over counters, and environments and random state if they fit this run."""
        self.iteration = state["iter"]
        self.env_steps = state["env_steps"]
        self._elapsed_s = state["elapsed_s"]
        self.new_episodes = self._misfit(state["ranks"])
        if not self.new_episodes:
            mine = state["ranks"][self.rank]
            self._restore_process(mine)
            set_random_state(mine["random"], self.device)
        elif self.env is not None:
            self.env.start_anew(state["ranks"][0]["env"])

    def _misfit(self, ranks: list[dict[str, Any]]) -> str:
        """Why processes and environments of a checkpoint cannot be restored; empty if they can."""
        if len(ranks) != self.world_size:
            return f"the checkpoint is of {len(ranks)} processes, this run has {self.world_size}"
        if self.env is None or (saved := set(map(saved_worlds, ranks))) == {self.env.num_envs}:
            return ""
        if saved == {0}:
            return "the checkpoint holds no environments"
        theirs = f"{max(saved)} environments a process"
        return f"the checkpoint is of {theirs}, this run has {self.env.num_envs}"

    # What a subclass does.

    def _samples(self) -> int:
        """Control steps of an iteration in this process."""
        raise NotImplementedError

    def _begin(self) -> None:
        """Before the first iteration: all processes get the networks of the first."""
        raise NotImplementedError

    def _iterate(self) -> dict[str, Any] | None:
        """One rollout and update; its figures, or ``None`` if :meth:`_stopping` cut it short."""
        raise NotImplementedError

    def _shared_state(self) -> dict[str, Any]:
        """What all processes have alike."""
        raise NotImplementedError

    def _process_state(self) -> dict[str, Any]:
        """What this process alone has, beside its random state."""
        return {} if self.env is None else {"env": self.env.env.state_dict()}

    def _restore_process(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`_process_state` gave."""
        if self.env is not None:
            self.env.env.load_state_dict(state["env"])

    def close(self) -> None:
        """Release the environments."""

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        """Write what is used of a checkpoint that was saved as ``path``."""
        raise NotImplementedError
