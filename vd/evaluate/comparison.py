"""Several policies on several groups of objects, each stopped by its own prediction and by the true distance.

Angles are radians, times seconds.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd.config import from_dict, to_dict
from vd.evaluate.result import EvalResult, Protocol, summarise
from vd.evaluate.statistics import Interval, choose_unit, rate_intervals
from vd.evaluate.trace import Trace
from vd.files import write_json
from vd.student.stopping import StoppingRule

COMPARISON_FORMAT = "visual-dexterity comparison 1"
OUTCOMES = ("success", "orientation error", "time-out", "object falls")
"""Classes of episodes: stopped within the tolerance, stopped outside of it, never stopped, lost."""
BOUNDS_RAD = (0.1, 0.4)
"""Distances at which predictions are judged, as in the paper."""
SCATTER = 2000
"""Pairs of predicted and true distance that are kept for a figure."""

StoppedBy = Literal["prediction", "true distance"]


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
    result: EvalResult
    """Episodes and summaries; their stops are those of ``stopped_by``."""


@dataclass(frozen=True)
class Bound:
    """How well a bound on the distance works, in one group."""

    bound_rad: float
    seen: float | None
    """Share of the states truly within the bound that are predicted within it; None without such states."""
    right: float | None
    """Share of the states predicted within the bound that truly are; None without such states."""
    by_prediction: Interval
    """Share of episodes that stop within the bound when the prediction has to be below it."""
    by_truth: Interval
    """The same for the true distance."""


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
    rule: StoppingRule,
    resample: Literal["auto", "object", "episode"] = "auto",
) -> tuple[list[Row], Prediction | None]:
    """Rows of one policy in one group, and what its predictions are worth if it is a student.

    Args:
        trace: Its episodes with the objects of the group.
        protocol: How they were run.
        objects: The objects (name and symmetry are read).
        kind: Of the policy.
        sees: What it sees.
        group: Name of the group.
        rule: The policy's own; the true distance is held against the tolerance of the protocol, with the same
            bound on the action.
        resample: Of the intervals.
    """
    true_rule = StoppingRule(protocol.stop_tolerance_rad, rule.action_norm)
    ways: list[tuple[StoppedBy, StoppingRule]] = [("true distance", true_rule)]
    if trace.predicted is not None:
        ways.insert(0, ("prediction", rule))
    rows = []
    for stopped_by, bounds in ways:
        episodes = trace.episodes(bounds, by_prediction=stopped_by == "prediction")
        result = summarise(
            protocol,
            tuple(item.name for item in objects),
            [item.symmetry for item in objects],
            episodes,
            resample=resample,
        )
        outcomes = outcome_shares(result, resample=resample)
        rows.append(Row(protocol.policy, kind, sees, group, stopped_by, bounds, outcomes, result))
    return rows, _prediction(trace, protocol.policy, group, rule.action_norm, resample)


def outcome_shares(
    result: EvalResult, *, resample: Literal["auto", "object", "episode"] = "auto"
) -> dict[str, Interval]:
    """Share of episodes in each class of OUTCOMES, with intervals."""
    shape = len(result.object_names), -1
    stopped = np.array([e.stopped for e in result.episodes]).reshape(shape)
    fell = np.array([e.fell for e in result.episodes]).reshape(shape)
    right = np.array([e.error_rad <= result.protocol.stop_tolerance_rad for e in result.episodes]).reshape(
        shape
    )
    classes = np.stack([stopped & right, stopped & ~right, ~stopped & ~fell, ~stopped & fell])
    unit = choose_unit(len(result.object_names), resample)
    return dict(zip(OUTCOMES, rate_intervals(classes, unit), strict=True))


def _prediction(
    trace: Trace,
    policy: str,
    group: str,
    action_norm: float,
    resample: Literal["auto", "object", "episode"],
) -> Prediction | None:
    if trace.predicted is None:
        return None
    there = np.isfinite(trace.predicted)
    true, predicted = trace.distance[there], trace.predicted[there]
    unit = choose_unit(len(trace.steps), resample)

    def stops_within(bound: float, *, by_prediction: bool) -> Interval:
        steps, stopped = trace.ends(StoppingRule(bound, action_norm), by_prediction=by_prediction)
        error = np.take_along_axis(trace.error, steps[..., None], axis=-1)[..., 0]
        return rate_intervals((stopped & (error <= bound))[None], unit)[0]

    bounds = []
    for bound in BOUNDS_RAD:
        near, said = true <= bound, predicted <= bound
        bounds.append(
            Bound(
                bound_rad=bound,
                seen=float(said[near].mean()) if near.any() else None,
                right=float(near[said].mean()) if said.any() else None,
                by_prediction=stops_within(bound, by_prediction=True),
                by_truth=stops_within(bound, by_prediction=False),
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
