"""The loop around a learner of the student: curves, checkpoints, and every way a run can end or go on."""

import contextlib
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from vd.config import to_dict
from vd.train.checkpoint import (
    CHECKPOINT_FOLDER,
    checkpoint_path,
    load_checkpoint,
    prune_checkpoints,
    random_state,
    save_checkpoint,
    set_random_state,
)
from vd.train.config import RunCfg
from vd.train.distributed import Processes, watch_iteration
from vd.train.ending import EndRequest, Interrupted, TrainingDivergedError
from vd.train.metrics import ProgressFile
from vd.train.progress import ProgressLine, format_duration, format_steps
from vd.train.student.config import STUDENT_NAME
from vd.vision.network import Student
from vd.vision.saved import StudentSpec, student_export


class Learner(Protocol):
    """What improves a student: imitation (:class:`vd.train.student.dagger.Dagger`) or pre-training."""

    student: Student
    network: torch.nn.Module
    """All that it trains: the student, and heads of the training alone."""
    samples_per_iteration: int

    def iterate(self, stopping: Callable[[], bool]) -> dict[str, float | None] | None:
        """One iteration; its figures, or ``None`` if it was given up because ``stopping`` said so."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """What all processes share besides the network."""
        ...

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Restore it."""
        ...

    def local_state(self) -> dict[str, Any]:
        """What belongs to this process alone."""
        ...

    def load_local_state(self, state: dict[str, Any]) -> None:
        """Restore it."""
        ...

    def fits(self, ranks: list[dict[str, Any]]) -> str:
        """Why the local states of a checkpoint cannot be restored; empty if they can."""
        ...

    def close(self) -> None:
        """Release what it holds."""
        ...


class StudentRunner:
    """Runs a learner until steps, time or the user end it; resumes exactly where it stopped.

    Under ``torchrun`` every process has its own environments; gradients are averaged, and the first process
    logs and saves, with the random and world state of all. The latest student is the one that is kept:
    imitation learns from ever new rollouts and does not overfit one, and its success rate is too noisy to
    choose by.

    Args:
        learner: What to run.
        run: Run settings.
        spec: Description of the student, kept with it.
        task: The environment's configuration as a dictionary, kept with it.
        depth: The depth camera's configuration as a dictionary, kept with it.
        device: Torch device.
        processes: Place of this process in the run.
        deadline: ``time.monotonic()`` at which to save and end; ``None`` for no limit.

    Attributes:
        iteration: Iterations completed, over all resumed runs.
        env_steps: Control steps (clouds in stage 0) completed, over all environments and processes.
        new_episodes: Why the checkpoint could not restore the environments; empty if it did.
        damaged: Newer checkpoints than the one that was loaded, and what is wrong with them.
    """

    def __init__(
        self,
        learner: Learner,
        run: RunCfg,
        *,
        spec: StudentSpec,
        task: dict[str, Any],
        depth: dict[str, Any],
        device: str,
        processes: Processes | None = None,
        deadline: float | None = None,
    ) -> None:
        self.learner, self.run, self.device = learner, run, device
        self.spec, self.task, self.depth = spec, task, depth
        self.processes = processes or Processes(0, 0, 1)
        self.iteration, self.env_steps, self.elapsed_s = 0, 0, 0.0
        self.new_episodes = ""
        self.damaged: dict[Path, str] = {}
        self._end = EndRequest(deadline, device=device, distributed=self.is_distributed)

    @property
    def is_distributed(self) -> bool:
        """Whether there are other processes."""
        return self.processes.world_size > 1

    @property
    def is_main(self) -> bool:
        """Whether this process logs and saves."""
        return self.processes.rank == 0

    @property
    def total_iterations(self) -> int:
        """Iterations at the end of the run, those done included."""
        left = max(0, self.run.max_steps - self.env_steps)
        return self.iteration + math.ceil(left / self._steps_per_iteration)

    @property
    def _steps_per_iteration(self) -> int:
        return self.learner.samples_per_iteration * self.processes.world_size

    def learn(self, iterations: int | None = None) -> None:
        """Train until the steps, the time or the user end it, and save.

        Args:
            iterations: Iterations to do now; up to ``run.max_steps`` if ``None``.

        Raises:
            Interrupted: Ctrl-C or SIGTERM, after saving.
            TrainingDivergedError: Something is not finite any more. The last checkpoint is from before.
        """
        first = self.iteration
        total = self.total_iterations if iterations is None else first + iterations
        if self.is_distributed:
            for value in self.learner.network.state_dict().values():
                torch.distributed.broadcast(value, 0)
        progress = ProgressLine(total, done=first, enabled=self.is_main, summary=summary, details=details)
        saved = -1
        with contextlib.ExitStack() as stack:
            log: ProgressFile | None = None
            if self.is_main:
                log = ProgressFile(self.run.out, tensorboard=self.run.tensorboard, done=first)
                stack.callback(log.close)
            stack.enter_context(self._end.signals(progress.note))
            stack.enter_context(progress)
            while self.iteration < total and (row := self._iterate()) is not None:
                if log is not None:
                    log.write(row)
                progress.update(row, self._end.time_left(self.iteration - first, total - self.iteration))
                if self.iteration % self.run.save_every == 0:
                    self.save()
                    saved = self.iteration
                if self._end.due():
                    break
            if saved != self.iteration:
                self.save()
        if self._end.signal:
            raise Interrupted

    def save(self) -> None:
        """Write a checkpoint and the student, each whole or not at all. Every process has to call it."""
        state = self._state()
        if not self.is_main:
            return
        folder = self.run.out
        save_checkpoint(checkpoint_path(folder, self.iteration), state)
        save_checkpoint(folder / STUDENT_NAME, student_export(state))
        prune_checkpoints(folder, self.iteration, self.run.keep_every)

    def load(self, path: Path) -> None:
        """Go on from a checkpoint: exactly, with its processes and environments; else with new episodes.

        Args:
            path: The checkpoint.

        Raises:
            ValueError: The file is damaged, or of another network.
        """
        state = load_checkpoint(path, self.device, network="student")
        try:
            self.learner.student.load_state_dict(state["student_state_dict"])
            self.learner.load_state_dict(state["learner"], state["iter"])
        except (RuntimeError, ValueError, KeyError) as error:
            raise ValueError(
                f"{path} does not fit this run's network; resume with the configuration it was trained with "
                f"(its run folder's config.json), or start anew ({error})"
            ) from error
        self.iteration, self.env_steps = state["iter"], state["env_steps"]
        self.elapsed_s = state["elapsed_s"]
        self.new_episodes = self.learner.fits(state["ranks"])
        if not self.new_episodes:
            mine = state["ranks"][self.processes.rank]
            self.learner.load_local_state(mine["local"])
            set_random_state(mine["random"], self.device)

    def _iterate(self) -> dict[str, Any] | None:
        """One iteration; its row for ``progress.jsonl``, or None if it was ended within."""
        if self.is_distributed:
            watch_iteration()
        start = time.perf_counter()
        try:
            # With several processes all must do the same collectives, so they stop between iterations.
            figures = self.learner.iterate(lambda: bool(self._end.signal) and not self.is_distributed)
        except TrainingDivergedError as error:
            folder = self.run.out / CHECKPOINT_FOLDER
            raise TrainingDivergedError(
                f"iteration {self.iteration + 1}: {error}. The last checkpoint in {folder} is from before; "
                "go on from it with --resume"
            ) from error
        if figures is None:
            return None
        passed = time.perf_counter() - start
        self.iteration += 1
        self.env_steps += self._steps_per_iteration
        self.elapsed_s += passed
        return {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "elapsed_s": round(self.elapsed_s, 3),
            "steps_per_s": self._steps_per_iteration / passed,
            **figures,
        }

    def _state(self) -> dict[str, Any]:
        """Everything a checkpoint holds."""
        mine = {"random": random_state(self.device), "local": self.learner.local_state()}
        ranks: list[Any] = [mine]
        if self.is_distributed:
            ranks = [None] * self.processes.world_size
            torch.distributed.all_gather_object(ranks, mine)
        return {
            "student_state_dict": self.learner.student.state_dict(),
            "learner": self.learner.state_dict(),
            "spec": to_dict(self.spec),
            "task": self.task,
            "depth": self.depth,
            "iter": self.iteration,
            "env_steps": self.env_steps,
            "elapsed_s": self.elapsed_s,
            "ranks": ranks,
        }

    def shutdown(self) -> None:
        """Leave the process group; all processes have to call it, so not after an error of one."""
        if self.is_distributed:
            torch.distributed.destroy_process_group()


def summary(row: Mapping[str, Any], total: int, left_s: float | None) -> str:
    """The main figures of an iteration in one line.

    Args:
        row: A row of ``progress.jsonl``.
        total: Iterations of the whole run.
        left_s: Estimated time left [s].
    """
    main = {
        "student/action_error": "action error {:.3f}",
        "student/category": "category right {:.1%}",
        "student/distance_error": "distance error {:.2f} rad",
        "student/joint_error": "joint error {:.2f} rad",
        "success_per_goal": "success {:.1%} of goals",
    }
    figures = [text.format(row[key]) for key, text in main.items() if row.get(key) is not None]
    return " | ".join(
        (
            f"iteration {row['iteration']}/{total}",
            f"{format_steps(row['env_steps'])} steps, {format_steps(row['steps_per_s'])}/s",
            *figures,
            f"left {format_duration(left_s)}",
        )
    )


def details(row: Mapping[str, Any]) -> str:
    """The losses of an iteration."""
    losses = {k.removeprefix("loss/"): v for k, v in row.items() if k.startswith("loss/") and v is not None}
    return "losses: " + "  ".join(f"{name} {value:.3f}" for name, value in losses.items())
