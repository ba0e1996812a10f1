"""Replaying the log of a run on a hand: the same pictures as of a simulation, from what was measured."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from vd.assets_usd.hand_model import HandModel
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.model import ObjectModel
from vd.assets_usd.objects.sets import load_set
from vd.hand_log import HandLog, LogError
from vd.play.video import SINGLE_CELL, Composer, Snapshot, write_frames
from vd.render import OUT_OF_SIGHT, Renderer


class Replay:
    """The steps of a log as snapshots.

    Args:
        log: The log.

    Attributes:
        hand: The hand that moved.
        item: The object.
        snapshots: One for each control step.

    Raises:
        LogError: Hand or object are not here.
    """

    def __init__(self, log: HandLog):
        self.log = log
        try:
            self.hand: HandModel = load_hand(log.run["hand"])
            self.item: ObjectModel = load_set(log.run["object"]["set"])[0]
        except (ValueError, FileNotFoundError) as error:
            raise LogError(f"{log.path} cannot be shown: {error}") from error
        self.snapshots = list(self._snapshots())

    @property
    def control_hz(self) -> float:
        """Control steps a second."""
        return float(self.log.run["control_hz"])

    def _snapshots(self) -> Iterator[Snapshot]:
        log, columns = self.log, self.log.columns
        steps = len(columns["t"])
        position, pose = log.channel("position"), log.object_pose
        if pose is None:  # nobody measured it
            pose = np.tile(OUT_OF_SIGHT, (steps, 1))
        error = columns.get("error", columns["distance"])
        ends = {stop.goal: stop for stop in log.stops}
        reached = lost = 0
        for step in range(steps):
            number = int(columns["goal"][step])
            stop = ends.get(number)
            # Events have the time of their writing: the last step before it is the one that ended the goal.
            over = stop is not None and columns["t"][step] <= stop.time_s
            last = step + 1 == steps or columns["t"][step + 1] > (stop.time_s if stop else np.inf)
            near = "error" not in columns or error[step] <= log.tolerance_rad
            success = bool(stop and over and last and near and stop.outcome == "stopped")
            fell = bool(stop and over and last and stop.outcome == "lost")
            reached, lost = reached + success, lost + fell
            yield Snapshot(
                name=self.item.name,
                time_s=float(columns["t"][step] - columns["t"][0]),
                joint_q=np.concatenate([position[step], pose[step]]),
                goal_quat=log.goals[number],
                error_rad=float(np.nan_to_num(error[step], nan=np.pi)),
                success=success,
                fell=fell,
                goals=reached,
                drops=lost,
            )

    def frames(self, renderer: Renderer) -> Iterator[np.ndarray]:
        """Draw one frame for each control step, RGB bytes [height, width, 3]."""
        composer = Composer(1)
        for shot in self.snapshots:
            yield composer.frame(renderer.render(shot.joint_q[None], shot.goal_quat[None]), [shot])


def film(log: HandLog, path: Path) -> int:
    """Write the film of a log; returns the number of frames.

    Args:
        log: The log.
        path: .mp4.

    Raises:
        LogError: Hand or object are not here.
    """
    shown, (width, height) = Replay(log), SINGLE_CELL
    renderer = Renderer(shown.hand, [shown.item], width=width, height=height)
    return write_frames(path, shown.frames(renderer), shown.control_hz)


class ReplaySession:
    """A replay as the viewer steps through it: what :class:`vd.play.session.Session` is for a simulation.

    Args:
        replay: The replay; it starts over at its end.
    """

    def __init__(self, replay: Replay):
        self._replay, self._next = replay, 0
        self.env = SimpleNamespace(
            hand=replay.hand,
            objects=[replay.item],
            cfg=SimpleNamespace(sim=SimpleNamespace(control_hz=replay.control_hz)),
            close=lambda: None,
        )
        self.object_name = replay.item.name
        self.object_names = [self.object_name]
        self.snapshot = replay.snapshots[0]

    def step(self) -> Snapshot:
        """The next control step."""
        self._next = (self._next + 1) % len(self._replay.snapshots)
        self.snapshot = self._replay.snapshots[self._next]
        return self.snapshot

    def reset(self) -> Snapshot:
        """Back to the first step."""
        self._next = -1
        return self.step()

    def new_goal(self) -> Snapshot:
        """On to the next goal."""
        number = self._replay.log.columns["goal"]
        later = np.flatnonzero(number > number[self._next])
        self._next = int(later[0]) - 1 if len(later) else -1
        return self.step()

    def choose_object(self, name: str) -> None:
        """There is one."""
