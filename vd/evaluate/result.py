"""What an evaluation found: a row for each policy, group of objects, condition and way to stop.

Angles are radians, times seconds, quaternions xyzw. K objects, M episodes of each.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd.command.config import from_dict, to_dict
from vd.command.files import write_json
from vd.evaluate.goals import ONE_GOAL, Goals, GoalSchedule
from vd.evaluate.statistics import (
    TOLERANCES_RAD,
    Interval,
    Unit,
    choose_unit,
    median_interval,
    order_interval,
    paired_difference,
    rate_intervals,
    share_among,
)
from vd.evaluate.trace import Episode, Trace, Way, at_steps
from vd.paper import PAPER
from vd.policy.stopping import StoppingRule
from vd.sim.cfg import Engine

RESULT_FORMAT = "visual-dexterity evaluation 9"
BOUNDS_RAD = (PAPER.success.precise_rad, PAPER.success.rotation_rad)
"""Bounds on the distance at which predictions are judged, as in the paper."""
OUTCOMES = ("success", "orientation error", "time-out", "object falls")
"""Classes of episodes: stopped within the tolerance of the very goal, stopped outside of it, never
stopped, lost."""

StoppedBy = Literal["prediction", "true distance", "success criteria of training"]
SUCCESS: StoppedBy = "success criteria of training"
ANY_ACTION = 100.0
"""Bound that no norm of an action exceeds: others who count consecutive successes ask for none."""


@dataclass(frozen=True)
class Protocol:
    """How the episodes were run."""

    objects: str
    """Object sets as they were named."""
    hand: str
    hand_layer: str | None
    """Layer over the hand with an identified servo model, if any."""
    episodes: int
    """Episodes of each object, M."""
    seed: int
    """Of starts, goals, and the randomisation if it is on."""
    max_goal_angle_rad: float
    """Goals are uniform in orientation within this angle of the start; pi is all of SO(3)."""
    stop_tolerance_rad: float
    """Orientation tolerance at which an episode is stopped and judged."""
    episode_s: float
    """Time limit."""
    control_hz: float
    """Policy rate."""
    randomisation: str = "off"
    """What is drawn: ``off``, or a name of :mod:`vd.evaluate.conditions`."""
    at_rest: bool = False
    """Objects start at rest on the table, and starts and goals are those the environment draws;
    otherwise they fall, with starts uniform on SO(3), the same for any environment."""
    goals_about_vertical: bool = False
    """Goals only turn the object about the vertical."""
    palm_up: bool = False
    """Objects rest in the hand; there is no table."""
    in_air: bool = False
    """The table is taken away once the hand had time to grasp."""
    air_goals: bool = False
    """The same, and only then come the goals that count, in a row."""
    consecutive: bool = False
    """Goal after goal until one fails; ``episode_s`` is the time for each."""
    table_friction: float | None = None
    """Coefficient of the table if it is not the nominal one."""
    goals: Goals = "points"
    """What camera policies know shapes and goals by."""
    sensor_errors: bool = False
    """Cameras have the errors of a real one."""
    engine: Engine = "newton"
    """What steps the physics."""


@dataclass(frozen=True)
class Summary:
    """Rates and medians of all objects, or of one."""

    name: str
    """Object, or ``all``."""
    episodes: int
    unit: Unit
    """What the intervals speak about."""
    outcomes: dict[str, Interval]
    """Share of episodes in each class of OUTCOMES."""
    success: dict[str, Interval]
    """By tolerance [rad] (as text): share of episodes that ended within it of the very goal, not
    lost.
    """
    symmetric: Interval
    """Share of episodes stopped within the tolerance of what looks like the goal; where the true
    distance decides, it is that distance."""
    median_error_rad: Interval
    """Median final error to the very goal; a lost object counts as pi."""
    time_s: Interval | None
    """Median time to the stop of the episodes that succeeded; None if none did."""


@dataclass(frozen=True)
class Prediction:
    """Predicted beside true distances of a camera policy, in all states of all episodes."""

    states: int
    mean_error_rad: float
    """Mean absolute difference."""
    seen: dict[str, float | None]
    """By bound [rad] (as text): share of the states truly within it that are predicted within it;
    None without such states."""
    right: dict[str, float | None]
    """By bound: share of the states predicted within it that truly are; None without such
    states.
    """


@dataclass(frozen=True)
class InAir:
    """Goal after goal in the air (``AIR_GOALS``)."""

    held: Interval
    """Share of episodes in which the object was still held when the first goal was drawn."""
    first: float | None
    """Share of these in which it was reached; None, here and below: of none."""
    in_a_row: Interval
    """Share of episodes in which all goals were reached."""
    lost: float | None
    """Share of those that were held in which the object was lost on the way."""
    let_go: float | None
    """Share of the objects with which the first goal was reached that holding still lost."""


@dataclass(frozen=True)
class Consecutive:
    """Goals reached one after the other (``CONSECUTIVE``), of all objects or of one."""

    name: str
    """Object, or ``all``."""
    mean: float
    """Successes in a row, of all episodes."""
    median: float
    goals: float
    """Share of all goals that were reached."""
    lost: float
    """Share of episodes that ended because the object was lost."""
    full: float
    """Share of episodes in which all goals were reached."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One policy on one group of objects in one condition, under one way to stop."""

    policy: str
    """As it was named."""
    kind: str
    """teacher, vision, student, function, zero, random."""
    sees: str
    """state, rendered clouds or nothing."""
    group: str
    """Name of the group of objects."""
    condition: str
    """Of the suite; empty: none."""
    stopped_by: StoppedBy
    rule: StoppingRule
    """Bounds of the distance and of the action's norm."""
    protocol: Protocol
    object_names: tuple[str, ...]
    overall: Summary
    per_object: tuple[Summary, ...]
    held: Interval | None = None
    """Share of episodes stopped so, and still there after the hand has held for HOLD_S; None: not
    tried.
    """
    precise: Interval | None = None
    """Share of episodes that stop within 0.1 rad of the very goal, by the rule for that; None: not
    tried.
    """
    prediction: Prediction | None = None
    """What its predictions are worth; None: they do not stop it."""
    warnings: dict[str, str]
    """By name of an object: what its import says may be wrong with it; and by policy, object and
    condition in how many episodes the physics failed, which ended there."""
    episodes: tuple[Episode, ...]
    """K x M, object by object; of goals in a row those of the first."""
    in_air: InAir | None = None
    """What became of goals in a row in the air, if there were any."""
    consecutive: tuple[Consecutive, ...] = ()
    """Of consecutive goals, if there were any: of all objects, then of each."""

    @property
    def successes(self) -> np.ndarray:
        """Which episodes were stopped within the tolerance of the very goal, bool [K, M]."""
        return _outcomes(self.episodes, self.protocol)[0]

    @property
    def headline(self) -> bool:
        """Whether it is judged first: by the prediction if there is one, else the true distance."""
        by_prediction = self.sees.endswith("clouds")
        return self.stopped_by == ("prediction" if by_prediction else "true distance")


@dataclass(frozen=True)
class Result:
    """Everything that was evaluated."""

    rows: tuple[Row, ...]
    software: dict[str, str] = field(default_factory=dict)
    missing: tuple[tuple[str, str, str], ...] = ()
    """Conditions of a suite that have no row, the policy, and why."""
    format: str = RESULT_FORMAT

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of the policies, in order."""
        return tuple(dict.fromkeys(row.policy for row in self.rows))

    @property
    def warnings(self) -> dict[str, str]:
        """What may be wrong with objects, by name."""
        warnings: dict[str, str] = {}
        for row in self.rows:
            warnings |= row.warnings
        return warnings

    def headlines(self) -> dict[tuple[str, str], dict[str, Row]]:
        """The headline row of each policy, by condition and group."""
        headlines: dict[tuple[str, str], dict[str, Row]] = {}
        for row in self.rows:
            if row.headline:
                headlines.setdefault((row.condition, row.group), {})[row.policy] = row
        return headlines

    def differences(self) -> list[tuple[Row, Row, Interval]]:
        """Every policy beside the first, and how much larger its share of success is, paired."""
        differences = []
        for row_of in self.headlines().values():
            first, *others = row_of.values()
            for other in others:
                if other.protocol.episodes == first.protocol.episodes:
                    interval = paired_difference(other.successes, first.successes)
                    differences.append((first, other, interval))
        return differences

    def summary(self) -> dict[str, Any]:
        """What is written, as JSON, without episodes."""
        summary = to_dict(self)
        for row in summary["rows"]:
            del row["episodes"]
        summary["differences"] = []
        for first, other, interval in self.differences():
            compared = {
                "policy": other.policy,
                "from": first.policy,
                "condition": first.condition,
                "group": first.group,
            }
            summary["differences"].append(compared | to_dict(interval))
        return summary

    def write(self, path: Path) -> None:
        """Write as JSON, atomically."""
        write_json(path, to_dict(self))

    @staticmethod
    def read(path: Path) -> "Result":
        """Read what :meth:`write` wrote.

        Raises:
            ValueError: Not such a file, or of another version.
        """
        values: Any = json.loads(Path(path).read_text())
        try:
            written = values["format"]
            if written != RESULT_FORMAT:
                raise ValueError(f"format is {written!r}, expected {RESULT_FORMAT!r}")
            return from_dict(Result, values)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: {error}; run vd-eval again") from error


@dataclass(frozen=True)
class Agent:
    """Who acts, and when it is stopped."""

    policy: str
    """Its name."""
    kind: str
    sees: str
    """Both as of :class:`Row`."""
    rules: Callable[[float], StoppingRule]
    """Its own rule for a tolerance [rad]."""

    def ways_to_stop(
        self, tolerance_rad: float, schedule: GoalSchedule = ONE_GOAL
    ) -> dict[StoppedBy, Way]:
        """The ways to stop it within a tolerance [rad], the headline first.

        They are bounds of the distance that it predicts, if it does, and of the true one, both with
        the released code's bound of the action's norm. What predicts nothing is stopped by the
        success criteria of training, too. Goals in a row depend on what stops it: there the first
        way is the only one.
        """
        norm = ANY_ACTION if schedule.distance_alone else PAPER.success.action_norm
        true = StoppingRule(tolerance_rad, norm)
        predicts = self.sees.endswith("clouds")
        ways: dict[StoppedBy, Way] = {}
        if predicts:
            ways["prediction"] = (replace(self.rules(tolerance_rad), action_norm=norm), "predicted")
        ways["true distance"] = (true, "exact")
        if not predicts:
            ways[SUCCESS] = (true, "success")
        if schedule.most > 1:
            return dict([next(iter(ways.items()))])
        return ways


def judge(
    trace: Trace,
    protocol: Protocol,
    objects: list[Any],
    agent: Agent,
    *,
    group: str,
    condition: str = "",
) -> list[Row]:
    """Rows of one policy, one for each way to stop, from its episodes with a group of objects."""
    tolerance = protocol.stop_tolerance_rad
    schedule = trace.schedule
    in_a_row = schedule.most > 1
    in_air = in_a_row and schedule.first_s > 0.0
    names = tuple(item.name for item in objects)
    rows = []
    for stopped_by, way in agent.ways_to_stop(tolerance, schedule).items():
        rule, by = way
        episodes = trace.episodes(rule, by)
        of_symmetry: Way = (rule, "error" if by == "exact" else by)
        alike = _stopped_within(trace, of_symmetry, trace.error, tolerance)
        per_object = []
        for k, name in enumerate(names):
            chosen = slice(k * protocol.episodes, (k + 1) * protocol.episodes)
            per_object.append(summarise(name, episodes[chosen], alike[k : k + 1], protocol))
        rows.append(
            Row(
                policy=agent.policy,
                kind=agent.kind,
                sees=agent.sees,
                group=group,
                condition=condition,
                stopped_by=stopped_by,
                rule=rule,
                protocol=protocol,
                object_names=names,
                overall=summarise("all", episodes, alike, protocol),
                per_object=tuple(per_object),
                held=None if in_a_row else _held(trace, way, tolerance),
                precise=None if in_a_row else _precise(trace, agent, stopped_by),
                prediction=_prediction(trace) if by == "predicted" and not in_a_row else None,
                warnings=_warnings(trace, agent, objects, condition),
                episodes=episodes,
                in_air=_in_air(trace, way) if in_air else None,
                consecutive=_consecutive(trace, names) if in_a_row and not in_air else (),
            )
        )
    return rows


def _held(trace: Trace, way: Way, tolerance: float) -> Interval | None:
    """Share of episodes stopped a way within a tolerance [rad], and held there."""
    if way not in trace.held:
        return None
    stopped = _stopped_within(trace, way, trace.exact, tolerance)
    return rate_intervals((stopped & (trace.held[way] <= tolerance))[None])[0]


def _precise(trace: Trace, agent: Agent, stopped_by: StoppedBy) -> Interval:
    """Share of episodes stopped within 0.1 rad by the rule for that."""
    tolerance = PAPER.success.precise_rad
    way = agent.ways_to_stop(tolerance)[stopped_by]
    return rate_intervals(_stopped_within(trace, way, trace.exact, tolerance)[None])[0]


def _warnings(trace: Trace, agent: Agent, objects: list[Any], condition: str) -> dict[str, str]:
    """What imports said of the objects, and in how many episodes the physics failed."""
    warnings = {item.name: "; ".join(item.warnings) for item in objects if item.warnings}
    count = trace.failed.shape[1]
    for item, bad in zip(objects, trace.failed.sum(axis=1), strict=True):
        if bad:
            name = " ".join((agent.policy, item.name, condition)).strip()
            warnings[name] = f"physics failed in {bad} of {count} episodes"
    return warnings


def _in_air(trace: Trace, way: Way) -> InAir:
    first = trace.reached > 0
    in_a_row = trace.reached == trace.schedule.most
    shares = rate_intervals(np.stack([trace.given, in_a_row]))
    return InAir(
        held=shares[0],
        first=share_among(first, trace.given),
        in_a_row=shares[1],
        lost=share_among(trace.fell, trace.given),
        let_go=share_among(trace.held[way] >= np.pi, first),
    )


def _consecutive(trace: Trace, names: Sequence[str]) -> tuple[Consecutive, ...]:
    """Of all objects, and of each."""
    parts = {"all": trace} | {name: trace.of([k]) for k, name in enumerate(names)}
    counts = []
    for name, part in parts.items():
        reached = part.reached
        full = reached == part.schedule.most
        counts.append(
            Consecutive(
                name,
                mean=float(reached.mean()),
                median=float(np.median(reached)),
                goals=float(reached.sum() / (reached.sum() + (~full).sum())),
                lost=float((part.fell & ~full).mean()),
                full=float(full.mean()),
            )
        )
    return tuple(counts)


def summarise(
    name: str,
    episodes: tuple[Episode, ...],
    alike: np.ndarray,
    protocol: Protocol,
) -> Summary:
    """Every rate, median and interval of some episodes, whole objects of them.

    ``alike`` says which were stopped within the tolerance of what looks like the goal, bool [K, M].
    """
    fell = _column(episodes, protocol, "fell")
    errors = np.where(fell, np.pi, _column(episodes, protocol, "exact_error_rad"))
    outcomes = _outcomes(episodes, protocol)
    within = [errors <= tolerance for tolerance in TOLERANCES_RAD]
    rates = rate_intervals(np.stack([*outcomes, *within, alike]))
    times = _column(episodes, protocol, "steps")[outcomes[0]] / protocol.control_hz
    return Summary(
        name=name,
        episodes=len(episodes),
        unit=choose_unit(len(errors)),
        outcomes=dict(zip(OUTCOMES, rates, strict=False)),
        success=dict(zip(map(str, TOLERANCES_RAD), rates[len(OUTCOMES) :], strict=False)),
        symmetric=rates[-1],
        median_error_rad=median_interval(errors),
        time_s=order_interval(times) if times.size else None,
    )


def _column(episodes: tuple[Episode, ...], protocol: Protocol, name: str) -> np.ndarray:
    """One field of episodes [K, M]."""
    return np.array([getattr(e, name) for e in episodes]).reshape(-1, protocol.episodes)


def _outcomes(episodes: tuple[Episode, ...], protocol: Protocol) -> np.ndarray:
    """Which episodes are in each class of OUTCOMES, bool [4, K, M]."""
    stopped = _column(episodes, protocol, "stopped")
    fell = _column(episodes, protocol, "fell")
    right = _column(episodes, protocol, "exact_error_rad") <= protocol.stop_tolerance_rad
    return np.stack([stopped & right, stopped & ~right, ~stopped & ~fell, ~stopped & fell])


def _stopped_within(trace: Trace, way: Way, error: np.ndarray, bound_rad: float) -> np.ndarray:
    """Which episodes a way stops within a bound of an error, one of the trace's, bool [K, M]."""
    steps, stopped = trace.ends(*way)
    return np.asarray(stopped & (at_steps(error, steps) <= bound_rad))


def _prediction(trace: Trace) -> Prediction:
    assert trace.predicted is not None
    known = np.isfinite(trace.predicted)
    true = trace.error[known]
    predicted = trace.predicted[known]
    seen = {}
    right = {}
    for bound in BOUNDS_RAD:
        seen[str(bound)] = share_among(predicted <= bound, true <= bound)
        right[str(bound)] = share_among(true <= bound, predicted <= bound)
    error = float(np.abs(predicted - true).mean())
    return Prediction(states=len(true), mean_error_rad=error, seen=seen, right=right)
