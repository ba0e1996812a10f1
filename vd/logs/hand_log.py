"""The log of a policy on a hand.

Written by vd-deploy as it goes, replayed by vd-play, read by vd-gap.

A folder. ``steps.csv`` has a row for every control step, appended whole, so that a log cut short by
a crash is a log. ``recording.json`` beside it makes the folder a recording
(:mod:`vd.logs.recording`). ``run.json`` says what ran, and at the end how it ended;
``events.jsonl`` has goals, stops and faults. SI units, radians, world frame, quaternions xyzw;
times are seconds since the start. A row is a state, read at ``t``, and the goals that were sent after it, at
``t_command``.
"""

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vd.logs.log_format import (
    EVENTS_FILE,
    FOUND_COLUMNS,
    LOG_FORMAT,
    RUN_FILE,
    STEPS_FILE,
    STOPPED,
    TRUTH_COLUMNS,
    LogError,
)
from vd.paper import PAPER


@dataclass(frozen=True)
class Stop:
    """Where the pursuit of one goal ended."""

    goal: int
    """Number of the goal."""
    goal_quat: tuple[float, ...]
    """Wanted orientation of the object [4]."""
    time_s: float
    """When [s], since the start of the log."""
    outcome: str
    """``stopped`` by the policy, ``time limit``, ``lost`` or ``aborted``."""
    distance: float | None
    """Distance that the policy predicted [rad]; None before its first step."""


@dataclass(frozen=True, eq=False)
class HandLog:
    """A log that was read; T steps, D joints.

    Attributes:
        path: Folder.
        run: What ``run.json`` says.
        columns: Columns of the steps by name, [T] each.
        events: Events in order.
    """

    path: Path
    run: dict[str, Any]
    columns: dict[str, np.ndarray]
    events: list[dict[str, Any]]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints [D]."""
        return tuple(self.run["joints"])

    @property
    def goals(self) -> np.ndarray:
        """Wanted orientations [G, 4]."""
        return np.array(self.run["goals"], dtype=float).reshape(-1, 4)

    @property
    def tolerance_rad(self) -> float:
        """Largest angle at which a goal is reached [rad]."""
        return float(self.run.get("tolerance_rad", PAPER.success.rotation_rad))

    @property
    def stops(self) -> list[Stop]:
        """Where the pursuit of each goal ended."""
        stops = []
        for event in self.events:
            if event["event"] == "stop":
                goal = event["goal"]
                quat = tuple(self.run["goals"][goal])
                stops.append(Stop(goal, quat, event["t"], event["outcome"], event["distance"]))
        return stops

    @property
    def stopped(self) -> tuple[str, dict[str, str]] | None:
        """Why the hand was stopped, and motors that may be on, by ID; None where it is unknown."""
        for event in reversed(self.events):
            if event["event"] == STOPPED:
                return event["reason"], event["may_be_on"]
        return None

    def channel(self, name: str) -> np.ndarray:
        """One of JOINT_CHANNELS [T, D]; NaN where it was not logged."""
        blank = np.full(len(self.columns["t"]), np.nan)
        return np.stack(
            [self.columns.get(f"{name}.{joint}", blank) for joint in self.joints], axis=1
        )

    @property
    def object_pose(self) -> np.ndarray | None:
        """Pose of the object [T, 7]: the true one, or else as it was found.

        None where neither is known.
        """
        for names in (TRUTH_COLUMNS[:7], FOUND_COLUMNS):
            if names[0] in self.columns:
                pose = np.stack([self.columns[name] for name in names], axis=1)
                return pose if np.isfinite(pose).any() else None
        return None


def is_log(path: str | Path) -> bool:
    """Whether a folder is a log."""
    return (Path(path) / RUN_FILE).is_file()


def read_log(path: str | Path) -> HandLog:
    """Read a log, also one that was cut short.

    Raises:
        LogError: It is none, or damaged.
    """
    path = Path(path)
    try:
        run = json.loads((path / RUN_FILE).read_text())
    except FileNotFoundError:
        raise LogError(
            f"{path} is no log: there is no {RUN_FILE}; give a folder that vd-deploy wrote"
        ) from None
    except ValueError as error:
        raise LogError(
            f"{path / RUN_FILE} is damaged ({error}); copy the whole folder again"
        ) from error
    version = run.get("format") if isinstance(run, dict) else None
    if version != LOG_FORMAT:
        raise LogError(
            f"{path / RUN_FILE}: format is {version!r}; this version reads {LOG_FORMAT!r}"
        )
    if not {"joints", "goals"} <= run.keys():
        raise LogError(f"{path / RUN_FILE} has no joints or no goals; copy the whole folder again")
    return HandLog(path, run, read_columns(path / STEPS_FILE), _events(path / EVENTS_FILE))


def read_columns(file: Path) -> dict[str, np.ndarray]:
    """Columns [T] of a CSV file of numbers, by name; a last row that was cut short is left out.

    Raises:
        LogError: There is no such file, or it holds something else.
    """
    if not file.is_file():
        raise LogError(f"{file} is missing; copy the whole folder again")
    try:
        with file.open(newline="") as stream:
            header, *rows = [*csv.reader(stream)] or [[]]
        if rows and len(rows[-1]) < len(header):  # the last row of a log that was cut short
            rows.pop()
        for number, row in enumerate(rows, 2):
            if len(row) != len(header):
                raise ValueError(f"row {number} has {len(row)} values for {len(header)} columns")
        values = np.array(rows, dtype=float)
    except ValueError as error:
        raise LogError(f"{file} is damaged ({error}); copy the whole folder again") from error
    if not rows:
        raise LogError(f"{file} has no rows")
    return dict(zip(header, values.T, strict=True))


def _events(file: Path) -> list[dict[str, Any]]:
    if not file.is_file():
        return []
    try:
        lines = file.read_text().splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.endswith("\n")]
    except ValueError as error:
        raise LogError(f"{file} is damaged ({error}); copy the whole folder again") from error
