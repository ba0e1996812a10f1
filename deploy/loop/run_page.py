"""What came of each goal of a run, from its log: in lines, and as a page with the film."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vd.command import interrupt
from vd.command.page import write_html
from vd.deploy.safety.safety import LEFT_ON
from vd.logs.hand_log import HandLog
from vd.logs.log_format import FINISHED, TRUTH_COLUMNS

FILM_FILE, PAGE_FILE = "run.mp4", "run.html"
ORIENTATION = TRUTH_COLUMNS[3:7]
"""Columns of the object's orientation."""
ABORTED = "aborted"
"""Outcome of a goal that was still pursued when the run ended."""


@dataclass(frozen=True)
class GoalResult:
    """How the pursuit of a goal ended."""

    goal: int
    """Number of the goal."""
    outcome: str
    """``stopped`` by the policy, ``time limit``, ``lost`` or ``aborted``."""
    seconds: float
    """How long it was pursued [s]."""
    predicted_rad: float | None = None
    """Distance to the goal that the policy stopped by [rad]; None where it has none."""
    error_rad: float | None = None
    """True angle to the goal at the end, up to symmetry [rad]; None where nobody knows: on a real
    hand.
    """
    success: bool | None = None
    """Whether the policy stopped within the tolerance; None where nobody knows."""
    turned: float | None = None
    """Revolutions about the axis of a policy without goals; None where nobody knows."""

    def __str__(self) -> str:
        """In one line."""
        if self.turned is not None:
            return f"turned {self.turned:z.2f} times: {self.outcome} after {self.seconds:.1f} s"
        words = {True: "reached", False: "not reached", None: "error not known"}[self.success]
        far = "" if self.error_rad is None else f", {self.error_rad:.2f} rad from it"
        predicted = "" if self.predicted_rad is None else f", predicted {self.predicted_rad:.2f}"
        ended = f"{self.outcome} after {self.seconds:.1f} s"
        return f"goal {self.goal + 1}: {words}: {ended}{far}{predicted}"


def goal_results(log: HandLog) -> list[GoalResult]:
    """How each goal ended that was pursued."""
    columns = log.columns
    outcomes = {stop.goal: stop.outcome for stop in log.stops}
    axis = log.run.get("spin_axis")
    truth_known = "error" in columns
    acting = columns["acting"] > 0.0
    results = []
    for goal in np.unique(columns["goal"][acting]).astype(int):
        rows = np.flatnonzero(acting & (columns["goal"] == goal))
        last = rows[-1]
        predicted = float(columns["distance"][last])
        result = GoalResult(
            goal=int(goal),
            outcome=outcomes.get(goal, ABORTED),
            seconds=float(columns["t"][last] - columns["t"][rows[0]]),
            predicted_rad=None if np.isnan(predicted) else predicted,
        )
        if truth_known and axis is not None:
            orientation = np.stack([columns[name][rows] for name in ORIENTATION], axis=1)
            result = replace(result, turned=revolutions(orientation, axis))
        elif truth_known:
            error = float(columns["error"][last])
            success = result.outcome == "stopped" and error <= log.tolerance_rad
            result = replace(result, error_rad=error, success=success)
        results.append(result)
    return results


def revolutions(quat: np.ndarray, axis: Sequence[float]) -> float:
    """Turns about an axis, world frame, of orientations xyzw one after the other [T, 4]."""
    turns = Rotation.from_quat(quat)
    moved = (turns[1:] * turns[:-1].inv()).as_rotvec().sum(axis=0)
    return float(moved @ axis / (np.linalg.norm(axis) * 2.0 * np.pi))


def summary_line(results: Sequence[GoalResult], goals: int) -> str:
    """How many goals were reached of those that were to be pursued, or how far what spins turned."""
    turns = [result.turned for result in results if result.turned is not None]
    if turns:
        return f"{sum(turns):z.2f} revolutions"
    if any(result.success is None for result in results):
        stopped = sum(result.outcome == "stopped" for result in results)
        return f"{stopped} of {goals} goals stopped; vd-deploy score tells the errors"
    return f"{sum(bool(result.success) for result in results)} of {goals} goals reached"


def ending(log: HandLog) -> list[str]:
    """Why a run ended, and which motors may still have their torque on, in sentences."""
    end_reason = str(log.run.get("end", {}).get("reason", ""))
    if log.stopped is None:
        unknown = "Nobody noted that the torque went off: every motor may be on. Cut their power."
        return [f"Ended: {end_reason or 'without a word, as a program that is killed'}.", unknown]
    reason, may_be_on = log.stopped
    sentences = [f"Stopped: {reason}."]
    if reason == FINISHED:
        sentences = [f"Ended: {end_reason or reason}."]
    if not may_be_on:
        return [*sentences, "The torque of every motor is off."]
    if LEFT_ON in may_be_on.values():
        return [*sentences, "The hand holds, its torque is on."]
    motors = "; ".join(f"{id} ({why})" for id, why in may_be_on.items())
    return [*sentences, f"Motors that may still be on, cut their power: {motors}."]


def write_page(log: HandLog, results: Sequence[GoalResult], *, filmed: bool = True) -> Path:
    """Write the film of a run, if the extra ``video`` is there, and the page that shows it.

    Args:
        log: Of the run.
        results: How each of its goals ended.
        filmed: Whether to draw the film.

    Returns:
        The page.

    Raises:
        LogError: Hand or object are not here any more.
    """
    from vd.play.replay import film

    able = find_spec("imageio_ffmpeg") is not None
    film_path = log.path / FILM_FILE if filmed and able else None
    if film_path is not None:
        film(log, film_path)
    write_html(
        log.path / PAGE_FILE,
        "run.html",
        run=log.run,
        goals=len(log.goals),
        summary=summary_line(results, len(log.goals)),
        ending=ending(log),
        film=film_path,
        remedy=f"vd-play {log.path}" if able else interrupt.remedy("imageio_ffmpeg"),
        rows=list(map(_page_row, results)),
        tolerance_rad=f"{log.tolerance_rad:g}" if "error" in log.columns else None,
    )
    return log.path / PAGE_FILE


def _page_row(result: GoalResult) -> tuple[object, ...]:
    """A row of the page's table; what nobody knows is left empty."""
    predicted = "" if result.predicted_rad is None else f"{result.predicted_rad:.2f}"
    error = "" if result.error_rad is None else f"{result.error_rad:.2f}"
    reached = {True: "yes", False: "no", None: ""}[result.success]
    return result.goal + 1, result.outcome, f"{result.seconds:.1f}", predicted, error, reached
