"""Episodes of one policy as one rule ends them, and the summary computed from them.

Angles are radians, times seconds, quaternions xyzw.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from vd.assets_usd.objects.model import ObjectModel
from vd.evaluate.goals import Goals
from vd.evaluate.statistics import (
    Interval,
    Unit,
    chance_cdf,
    choose_unit,
    median_interval,
    order_interval,
    rate_intervals,
    rotation_angle,
)
from vd.paper import PAPER

TOLERANCES_RAD = (0.1, 0.2, 0.4, 0.8)
"""Errors at which success is reported; the paper's figures use 0.1, 0.4 and 0.8."""


def air_table_steps(control_hz: float) -> int:
    """Control steps at this rate [Hz] after which the paper's in-air test takes the table away."""
    return round(PAPER.scene.air_table_s * control_hz)


@dataclass(frozen=True)
class Episode:
    """One start and one goal of one object, to its end or stop."""

    object_index: int
    """Index into :attr:`EvalResult.object_names`."""
    start_quat: tuple[float, float, float, float]
    """Object orientation at the reset."""
    goal_quat: tuple[float, float, float, float]
    """Goal orientation."""
    start_error_rad: float
    """Orientation error at the reset, up to the object's symmetry."""
    error_rad: float
    """Orientation error at the last step of the episode, up to the object's symmetry."""
    exact_error_rad: float
    """The same to the very goal, which is what counts."""
    steps: int
    """Control steps simulated."""
    stopped: bool
    """The rule that was asked for stopped it at the last step."""
    fell: bool
    """The object left the hand."""

    @property
    def scored_error_rad(self) -> float:
        """The error that counts: pi, the largest there is, for a dropped object."""
        return float(np.pi) if self.fell else self.exact_error_rad


@dataclass(frozen=True)
class Protocol:
    """How the episodes were run."""

    RETIRED: ClassVar[dict[str, Any]] = {"aim": False}
    policy: str
    """Checkpoint path, or the name of a built-in agent."""
    objects: str
    """Object set as it was named."""
    hand: str
    """Hand name."""
    episodes: int
    """Episodes per object, M."""
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
    randomised: bool
    """Domain randomisation, noise and disturbances as in training."""
    at_rest: bool = False
    """Objects start at rest on the table, and starts and goals are those the environment draws; otherwise
    they fall, with starts uniform on SO(3), the same for any environment."""
    goals_about_vertical: bool = False
    """Goals only turn the object about the vertical."""
    hand_layer: str | None = None
    """Layer over the hand with an identified servo model, if any."""
    in_air: bool = False
    """The table is taken away once the hand had time to grasp."""
    table_friction: float | None = None
    """Coefficient of the table if it is not the nominal one."""
    goals: Goals = "mesh"
    """What students know shapes and goals by."""
    sensor_errors: bool = False
    """Cameras of students have the errors of a real one."""
    second_view: bool = False
    """A goal that is not reached is looked at in other views (:mod:`vd.evaluate.second_view`)."""
    condition: str | None = None
    """What was drawn, of :mod:`vd.evaluate.conditions`; None: as in training, if at all."""

    @property
    def randomisation_text(self) -> str:
        """What was drawn, for people."""
        return self.condition or ("on" if self.randomised else "off")

    @property
    def hand_name(self) -> str:
        """The hand, and the layer over it."""
        return self.hand if self.hand_layer is None else f"{self.hand} with {self.hand_layer}"


@dataclass(frozen=True)
class Summary:
    """Rates and medians of all objects, or of one."""

    name: str
    """Object name, or ``all``."""
    episodes: int
    """Number of episodes behind it."""
    unit: Unit
    """What the intervals speak about."""
    success: dict[str, Interval]
    """By tolerance [rad] (as text): share of episodes that ended within it of the very goal, not dropped."""
    symmetric: dict[str, Interval]
    """The same up to the object's symmetry."""
    stop_rate: Interval
    """Share of episodes that the rule stopped."""
    drop_rate: Interval
    """Share of episodes in which the object was dropped."""
    median_error_rad: Interval
    """Median final error to the very goal; a dropped object counts as pi."""
    mean_error_rad: float
    """Mean final error to the very goal as measured, drops included, to compare with chance (2.21 rad)."""
    time_to_success_s: Interval | None
    """Median time to the stop of the episodes that stopped; None if none did."""
    chance: dict[str, float]
    """By tolerance: success of an orientation drawn uniformly from SO(3)."""
    start: dict[str, float]
    """By tolerance: success of leaving the object as it was at the reset."""


@dataclass(frozen=True)
class EvalResult:
    """Protocol, episodes and summaries."""

    protocol: Protocol
    object_names: tuple[str, ...]
    """K names."""
    overall: Summary
    """Over all objects."""
    per_object: tuple[Summary, ...]
    """In the order of ``object_names``."""
    episodes: tuple[Episode, ...]
    """K x M episodes, object by object."""
    warnings: dict[str, str] = field(default_factory=dict)
    """By name of an object: what its import says may be wrong with it."""

    def errors(self) -> np.ndarray:
        """Scored final errors [rad], shape [K, M]."""
        errors = np.array([episode.scored_error_rad for episode in self.episodes])
        return errors.reshape(len(self.object_names), -1)

    def start_errors(self) -> np.ndarray:
        """Errors to the very goal at the reset [rad], shape [K, M]."""
        quats = [np.array([getattr(e, name) for e in self.episodes]) for name in ("start_quat", "goal_quat")]
        errors = rotation_angle(*quats)
        return errors.reshape(len(self.object_names), -1)


def warnings_of(objects: Iterable[ObjectModel]) -> dict[str, str]:
    """What the import of objects says may be wrong with them, by name; nothing of those without a warning."""
    return {item.name: "; ".join(item.warnings) for item in objects if item.warnings}


def summarise(
    protocol: Protocol,
    object_names: tuple[str, ...],
    episodes: tuple[Episode, ...],
    *,
    resample: Literal["auto", "object", "episode"] = "auto",
    warnings: dict[str, str] | None = None,
) -> EvalResult:
    """Compute every rate, median and interval of some episodes.

    Args:
        protocol: How it was run.
        object_names: K names.
        episodes: K x M episodes, object by object.
        resample: What intervals speak about: ``object``, ``episode``, or by the number of objects.
        warnings: What may be wrong with objects, by name.
    """
    by_object = [episodes[i : i + protocol.episodes] for i in range(0, len(episodes), protocol.episodes)]
    if len(by_object) != len(object_names) or any(len(group) != protocol.episodes for group in by_object):
        raise ValueError(
            f"{len(episodes)} episodes are not {len(object_names)} objects x {protocol.episodes}"
        )
    return EvalResult(
        protocol=protocol,
        object_names=object_names,
        overall=_summary("all", by_object, choose_unit(len(object_names), resample), protocol),
        per_object=tuple(
            _summary(name, [group], "episode", protocol)
            for name, group in zip(object_names, by_object, strict=True)
        ),
        episodes=episodes,
        warnings=warnings or {},
    )


def _summary(name: str, groups: list[tuple[Episode, ...]], unit: Unit, protocol: Protocol) -> Summary:
    def table(attribute: str) -> np.ndarray:
        return np.array([[getattr(episode, attribute) for episode in group] for group in groups])

    errors, stopped, fell = table("scored_error_rad"), table("stopped"), table("fell")
    alike = np.where(fell, np.pi, table("error_rad"))
    start = rotation_angle(table("start_quat").reshape(-1, 4), table("goal_quat").reshape(-1, 4))
    times = table("steps")[stopped] / protocol.control_hz
    within = [values <= tolerance for values in (errors, alike) for tolerance in TOLERANCES_RAD]
    rates = rate_intervals(np.stack([*within, stopped, fell]), unit)
    labels, count = [str(tolerance) for tolerance in TOLERANCES_RAD], len(TOLERANCES_RAD)
    chance = chance_cdf(np.array(TOLERANCES_RAD))
    return Summary(
        name=name,
        episodes=errors.size,
        unit=unit,
        success=dict(zip(labels, rates[:count], strict=True)),
        symmetric=dict(zip(labels, rates[count:-2], strict=True)),
        stop_rate=rates[-2],
        drop_rate=rates[-1],
        median_error_rad=median_interval(errors, unit),
        mean_error_rad=float(table("exact_error_rad").mean()),
        time_to_success_s=order_interval(times) if times.size else None,
        chance=dict(zip(labels, map(float, chance), strict=True)),
        start={
            label: float((start <= tolerance).mean())
            for label, tolerance in zip(labels, TOLERANCES_RAD, strict=True)
        },
    )
