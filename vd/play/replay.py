"""Replaying the log of a run on a hand.

The same pictures as of a simulation, from what was measured.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vd.assets_usd.hand_model import HandModel
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.logs.hand_log import HandLog
from vd.logs.log_format import LogError
from vd.play.render import OUT_OF_SIGHT, Renderer
from vd.play.video import SINGLE_CELL, Snapshot, drawn, write_frames


class Replay:
    """The steps of a log as snapshots, with the methods of :class:`.session.Session`.

    It starts over at the end.

    Raises:
        LogError: Hand or object are not here.
    """

    def __init__(self, log: HandLog):
        self.log = log
        self._now = 0
        if not len(log.goals):
            raise LogError(f"{log.path} has no goal to show")
        self.control_hz = float(log.run["control_hz"])
        try:
            self.hand: HandModel = load_hand(log.run["hand"])
            self.objects = load_set(log.run["object"]["set"])[:1]
        except (ValueError, FileNotFoundError) as error:
            raise LogError(f"{log.path} cannot be shown: {error}") from error
        self.object_name = self.objects[0].name
        self.object_names = [self.object_name]
        self.snapshots = list(self._snapshots())

    @property
    def snapshot(self) -> Snapshot:
        """What is shown now."""
        return self.snapshots[self._now]

    def step(self) -> None:
        """The next control step."""
        self._now = (self._now + 1) % len(self.snapshots)

    def reset(self) -> None:
        """Back to the first step."""
        self._now = 0

    def new_goal(self) -> None:
        """On to the next goal."""
        number = self.log.columns["goal"]
        self._now = int(np.argmax(number > number[self._now]))  # 0 after the last

    def choose_object(self, name: str) -> None:
        """There is one."""

    def close(self) -> None:
        """Nothing is held."""

    def _snapshots(self) -> Iterator[Snapshot]:
        log = self.log
        columns = log.columns
        time = columns["t"]
        position = log.channel("position")
        pose = _pose_to_show(log)
        distance = columns["distance"]
        error = columns.get("error", distance)
        image_s = columns["image_s"]
        latency_s = columns["sent_s"] - np.where(np.isnan(image_s), columns["sensed_s"], image_s)
        ends = _goal_ends(log)
        goals = 0
        drops = 0
        for step in range(len(time)):
            outcome = ends.get(step)
            near = "error" not in columns or error[step] <= log.tolerance_rad
            success = outcome == "stopped" and bool(near)
            fell = outcome == "lost"
            goals += success
            drops += fell
            number = min(int(columns["goal"][step]), len(log.goals) - 1)  # one may not have begun
            believed = None  # while the hand is held
            if np.isfinite(distance[step]):
                believed = float(distance[step])
            yield Snapshot(
                name=self.object_name,
                time_s=float(time[step] - time[0]),
                joint_q=np.concatenate([position[step], pose[step]]),
                goal_quat=log.goals[number],
                error_rad=float(np.nan_to_num(error[step], nan=np.pi)),
                success=success,
                fell=fell,
                goals=goals,
                drops=drops,
                table=not self.hand.palm_up,
                believed_rad=believed,
                latency_s=float(latency_s[step]),
            )


def _pose_to_show(log: HandLog) -> np.ndarray:
    """Pose of the object [T, 7], the last known one while nobody looks; out of sight before."""
    if log.object_pose is None:
        return np.tile(OUT_OF_SIGHT, (len(log.columns["t"]), 1))
    known = np.isfinite(log.object_pose).all(axis=1)
    last_known = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
    pose = log.object_pose[last_known]
    return np.where(np.isfinite(pose), pose, OUT_OF_SIGHT)


def _goal_ends(log: HandLog) -> dict[int, str]:
    """How goals ended, by the step that ended them: events are written after it."""
    time = log.columns["t"]
    ends = {}
    for stop in log.stops:
        step = int(np.searchsorted(time, stop.time_s, side="right")) - 1
        ends[step] = stop.outcome
    return ends


def film(log: HandLog, path: Path) -> int:
    """Write the film of a log to an .mp4; returns the number of frames.

    Raises:
        LogError: Hand or object are not here.
    """
    replay = Replay(log)
    width, height = SINGLE_CELL
    renderer = Renderer(replay.hand, replay.objects, width=width, height=height)
    frames = drawn(renderer, [[snapshot] for snapshot in replay.snapshots])
    return write_frames(path, frames, replay.control_hz)
