"""What a run reports once an iteration, as JSON lines and in TensorBoard."""

import json
import math
import threading
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from vd.command.files import make_folder, write_text, writing

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

PROGRESS_FILE = "progress.jsonl"
BOARD_FOLDER = "tensorboard"


class StepMeans:
    """Means of ``extras["log"]`` over an iteration's steps, copied to the host at its end."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._steps: list[torch.Tensor] = []

    def add(self, log: dict[str, torch.Tensor]) -> None:
        """Add one step's scalars; every step has the same keys."""
        self._names = tuple(log)
        self._steps.append(torch.stack(tuple(log.values())))

    def clear(self) -> None:
        """Forget the steps so far."""
        self._steps.clear()

    def read(self, world_size: int = 1) -> dict[str, float]:
        """Means by name, averaged over the ranks, and start anew. Waits for the device."""
        mean = torch.stack(self._steps).mean(dim=0)
        if world_size > 1:
            torch.distributed.all_reduce(mean)
            mean = mean / world_size
        self.clear()
        return dict(zip(self._names, mean.tolist(), strict=True))


class GoalWindow:
    """How goals ended over the last episode's worth of iterations.

    Success per goal is a ratio of rare events; a window as long as an episode holds about one ended
    goal of every environment, and weighs early and late steps of an episode alike.
    ``success_ends``: a goal that is reached ends its episode.
    """

    def __init__(self, length: int, *, success_ends: bool = False) -> None:
        self._success_ends = success_ends
        self._rows: deque[list[float]] = deque(maxlen=max(1, length))

    def add(self, means: dict[str, float]) -> dict[str, float | None]:
        """Take an iteration's means and give the window's ratios.

        Returns:
            ``success_per_goal``, ``goals_per_episode``, ``drop_rate`` (episodes that ended in a
            fall), each ``None`` until a goal or episode has ended, and ``mean_reward`` per control
            step.
        """
        self._rows.append(
            [
                means["task/reached"],
                means["task/dropped"],
                means["task/timed_out"],
                means["reward/total"],
            ]
        )
        reached, dropped, timed_out, reward = map(math.fsum, zip(*self._rows, strict=True))
        goals = reached + dropped + timed_out
        episodes = goals if self._success_ends else dropped + timed_out
        return {
            "success_per_goal": reached / goals if goals > 0 else None,
            "goals_per_episode": reached / episodes if episodes > 0 else None,
            "drop_rate": dropped / episodes if episodes > 0 else None,
            "mean_reward": reward / len(self._rows),
        }

    @property
    def full(self) -> bool:
        """Whether it is as long as meant; before, early successes look like a rate."""
        return len(self._rows) == self._rows.maxlen

    def state_dict(self) -> list[list[float]]:
        """The rows, oldest first."""
        return list(self._rows)

    def load_state_dict(self, rows: list[list[float]]) -> None:
        """Restore :meth:`state_dict`."""
        self._rows.clear()
        self._rows.extend(rows)


class ProgressFile:
    """One JSON object an iteration in ``progress.jsonl``, and the same for ``logger`` (``RunCfg``).

    Of an earlier run of this folder ``done`` iterations are kept; a resumed run writes later ones
    anew.
    """

    def __init__(self, run_dir: Path, logger: str = "tensorboard", *, done: int = 0) -> None:
        make_folder(run_dir)
        path = self._path = run_dir / PROGRESS_FILE
        kept = ""
        for row in read_progress(path) if path.is_file() else []:
            if row["iteration"] <= done:
                kept += f"{json.dumps(row)}\n"
        write_text(path, kept)
        with writing(path):
            self._file = path.open("ab", buffering=0)
        self._board = None if logger == "none" else _board(run_dir, done)

    def write(self, row: dict[str, Any]) -> None:
        """Add an iteration. Values that are not finite become ``null``.

        Raises:
            OutputError: The disk is full; the file is as it was.
        """
        row = {
            key: None if isinstance(v, float) and not math.isfinite(v) else v
            for key, v in row.items()
        }
        size = self._file.tell()
        try:
            with writing(self._path):
                line = json.dumps(row).encode() + b"\n"
                while line:
                    line = line[self._file.write(line) :]
            if self._board is not None:
                with writing(self._path.with_name(BOARD_FOLDER)):
                    for key, value in row.items():
                        if value is not None:
                            name = key if "/" in key else f"run/{key}"
                            self._board.add_scalar(name, value, row["iteration"])
        except OSError:
            self._file.truncate(size)  # a line is whole or not there
            self._board = None  # closing it would only say so again
            raise

    def close(self) -> None:
        """Flush and close both."""
        self._file.close()
        if self._board is not None:
            self._board.close()


def _board(run_dir: Path, done: int) -> "SummaryWriter":
    """What draws the curves of a run after ``done`` iterations."""
    from torch.utils.tensorboard import SummaryWriter  # heavy, and optional

    threading.excepthook = _report_thread
    return SummaryWriter(str(run_dir / BOARD_FOLDER), purge_step=done + 1, flush_secs=10)


def _report_thread(args: threading.ExceptHookArgs) -> None:
    """Report what ended a thread, but for the ``OSError`` of TensorBoard's.

    Its caller is told anyway.
    """
    if not (
        issubclass(args.exc_type, OSError)
        and type(args.thread).__module__.startswith("tensorboard")
    ):
        threading.__excepthook__(args)


def read_progress(path: Path) -> list[dict[str, Any]]:
    """Read ``progress.jsonl``; a last line cut short by a crash is left out.

    Raises:
        ValueError: A line before the last is not JSON.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number < len(lines):
                raise ValueError(f"{path}, line {number}: not JSON ({error})") from error
    return rows
