"""Score a run by motion capture: the object's error at each stop, as the paper measures it.

An error is the angle between the goal and the object when the policy has said that it arrived, up
to the object's symmetry. Trials whose markers were lost at the stop are discarded; trials without a
stop have no error, and count as failures in the shares.
"""

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from vd.evaluate.statistics import (
    TOLERANCES_RAD,
    Interval,
    median_interval,
    rate_intervals,
    symmetric_error,
)
from vd.logs.hand_log import HandLog, read_log

COLUMNS = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
"""What an export has of each sample."""
UNIT_TOLERANCE = 1e-2
"""Deviation of a quaternion's length from 1, above which it is none."""
NEAR_S = 0.1
"""Farthest sample [s] from a stop that counts for it: the object rests, and lost markers come back
late.
"""


class MocapError(ValueError):
    """An export that cannot be used; names file and remedy."""


@dataclass(frozen=True, eq=False)
class Mocap:
    """An object's track, T samples."""

    path: Path
    """The file."""
    time_s: np.ndarray
    """Time of each sample [s], rising [T]."""
    pose: np.ndarray
    """Position [m] and quaternion xyzw, NaN where it was lost [T, 7]."""

    @property
    def tracked(self) -> np.ndarray:
        """Where the object was tracked [T]."""
        return np.isfinite(self.pose).all(axis=1)


@dataclass(frozen=True)
class ScoreCfg:
    """Score a run by motion capture."""

    log: Annotated[Path, tyro.conf.Positional]
    """Folder of the log of vd-deploy."""
    mocap: Path
    """Export of the motion capture: CSV with time [s], x, y, z [m], qx, qy, qz, qw, and tracked (1 or
    0) if it likes; empty cells where markers were lost."""
    offset_s: float | None = None
    """Time of the motion capture at the log's beginning [s], to 0.3 s: the object rests at a stop.
    By default times are seconds since 1970."""
    world: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Turn from the motion capture's frame to the hand's world frame (z up), quaternion xyzw; 0.707 0
    0 0.707 where y points up."""
    marker: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """The object's frame in that of its rigid body, quaternion xyzw: how the markers were defined
    on it.
    """


@dataclass(frozen=True)
class Trial:
    """The pursuit of one goal."""

    goal: int
    """Number of the goal."""
    time_s: float
    """When it ended [s], since the start of the log."""
    outcome: str
    """How it ended."""
    tracked: bool
    """Whether the object was tracked at its end."""
    error_rad: float | None
    """Angle to the goal at the stop [rad]; None without a stop, or if the object was not
    tracked.
    """
    predicted_rad: float | None
    """What the policy predicted [rad]."""

    @property
    def discarded(self) -> bool:
        """Whether it cannot be scored: it stopped, but nobody knows where."""
        return self.outcome == "stopped" and not self.tracked


@dataclass(frozen=True, eq=False)
class Score:
    """A scored run."""

    log: Path
    """The run."""
    mocap: Path
    """Its motion capture."""
    offset_s: float
    """Time of the export at the log's beginning [s]."""
    trials: tuple[Trial, ...]
    """Every goal that ended."""
    median: Interval | None
    """Of the errors at the stops [rad]."""
    within: tuple[tuple[float, Interval], ...]
    """Share of the trials that stopped within each tolerance [rad], the discarded ones apart."""

    @property
    def scored(self) -> int:
        """Trials that were not discarded."""
        return sum(not trial.discarded for trial in self.trials)


def score(cfg: ScoreCfg) -> int:
    """Print the table; 1 if no trial could be scored."""
    from vd.deploy.loop.goals import one_object

    log = read_log(cfg.log)
    symmetry = one_object(log.run["object"]["set"]).symmetry
    mocap = in_world(read_mocap(cfg.mocap), world=cfg.world, marker=cfg.marker)
    result = score_run(log, mocap, symmetry, offset_s=cfg.offset_s)
    print("\n".join(lines(result)))
    return 0 if result.scored else 1


def read_mocap(path: Path) -> Mocap:
    """Read an export.

    Raises:
        MocapError: It is none; says what is wrong and the remedy.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.DictReader(stream))
        values = np.array([[float(row[name] or "nan") for name in COLUMNS] for row in rows])
        if len(values) < 2 or not (np.diff(values[:, 0]) > 0.0).all():  # NaN does not rise
            raise ValueError("times of at least two samples must rise; export it again")
        lost = [float(row.get("tracked") or 1.0) < 0.5 for row in rows]
        values[lost, 1:] = np.nan
        mocap = Mocap(path, values[:, 0], values[:, 1:])
        length = np.linalg.norm(mocap.pose[mocap.tracked, 3:], axis=1)
        if (np.abs(length - 1.0) > UNIT_TOLERANCE).any():
            raise ValueError("a quaternion's length is not 1; export rotations as quaternions")
    except KeyError as error:
        raise MocapError(
            f"{path}: there is no column {error}; the first line must name {', '.join(COLUMNS)}"
        ) from error
    except (OSError, ValueError, csv.Error) as error:  # of text and numbers too
        raise MocapError(f"{path}: {error}") from error
    return mocap


def in_world(mocap: Mocap, *, world: tuple[float, ...], marker: tuple[float, ...]) -> Mocap:
    """The object's track in the hand's world frame (z up).

    Raises:
        ValueError: A turn is no quaternion.
    """
    for name, turn in (("--world", world), ("--marker", marker)):
        if not np.isfinite(turn).all() or not np.linalg.norm(turn) > 0.0:
            raise ValueError(f"{name} {turn} is no quaternion xyzw")
    frame = Rotation.from_quat(world)
    pose = mocap.pose.copy()
    rows = mocap.tracked
    turn = frame * Rotation.from_quat(pose[rows, 3:]) * Rotation.from_quat(marker)
    pose[rows] = np.concatenate([frame.apply(pose[rows, :3]), turn.as_quat()], axis=1)
    return replace(mocap, pose=pose)


def score_run(
    log: HandLog, mocap: Mocap, symmetry: np.ndarray, *, offset_s: float | None = None
) -> Score:
    """Score a run.

    Args:
        log: The run.
        mocap: The object's track in the hand's world frame.
        symmetry: Rotations of the object onto itself, xyzw [S, 4].
        offset_s: Time of the export at the log's beginning [s]; None: its times are seconds since
            1970.

    Raises:
        MocapError: The export does not cover the run.
    """
    if offset_s is None:
        offset_s = float(log.run["unix_s"])
    mocap = replace(mocap, time_s=mocap.time_s - offset_s)
    end = log.columns["t"][-1]
    if mocap.time_s[-1] < 0.0 or mocap.time_s[0] > end:
        raise MocapError(
            f"{mocap.path} covers {mocap.time_s[0]:.1f} to {mocap.time_s[-1]:.1f} s of the log's "
            f"time, the log 0 to {end:.1f} s; name the clocks' offset with --offset-s, or export "
            "the right take"
        )
    trials = []
    for stop in log.stops:
        row = int(np.argmin(np.abs(np.where(mocap.tracked, mocap.time_s, np.inf) - stop.time_s)))
        tracked = bool(mocap.tracked[row] and abs(mocap.time_s[row] - stop.time_s) <= NEAR_S)
        error = None
        if tracked and stop.outcome == "stopped":
            error = float(symmetric_error(mocap.pose[row, 3:], np.array(stop.goal_quat), symmetry))
        trials.append(Trial(stop.goal, stop.time_s, stop.outcome, tracked, error, stop.distance))
    kept = [trial.error_rad for trial in trials if not trial.discarded]
    errors = np.array([np.inf if error is None else error for error in kept])
    stop_errors = errors[np.isfinite(errors)]
    within = errors <= np.array(TOLERANCES_RAD)[:, None]
    rates = rate_intervals(within[:, None, :], "episode") if kept else []
    return Score(
        log.path,
        mocap.path,
        offset_s,
        tuple(trials),
        median_interval(stop_errors[None], "episode") if len(stop_errors) else None,
        tuple(zip(TOLERANCES_RAD, rates, strict=False)),
    )


def lines(result: Score) -> list[str]:
    """The score as text."""
    rows = ["goal  ended at  outcome     error  predicted"]
    for trial in result.trials:
        error = "lost" if trial.discarded else _degrees(trial.error_rad)
        rows.append(
            f"{trial.goal + 1:4d}  {trial.time_s:6.1f} s  {trial.outcome:<10}  {error:>5}  "
            f"{_degrees(trial.predicted_rad):>9}"
        )
    discarded = len(result.trials) - result.scored
    rows.append(
        f"{result.scored} trials scored, {discarded} discarded since the markers were lost at the "
        f"stop"
    )
    if result.median is not None:
        m = result.median
        stops = sum(trial.error_rad is not None for trial in result.trials)
        rows.append(
            f"median error at {stops} stops: {m.value:.2f} rad ({np.degrees(m.value):.0f} deg), "
            f"95 % {m.low:.2f} to {m.high:.2f}"
        )
    for tolerance, share in result.within:
        rows.append(
            f"within {tolerance:.1f} rad: {100 * share.value:3.0f} %, 95 % {100 * share.low:.0f} "
            f"to {100 * share.high:.0f} % of all that were scored"
        )
    return rows


def _degrees(angle: float | None) -> str:
    return "-" if angle is None or not np.isfinite(angle) else f"{np.degrees(angle):.0f}°"
