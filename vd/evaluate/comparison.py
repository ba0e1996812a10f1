"""What an evaluation found: one policy or several on groups of objects, each stopped in several ways.

Angles are radians, times seconds.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd.config import from_dict, to_dict
from vd.evaluate.result import EvalResult, Protocol, summarise, warnings_of
from vd.evaluate.statistics import Interval, Unit, choose_unit, rate_intervals
from vd.evaluate.trace import StopsBy, Trace
from vd.files import write_json
from vd.paper import PAPER
from vd.stopping import StoppingRule

COMPARISON_FORMAT = "visual-dexterity evaluation 6"
OUTCOMES = ("success", "orientation error", "time-out", "object falls")
"""Classes of episodes: stopped within the tolerance of the very goal, stopped outside of it, never stopped,
lost."""
BOUNDS_RAD = (PAPER.success.precise_rad, PAPER.success.rotation_rad)
"""Bounds on the distance at which stops and predictions are judged, as in the paper."""
SCATTER = 2000
"""Pairs of predicted and true distance that are kept for a figure."""

StoppedBy = Literal["prediction", "true distance", "success criteria of training"]
SUCCESS: StoppedBy = "success criteria of training"
OWN_NORM = "its own bound of the action"
"""Mark of rows that are ours: stopped by the bound of the action's norm that a student's file has."""


@dataclass(frozen=True)
class Row:
    """One policy on one group of objects under one way to stop."""

    policy: str
    """As it was named."""
    kind: str
    """teacher, zero, random, student of stage 1 or 2."""
    sees: str
    """state, complete clouds or rendered clouds."""
    group: str
    """Name of the group of objects."""
    stopped_by: StoppedBy
    rule: StoppingRule
    """Bounds of the distance and of the action's norm."""
    outcomes: dict[str, Interval]
    """Share of episodes in each class."""
    held: Interval | None
    """Share of episodes stopped so, and still there after the hand has held for HOLD_S; None: not tried."""
    symmetric: Interval
    """Share of episodes stopped within the tolerance of what looks like the goal; where the true distance
    decides, it is that distance."""
    stops_within: dict[str, Interval]
    """By tolerance [rad] (as text): share of episodes that stop within it, by the rule for this tolerance."""
    result: EvalResult
    """Episodes and summaries; their stops are those of ``stopped_by``."""
    ours: str = ""
    """What of it is ours, not the paper's; empty for the conditions of the paper."""


@dataclass(frozen=True)
class Bound:
    """How well predictions tell which states are within a bound, in one group."""

    bound_rad: float
    seen: float | None
    """Share of the states truly within the bound that are predicted within it; None without such states."""
    right: float | None
    """Share of the states predicted within the bound that truly are; None without such states."""


@dataclass(frozen=True)
class Prediction:
    """Predicted beside true distances of a student in one group, in all states of all episodes."""

    policy: str
    group: str
    states: int
    """Number of states."""
    mean_error_rad: float
    """Mean absolute difference."""
    bounds: tuple[Bound, ...]
    """At each of BOUNDS_RAD."""
    true_rad: tuple[float, ...]
    """A sample of the true distances."""
    predicted_rad: tuple[float, ...]
    """The predictions that belong to them."""


@dataclass(frozen=True)
class Comparison:
    """Everything that was compared."""

    rows: tuple[Row, ...]
    predictions: tuple[Prediction, ...]
    format: str = COMPARISON_FORMAT
    software: dict[str, str] = field(default_factory=dict)

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups, in order."""
        return tuple(dict.fromkeys(row.group for row in self.rows))

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of the policies, in order."""
        return tuple(dict.fromkeys(row.policy for row in self.rows))

    @property
    def warnings(self) -> dict[str, str]:
        """What may be wrong with objects, by name."""
        return {name: words for row in self.rows for name, words in row.result.warnings.items()}

    def summary(self) -> dict[str, Any]:
        """What is written, as JSON, without episodes and states."""
        found = to_dict(self)
        for row in found["rows"]:
            del row["result"]["episodes"]
        for entry in found["predictions"]:
            del entry["true_rad"], entry["predicted_rad"]
        return found

    def write(self, path: Path) -> None:
        """Write as JSON, atomically."""
        write_json(path, to_dict(self))

    @staticmethod
    def read(path: Path) -> "Comparison":
        """Read what :meth:`write` wrote.

        Raises:
            ValueError: Not such a file, or of another version.
        """
        values: Any = json.loads(Path(path).read_text())
        found = values.get("format") if isinstance(values, dict) else None
        if found != COMPARISON_FORMAT:
            raise ValueError(
                f"{path}: format is {found!r}, expected {COMPARISON_FORMAT!r}; run vd-eval again"
            )
        return from_dict(Comparison, values)


def judge(
    trace: Trace,
    protocol: Protocol,
    objects: list[Any],
    *,
    kind: str,
    sees: str,
    group: str,
    rules: Callable[[float], StoppingRule],
    resample: Literal["auto", "object", "episode"] = "auto",
) -> tuple[list[Row], Prediction | None]:
    """Rows of one policy in one group, and what its predictions are worth if it is a student.

    Args:
        trace: Its episodes with the objects of the group.
        protocol: How they were run.
        objects: The objects (name and warnings are read).
        kind: Of the policy.
        sees: What it sees.
        group: Name of the group.
        rules: The policy's own rule for a tolerance [rad], see :func:`ways_to_stop`.
        resample: Of the intervals.
    """
    rows, unit = [], choose_unit(len(objects), resample)
    for way in ways_to_stop(rules, protocol.stop_tolerance_rad, predicts=trace.predicted is not None):
        result = summarise(
            protocol,
            tuple(item.name for item in objects),
            trace.episodes(way.rule, way.by),
            resample=resample,
            warnings=warnings_of(objects),
        )
        rows.append(
            Row(
                policy=protocol.policy,
                kind=kind,
                sees=sees,
                group=group,
                stopped_by=way.stopped_by,
                rule=way.rule,
                outcomes=outcome_shares(result, resample=resample),
                held=_held(trace, way, protocol.stop_tolerance_rad, unit),
                symmetric=_symmetric(trace, way, protocol.stop_tolerance_rad, unit),
                stops_within=_stops_within(trace, rules, way, unit),
                result=result,
                ours=way.ours,
            )
        )
    return rows, _prediction(trace, protocol.policy, group)


@dataclass(frozen=True)
class Way:
    """A way to stop the episodes of a policy."""

    stopped_by: StoppedBy
    rule: StoppingRule
    by: StopsBy
    ours: str = ""


def ways_to_stop(
    rules: Callable[[float], StoppingRule], tolerance_rad: float, *, predicts: bool
) -> list[Way]:
    """The ways to stop a policy, the headline first.

    They are the bounds of the distance that it predicts, if it does, and of the true one, both with the
    released code's bound of the action's norm; and, as ours, its own bound of the norm where that is another.
    What predicts nothing is stopped by the success criteria of training, too.

    Args:
        rules: The policy's own rule for a tolerance [rad].
        tolerance_rad: Of the stop; bound of the true distance, too.
        predicts: Whether it predicts distances.
    """
    own, norm = rules(tolerance_rad), PAPER.success.action_norm
    ways = [Way("true distance", StoppingRule(tolerance_rad, norm), "exact")]
    if predicts:
        ways.insert(0, Way("prediction", replace(own, action_norm=norm), "predicted"))
        if own.action_norm != norm:
            ways.append(Way("prediction", own, "predicted", OWN_NORM))
    else:
        ways.append(Way(SUCCESS, StoppingRule(tolerance_rad, norm), "success"))
    return ways


def outcome_shares(
    result: EvalResult, *, resample: Literal["auto", "object", "episode"] = "auto"
) -> dict[str, Interval]:
    """Share of episodes in each class of OUTCOMES, with intervals."""
    shape = len(result.object_names), -1
    stopped = np.array([e.stopped for e in result.episodes]).reshape(shape)
    fell = np.array([e.fell for e in result.episodes]).reshape(shape)
    tolerance = result.protocol.stop_tolerance_rad
    right = np.array([e.exact_error_rad <= tolerance for e in result.episodes]).reshape(shape)
    classes = np.stack([stopped & right, stopped & ~right, ~stopped & ~fell, ~stopped & fell])
    unit = choose_unit(len(result.object_names), resample)
    return dict(zip(OUTCOMES, rate_intervals(classes, unit), strict=True))


def _held(trace: Trace, way: Way, tolerance_rad: float, unit: Unit) -> Interval | None:
    """Share of episodes stopped within the tolerance of the very goal, and still there after the hold."""
    hold = trace.hold(way.rule, way.by)
    if hold is None:
        return None
    _, error = _at_stop(trace, way.rule, way.by, trace.exact)
    with np.errstate(invalid="ignore"):  # what was never stopped was not held
        return rate_intervals(((error <= tolerance_rad) & (hold.exact <= tolerance_rad))[None], unit)[0]


def _symmetric(trace: Trace, way: Way, tolerance_rad: float, unit: Unit) -> Interval:
    """Share of episodes that are stopped within the tolerance of what looks like the goal."""
    by: StopsBy = "error" if way.by == "exact" else way.by
    stopped, error = _at_stop(trace, way.rule, by, trace.error)
    return rate_intervals((stopped & (error <= tolerance_rad))[None], unit)[0]


def _stops_within(
    trace: Trace, rules: Callable[[float], StoppingRule], way: Way, unit: Unit
) -> dict[str, Interval]:
    """Share of episodes that stop within each of BOUNDS_RAD of the very goal by the rule for it."""
    within = []
    for bound in BOUNDS_RAD:
        ways = ways_to_stop(rules, bound, predicts=trace.predicted is not None)
        same = next((w for w in ways if (w.by, w.ours) == (way.by, way.ours)), None)
        # A rule that has the paper's bound for this tolerance has no other of its own.
        rule = rules(bound) if same is None else same.rule
        stopped, error = _at_stop(trace, rule, way.by, trace.exact)
        within.append(stopped & (error <= bound))
    return dict(zip(map(str, BOUNDS_RAD), rate_intervals(np.stack(within), unit), strict=True))


def _at_stop(
    trace: Trace, rule: StoppingRule, by: StopsBy, error: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether a rule stops each episode, and the error where it ends, one of the trace's [K, M]."""
    steps, stopped = trace.ends(rule, by)
    return stopped, np.take_along_axis(error, steps[..., None], axis=-1)[..., 0]


def _prediction(trace: Trace, policy: str, group: str) -> Prediction | None:
    if trace.predicted is None:
        return None
    there = np.isfinite(trace.predicted)
    true, predicted = trace.error[there], trace.predicted[there]
    bounds = []
    for bound in BOUNDS_RAD:
        near, said = true <= bound, predicted <= bound
        bounds.append(
            Bound(
                bound_rad=bound,
                seen=float(said[near].mean()) if near.any() else None,
                right=float(near[said].mean()) if said.any() else None,
            )
        )
    shown = np.random.default_rng(0).permutation(len(true))[:SCATTER]
    return Prediction(
        policy=policy,
        group=group,
        states=len(true),
        mean_error_rad=float(np.abs(predicted - true).mean()),
        bounds=tuple(bounds),
        true_rad=tuple(round(float(value), 4) for value in true[shown]),
        predicted_rad=tuple(round(float(value), 4) for value in predicted[shown]),
    )
