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
    median_interval,
    rate_intervals,
    symmetric_error,
)
from vd.logs.hand_log import HandLog, read_log

COLUMNS = ("time", "qx", "qy", "qz", "qw")
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
    quat: np.ndarray
    """Orientation xyzw, NaN where it was lost [T, 4]."""

    @property
    def tracked(self) -> np.ndarray:
        """Where the object was tracked [T]."""
        return np.isfinite(self.quat).all(axis=1)


@dataclass(frozen=True)
class ScoreCfg:
    """Score a run by motion capture."""

    log: Annotated[Path, tyro.conf.Positional]
    """Folder of the log of vd-deploy."""
    mocap: Path
    """Export of the motion capture: CSV with time [s], qx, qy, qz, qw, and tracked (1 or 0) if it
    likes; empty cells where markers were lost."""
    offset_s: float | None = None
    """Time of the motion capture at the log's beginning [s], to 0.3 s: the object rests at a stop.
    By default times are seconds since 1970."""
    world: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Turn from the motion capture's frame to the hand's world frame (z up), quaternion xyzw; 0.707
    0 0 0.707 where y points up."""
    marker: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """The object's frame in that of its rigid body, quaternion xyzw: how the markers were defined
    on it.
    """


def score(cfg: ScoreCfg) -> int:
    """Print the table; 1 if no trial could be scored."""
    from vd.deploy.loop.goals import one_object

    log = read_log(cfg.log)
    symmetry = one_object(log.run["object"]["set"]).symmetry
    mocap = in_world(read_mocap(cfg.mocap), world=cfg.world, marker=cfg.marker)
    errors = stop_errors(log, mocap, symmetry, offset_s=cfg.offset_s)
    print("\n".join(lines(log, errors)))
    return 1 if np.isnan(errors).all() else 0


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
        length = np.linalg.norm(mocap.quat[mocap.tracked], axis=1)
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
    rows = mocap.tracked
    tracked = Rotation.from_quat(mocap.quat[rows])
    quat = mocap.quat.copy()
    quat[rows] = (Rotation.from_quat(world) * tracked * Rotation.from_quat(marker)).as_quat()
    return replace(mocap, quat=quat)


def stop_errors(
    log: HandLog, mocap: Mocap, symmetry: np.ndarray, *, offset_s: float | None = None
) -> np.ndarray:
    """Angle to the goal at the end of each pursuit of a run [rad], in the order of ``log.stops``.

    Infinite where the policy did not say that it arrived, NaN where it did, but the object was not
    tracked.

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
    time_s = mocap.time_s - offset_s
    end = log.columns["t"][-1]
    if time_s[-1] < 0.0 or time_s[0] > end:
        raise MocapError(
            f"{mocap.path} covers {time_s[0]:.1f} to {time_s[-1]:.1f} s of the log's time, the log "
            f"0 to {end:.1f} s; name the clocks' offset with --offset-s, or export the right take"
        )
    tracked_s = np.where(mocap.tracked, time_s, np.inf)
    errors = np.full(len(log.stops), np.inf)
    for number, stop in enumerate(log.stops):
        if stop.outcome != "stopped":
            continue
        away_s = np.abs(tracked_s - stop.time_s)
        row = int(np.argmin(away_s))
        errors[number] = np.nan
        if away_s[row] <= NEAR_S:
            goal = np.array(stop.goal_quat)
            errors[number] = symmetric_error(mocap.quat[row], goal, symmetry)
    return errors


def lines(log: HandLog, errors: np.ndarray) -> list[str]:
    """What :func:`stop_errors` gave for a run, as text."""
    rows = ["goal  ended at  outcome     error  predicted"]
    for stop, error in zip(log.stops, errors, strict=True):
        shown = "lost" if np.isnan(error) else _degrees(error)
        rows.append(
            f"{stop.goal + 1:4d}  {stop.time_s:6.1f} s  {stop.outcome:<10}  {shown:>5}  "
            f"{_degrees(stop.distance):>9}"
        )
    scored = errors[~np.isnan(errors)]
    rows.append(
        f"{len(scored)} trials scored, {len(errors) - len(scored)} discarded since the markers were "
        "lost at the stop"
    )
    at_stops = scored[np.isfinite(scored)]
    if len(at_stops):
        m = median_interval(at_stops[None], "episode")
        rows.append(
            f"median error at {len(at_stops)} stops: {m.value:.2f} rad "
            f"({np.degrees(m.value):.0f} deg), 95 % {m.low:.2f} to {m.high:.2f}"
        )
    within = scored <= np.array(TOLERANCES_RAD)[:, None]
    shares = rate_intervals(within[:, None, :], "episode") if len(scored) else []
    for tolerance, share in zip(TOLERANCES_RAD, shares, strict=False):
        rows.append(
            f"within {tolerance:.1f} rad: {100 * share.value:3.0f} %, 95 % {100 * share.low:.0f} "
            f"to {100 * share.high:.0f} % of all that were scored"
        )
    return rows


def _degrees(angle: float | None) -> str:
    return "-" if angle is None or not np.isfinite(angle) else f"{np.degrees(angle):.0f}°"
