"""Writing the log of a run on a hand: rows and events are appended whole, by a thread.

A write can wait for the disk as long as other programs keep that busy, and the hand must not.
"""

import json
import os
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.hands import called
from vd.command.files import make_folder, write_json, writing
from vd.deploy.clock import MONOTONIC, Clock
from vd.deploy.hardware.control_table import RAD_PER_COUNT
from vd.deploy.safety.safety import StopReport
from vd.logs.log_format import (
    EVENTS_FILE,
    FOUND_COLUMNS,
    JOINT_CHANNELS,
    LOG_FORMAT,
    RECORDING_FILE,
    RUN_FILE,
    STEP_COLUMNS,
    STEPS_FILE,
    STOPPED,
    TRUTH_COLUMNS,
)
from vd.logs.recording import COMMAND_TIME
from vd.logs.recording import FORMAT as RECORDING_FORMAT

DIGITS = 6
NOWHERE = (float("nan"),) * len(FOUND_COLUMNS)


class LogWriter:
    """A log being written.

    Args:
        folder: To make; it must not hold a log.
        hand: The hand.
        run: What runs: policy, object, goals (quaternions xyzw), and whatever is worth to know.
        servo: What is known of the motors: model, gains.
        truth: Whether the object's pose is known: a twin's.
        without: Those of JOINT_CHANNELS that nobody measures.
        clock: Time.

    Raises:
        FileExistsError: There is a log already.
    """

    def __init__(
        self,
        folder: Path,
        hand: HandModel,
        run: Mapping[str, Any],
        *,
        servo: Mapping[str, Any],
        truth: bool = False,
        without: Collection[str] = (),
        clock: Clock = MONOTONIC,
    ):
        if (folder / RUN_FILE).exists():
            raise FileExistsError(f"{folder} holds a log; choose another folder")
        make_folder(folder)
        self.folder = folder
        self._joints = hand.joint_names
        self._clock = clock
        self.started_s = clock.now()
        self.run: dict[str, Any] = {
            "format": LOG_FORMAT,
            "hand": called(hand),
            "joints": list(hand.joint_names),
            "unix_s": time.time(),
            **run,
        }
        """What run.json says."""
        recording = {
            "format": RECORDING_FORMAT,
            "model": called(hand),
            "joints": list(hand.joint_names),
            "servo": dict(servo),
            "encoder_resolution_rad": RAD_PER_COUNT,
            "trajectories": [
                {"file": STEPS_FILE, "excitation": "policy", "joints": list(hand.joint_names)}
            ],
        }
        self._hear: Callable[[Mapping[str, Any]], object] | None = None
        self._channels = [channel for channel in JOINT_CHANNELS if channel not in without]
        self._columns = [
            "t",
            COMMAND_TIME,
            *(f"{channel}.{joint}" for channel in self._channels for joint in hand.joint_names),
            *STEP_COLUMNS,
            *FOUND_COLUMNS,
            *(TRUTH_COLUMNS if truth else ()),
        ]
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        self._steps = os.open(folder / STEPS_FILE, flags, 0o644)
        self._events = os.open(folder / EVENTS_FILE, flags, 0o644)
        self._writer = ThreadPoolExecutor(1, "log")
        self._pending: deque[Future[Any]] = deque()
        self._append(self._steps, ",".join(self._columns))
        write_json(folder / RECORDING_FILE, recording)
        write_json(folder / RUN_FILE, self.run)

    def also_to(self, hear: Callable[[Mapping[str, Any]], object]) -> None:
        """Give events, as of events.jsonl, to others too; the calls come from the log's thread."""
        self._hear = hear

    def since(self, time_s: float) -> float:
        """Seconds from the start of the log to a time of the monotonic clock."""
        return time_s - self.started_s

    def step(
        self,
        time_s: float,
        sent_s: float,
        joints: Mapping[str, np.ndarray],
        values: Sequence[float],
        truth: Sequence[float] = (),
        found: Sequence[float] = NOWHERE,
    ) -> None:
        """Append a control step.

        Args:
            time_s: When the state was read, by the monotonic clock [s].
            sent_s: When the goals were sent, by the same clock [s].
            joints: Each of JOINT_CHANNELS [D].
            values: In the order of STEP_COLUMNS.
            truth: In the order of TRUTH_COLUMNS, if they are logged.
            found: In the order of FOUND_COLUMNS.
        """
        row = [
            self.since(time_s),
            self.since(sent_s),
            *(v for channel in self._channels for v in joints[channel]),
            *values,
            *found,
            *truth,
        ]
        self._append(self._steps, ",".join(f"{value:.{DIGITS}f}" for value in row))

    def goal(self, number: int, goal: np.ndarray) -> None:
        """A goal [4] is begun; one that was not known when the log began is noted first."""
        goals = self.run["goals"]
        if number == len(goals):
            goals.append(list(map(float, goal)))
            run = {**self.run, "goals": list(goals)}
            self._later(lambda: write_json(self.folder / RUN_FILE, run))
        self.event("goal", goal=number)

    def event(self, event: str, **values: Any) -> None:
        """Append an event of this moment."""
        line = {"t": round(self.since(self._clock.now()), DIGITS), "event": event, **values}
        self._append(self._events, json.dumps(line))
        if self._hear is not None:
            self._later(partial(self._hear, line))

    def stopped(self, report: StopReport) -> None:
        """The hand was stopped; with the motors that may still have their torque on, by ID."""
        may_be_on = {str(id): why for id, why in report.unreleased.items()}
        self.event(STOPPED, reason=report.reason, may_be_on=may_be_on)

    def finish(self, reason: str, **summary: Any) -> None:
        """Say how it ended, and close the files.

        Raises:
            OSError: Something could not be written.
        """
        self.event("end", reason=reason)
        run = {**self.run, "end": {"reason": reason, **summary}}
        self._writer.shutdown()
        os.close(self._steps)
        os.close(self._events)
        write_json(self.folder / RUN_FILE, run)
        self._check()

    def _append(self, file: int, line: str) -> None:
        data = line.encode() + b"\n"
        self._later(lambda: os.write(file, data))  # one call: whole, or not at all

    def _later(self, do: Callable[[], object]) -> None:
        """Have the thread do something."""
        self._check()
        self._pending.append(self._writer.submit(do))

    def _check(self) -> None:
        """Raise what went wrong in writing: a run without its log is not worth going on with."""
        while self._pending and self._pending[0].done():
            with writing(self.folder):
                self._pending.popleft().result()
