"""Score a run by motion capture: the object's error at each stop, as the paper measures it.

An error is the angle between the goal and the object when the policy has said that it arrived, up to the
object's symmetry. Trials whose markers were lost at the stop are discarded; trials without a stop have no
error, and count as failures in the shares.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vd.deploy.loop.mocap import Mocap, MocapError
from vd.evaluate.statistics import TOLERANCES_RAD, Interval, median_interval, rate_intervals, symmetric_error
from vd.hand_log import HandLog

NEAR_S = 0.1
"""Farthest sample [s] from a stop that counts for it: the object rests, and lost markers come back late."""
OFFSET_STEP_S = 0.02
"""Step of the search for the offset between two clocks [s]."""
LEAST_OVERLAP = 0.5
"""Share of the log's steps that motion capture has to cover for an offset to be considered."""
LEAST_FALL = 0.5
"""The best offset's disagreement over the typical one, above which no offset stands out."""
NO_SYMMETRY = np.array([[0.0, 0.0, 0.0, 1.0]])


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
    """Angle to the goal at the stop [rad]; None without a stop, or if the object was not tracked."""
    predicted_rad: float | None
    """What the policy predicted [rad]."""

    @property
    def discarded(self) -> bool:
        """Whether it cannot be scored: it stopped, but nobody knows where."""
        return self.outcome == "stopped" and not self.tracked


@dataclass(frozen=True, eq=False)
class Score:
    """A scored run."""

    log: HandLog
    """The run."""
    mocap: Mocap
    """Its motion capture: times since the start of the log, the object in the hand's world frame."""
    offset_s: float
    """Time of the export at the log's beginning [s]."""
    trials: tuple[Trial, ...]
    """Every goal that ended."""
    median: Interval | None
    """Of the errors at the stops [rad]."""
    within: tuple[tuple[float, Interval], ...]
    """Share of the trials that stopped within each tolerance [rad], the discarded ones apart."""

    @property
    def errors(self) -> np.ndarray:
        """Errors at the stops [rad]."""
        return np.array([trial.error_rad for trial in self.trials if trial.error_rad is not None])

    @property
    def scored(self) -> int:
        """Trials that were not discarded."""
        return sum(not trial.discarded for trial in self.trials)

    def record(self) -> dict[str, Any]:
        """For scripts: SI units, radians."""
        return {
            "log": str(self.log.path),
            "mocap": str(self.mocap.path),
            "offset_s": self.offset_s,
            "trials": [asdict(trial) | {"discarded": trial.discarded} for trial in self.trials],
            "scored": self.scored,
            "discarded": len(self.trials) - self.scored,
            "stopped": len(self.errors),
            "median_rad": None if self.median is None else asdict(self.median),
            "within": [{"tolerance_rad": t, **asdict(interval)} for t, interval in self.within],
        }


def in_world(mocap: Mocap, *, up: str, world: tuple[float, ...], marker: tuple[float, ...]) -> Mocap:
    """The object's track in the hand's world frame (z up).

    Raises:
        ValueError: A turn is no quaternion.
    """
    for name, turn in (("--world", world), ("--marker", marker)):
        if not np.isfinite(turn).all() or not np.linalg.norm(turn) > 0.0:
            raise ValueError(f"{name} {turn} is no quaternion xyzw")
    frame = Rotation.from_quat(world)
    if up == "y":
        frame = frame * Rotation.from_euler("x", 90, degrees=True)
    pose, rows = mocap.pose.copy(), mocap.tracked
    turn = frame * Rotation.from_quat(pose[rows, 3:]) * Rotation.from_quat(marker)
    pose[rows] = np.concatenate([frame.apply(pose[rows, :3]), turn.as_quat()], axis=1)
    return replace(mocap, pose=pose)


def score_run(log: HandLog, mocap: Mocap, symmetry: np.ndarray, *, offset_s: float | None = None) -> Score:
    """Score a run.

    Args:
        log: The run.
        mocap: The object's track in the hand's world frame.
        symmetry: Rotations of the object onto itself, xyzw [S, 4].
        offset_s: Time of the export at the log's beginning [s]; None to find it.

    Raises:
        MocapError: The export does not cover the run, or no offset stands out.
    """
    if offset_s is None:
        offset_s = float(log.run["unix_s"]) if mocap.unix else find_offset(log, mocap)
    mocap = replace(mocap, time_s=mocap.time_s - offset_s)
    end = log.columns["t"][-1]
    if mocap.time_s[-1] < 0.0 or mocap.time_s[0] > end:
        raise MocapError(
            f"{mocap.path} covers {mocap.time_s[0]:.1f} to {mocap.time_s[-1]:.1f} s of the log's time, "
            f"the log 0 to {end:.1f} s; name the clocks' offset with --offset-s, or export the right take"
        )
    trials = []
    for stop in log.stops:
        row = int(np.argmin(np.abs(np.where(mocap.tracked, mocap.time_s, np.inf) - stop.time_s)))
        tracked = bool(mocap.tracked[row] and abs(mocap.time_s[row] - stop.time_s) <= NEAR_S)
        error = None
        if tracked and stop.outcome == "stopped":
            error = float(symmetric_error(mocap.pose[row, 3:], np.array(stop.goal_quat), symmetry))
        trials.append(Trial(stop.goal, stop.time_s, stop.outcome, tracked, error, stop.distance))
    kept = [trial for trial in trials if not trial.discarded]
    errors = np.array([np.inf if trial.error_rad is None else trial.error_rad for trial in kept])
    found = errors[np.isfinite(errors)]
    rates = []
    if len(kept):
        outcomes = np.stack([errors <= tolerance for tolerance in TOLERANCES_RAD])[:, None, :]
        rates = rate_intervals(outcomes, "episode")
    return Score(
        log,
        mocap,
        offset_s,
        tuple(trials),
        median_interval(found[None], "episode") if len(found) else None,
        tuple(zip(TOLERANCES_RAD, rates, strict=False)),
    )


def step_errors(log: HandLog, mocap: Mocap, times: np.ndarray, symmetry: np.ndarray) -> np.ndarray:
    """Angle to the goal that is pursued at the log's steps, the track read at ``times`` [rad]; NaN: lost."""
    row = np.clip(np.searchsorted(mocap.time_s, times), 1, len(mocap.time_s) - 1)
    row -= times - mocap.time_s[row - 1] < mocap.time_s[row] - times
    near = np.abs(mocap.time_s[row] - times) <= NEAR_S
    goals = log.goals[log.columns["goal"].astype(int)]
    pose = mocap.pose[row]
    known = near & np.isfinite(pose).all(axis=1)
    errors = np.full(len(times), np.nan)
    errors[known] = symmetric_error(pose[known, 3:], goals[known], symmetry)
    return errors


def find_offset(log: HandLog, mocap: Mocap) -> float:
    """Time of the export at the log's beginning [s], at which errors agree best with the predicted distances.

    Policies predict the distance without regard to symmetry, so none counts here.

    Raises:
        MocapError: No offset stands out.
    """
    predicted, t = log.columns["distance"], log.columns["t"]
    best, all_off = (np.inf, 0.0), []
    remedy = (
        f"{mocap.path}: its clock cannot be matched to the log's; give --offset-s, or export times in UTC"
    )
    first, last = mocap.time_s[0] - t[-1], mocap.time_s[-1] - t[0]
    for offset in np.arange(first, last, OFFSET_STEP_S):
        off = step_errors(log, mocap, t + offset, NO_SYMMETRY) - predicted
        off = off[np.isfinite(off)]
        if len(off) < LEAST_OVERLAP * np.count_nonzero(np.isfinite(predicted)) or not len(off):
            continue
        middle = float(np.median(np.abs(off - np.median(off))))  # a bias of the policy is no shift in time
        all_off.append(middle)
        best = min(best, (middle, float(offset)))
    if not all_off or best[0] > LEAST_FALL * np.median(all_off):
        raise MocapError(f"{remedy} (errors and predictions differ by {best[0]:.2f} rad at best)")
    return best[1]


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
        f"{result.scored} trials scored, {discarded} discarded since the markers were lost at the stop"
    )
    if result.median is not None:
        m = result.median
        rows.append(
            f"median error at {len(result.errors)} stops: {m.value:.2f} rad ({np.degrees(m.value):.0f} deg), "
            f"95 % {m.low:.2f} to {m.high:.2f}"
        )
    for tolerance, share in result.within:
        rows.append(
            f"within {tolerance:.1f} rad: {100 * share.value:3.0f} %, 95 % {100 * share.low:.0f} to "
            f"{100 * share.high:.0f} % of all that were scored"
        )
    return rows


def _degrees(angle: float | None) -> str:
    return "-" if angle is None or not np.isfinite(angle) else f"{np.degrees(angle):.0f}°"
