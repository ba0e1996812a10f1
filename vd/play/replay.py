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
    """The steps of a log as snapshots, and stepping through them as through a :class:`.session.Session`.

    It starts over at the end.

    Raises:
        LogError: Hand or object are not here.
    """

    def __init__(self, log: HandLog):
        self.log, self._now, self.sees = log, 0, False
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
        log, columns = self.log, self.log.columns
        steps = len(columns["t"])
        position = log.channel("position")
        pose = np.full((steps, 7), np.nan) if log.object_pose is None else log.object_pose
        known = np.where(np.isfinite(pose).all(axis=1), np.arange(steps), 0)
        pose = pose[np.maximum.accumulate(known)]  # nobody looks while the hand is held
        pose = np.where(np.isfinite(pose), pose, OUT_OF_SIGHT)
        error = columns.get("error", columns["distance"])
        heard = columns.get("image_s", columns.get("sensed_s"))
        ends = {stop.goal: stop for stop in log.stops}
        reached = lost = 0
        for step in range(steps):
            believed = float(columns["distance"][step])
            number = min(int(columns["goal"][step]), len(log.goals) - 1)  # one may not have begun
            stop = ends.get(number)
            # Events have the time of their writing: the last step before it is the one that ended
            # the goal.
            over = stop is not None and columns["t"][step] <= stop.time_s
            last = step + 1 == steps or columns["t"][step + 1] > (stop.time_s if stop else np.inf)
            near = "error" not in columns or error[step] <= log.tolerance_rad
            success = bool(stop and over and last and near and stop.outcome == "stopped")
            fell = bool(stop and over and last and stop.outcome == "lost")
            reached, lost = reached + success, lost + fell
            yield Snapshot(
                name=self.object_name,
                time_s=float(columns["t"][step] - columns["t"][0]),
                joint_q=np.concatenate([position[step], pose[step]]),
                goal_quat=log.goals[number],
                error_rad=float(np.nan_to_num(error[step], nan=np.pi)),
                success=success,
                fell=fell,
                goals=reached,
                drops=lost,
                table=not self.hand.palm_up,
                believed_rad=believed
                if np.isfinite(believed)
                else None,  # not while the hand is held
                latency_s=None if heard is None else float(columns["sent_s"][step] - heard[step]),
            )


def film(log: HandLog, path: Path) -> int:
    """Write the film of a log to an .mp4; returns the number of frames.

    Raises:
        LogError: Hand or object are not here.
    """
    shown, (width, height) = Replay(log), SINGLE_CELL
    renderer = Renderer(shown.hand, shown.objects, width=width, height=height)
    return write_frames(
        path, drawn(renderer, ([shot] for shot in shown.snapshots)), shown.control_hz
    )
