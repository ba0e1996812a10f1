"""The paper's evaluations in simulation: what is run (CONDITIONS), and what the paper says of it (CLAIMS).

:mod:`vd.evaluate.suite_run` runs the list, :mod:`vd.evaluate.suite_page` shows what came out.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vd.evaluate.comparison import Comparison, Row, StoppedBy
from vd.evaluate.goals import Goals
from vd.evaluate.result import air_table_steps
from vd.evaluate.statistics import Interval, choose_unit, order_interval, rate_intervals
from vd.evaluate.trace import HOLD_S
from vd.paper import PAPER, provenance

Group = Literal["training", "validation", "held-out", "symmetric"]

OWN_SETS: dict[Group, str | None] = {
    "training": "procedural-150-seed0",
    "validation": None,
    "held-out": "procedural-heldout",
    "symmetric": "symmetric",
}
"""Object sets where none is given: ours, which are made on demand. The paper's are meshes. Choices are made
on training and validation, held-out judges. For validation nothing stands in: its conditions are left out."""

FRICTIONS = (*PAPER.randomisation.table_friction, 0.25, 0.75)
"""Frictions of the table beside the nominal one. The paper's five materials have no published values; these
span the range of its training."""

NO_STUDENT = "no student named"
"""What is said in place of a student's figures where none is evaluated."""

OUT_OF_TIME = "out of time; the same command goes on from here"
"""Why evaluations of the reduced suite were not run."""

QUICK_OBJECTS, QUICK_EPISODES = 6, 4
"""Objects of a group and episodes of each in the reduced suite."""
QUICK_STUDENT_EPISODES = 1
"""The same of a student, of which a control step takes a second and more on a CPU."""
QUICK_S = 540.0
"""Time after which the reduced suite shows what it has [s]: with start and page ten minutes."""


@dataclass(frozen=True)
class Condition:
    """One evaluation of every policy: an invocation of ``vd-eval`` with a name.

    Attributes:
        name: Of its folder.
        title: Of its section.
        objects: Group of objects.
        episodes: Starts and goals of every object.
        student_episodes: The same for a student, whose clouds and fits take most of the time.
        paper: Where the paper shows the same.
        in_air: The table is taken away.
        table_friction: Of the table; None: nominal.
        goals: What students know shapes and goals by. A teacher's are orientations: only the mesh's are its.
        sensor_errors: Cameras of students have the errors of a real one.
        second_view: Symmetry-view selection, for policies that have views.
        mark: What of it is not the paper's; empty for the headline.
        quick: Part of the reduced suite.
    """

    name: str
    title: str
    objects: Group
    episodes: int
    student_episodes: int
    paper: str
    in_air: bool = False
    table_friction: float | None = None
    goals: Goals = "mesh"
    sensor_errors: bool = True
    second_view: bool = False
    mark: str = ""
    quick: bool = True

    @property
    def flags(self) -> str:
        """What ``vd-eval`` is told to do the same, policy and objects apart."""
        flags = [f"--episodes {self.episodes} (students {self.student_episodes})", "--no-at-rest"]
        flags += ["--in-air"] if self.in_air else []
        flags += [] if self.table_friction is None else [f"--table-friction {self.table_friction:g}"]
        flags += [] if self.goals == "mesh" else [f"--goals {self.goals}"]
        flags += [] if self.sensor_errors else ["--no-sensor-errors"]
        flags += ["--second-view"] if self.second_view else []
        return " ".join(flags)

    def concerns(self, *, student: bool, views: bool) -> bool:
        """Whether it is another condition than the nominal one for a policy.

        Args:
            student: It sees clouds.
            views: It has symmetry views to select from.
        """
        if not student and (self.goals != "mesh" or not self.sensor_errors):
            return False
        return views or not self.second_view


_HELD_OUT = Condition(
    "held-out", "On the table, held-out objects", "held-out", 100, 50, "Table 1, Figures 2D, 4E, 7E-G"
)
_TRAINING = Condition(
    "training", "On the table, training objects", "training", 50, 8, "Table 1, Figures 2D and 7D"
)
_AIR = Condition(
    "air", "In the air, held-out objects", "held-out", 100, 50, "Figures S12 to S14", in_air=True
)
_BY_POINTS = ", goals as 500 points"


def _by_points(condition: Condition) -> Condition:
    """The same for students that know shapes by points, as the paper's do."""
    name, title = f"{condition.name}-points", condition.title + _BY_POINTS
    return replace(condition, name=name, title=title, goals="points")


CONDITIONS = (
    _TRAINING,
    _by_points(replace(_TRAINING, quick=False)),
    _HELD_OUT,
    _by_points(_HELD_OUT),
    replace(
        _HELD_OUT,
        name="validation",
        title="On the table, objects of validation",
        objects="validation",
        paper="",
    ),
    Condition("symmetric", "On the table, symmetric solids", "symmetric", 100, 50, "Figure 4F"),
    *(
        Condition(
            f"friction-{friction:g}",
            f"On a table of friction {friction:g}, held-out objects",
            "held-out",
            100,
            24,
            "Figures 2F and 2G (real materials)",
            table_friction=friction,
            quick=friction in PAPER.randomisation.table_friction,
        )
        for friction in sorted(FRICTIONS)
    ),
    _AIR,
    _by_points(_AIR),
    replace(
        _AIR,
        name="air-training",
        title="In the air, training objects",
        objects="training",
        episodes=20,
        student_episodes=4,
        quick=False,
    ),
    Condition(
        "scanned-goals",
        "Goals from scans, held-out objects",
        "held-out",
        100,
        24,
        "Figure 5",
        goals="scan",
    ),
    *(
        replace(
            _HELD_OUT,
            name=f"held-out-{name}",
            title=f"On the table, held-out objects, {mark}",
            paper="",
            mark=mark,
            quick=False,
            second_view=name in ("second-view", "before"),
            sensor_errors=name != "before",
        )
        for name, mark in (
            ("second-view", "ours: symmetry-view selection"),
            ("before", "ours: view selection, and a perfect camera, as before these conditions"),
        )
    ),
)
"""What the suite runs, in this order."""

SOURCES = {name: f"{tag}: {note}" for name, _, tag, note in provenance()}
"""Where every constant of the paper comes from."""

Measure = Callable[[Comparison, Row], Interval | float | None]
"""A number of one row of a condition, or None where it has no meaning."""


def within(tolerance_rad: float) -> Measure:
    """Share of episodes whose error to the very goal, at the stop or end, is at most this."""
    return lambda _, row: row.result.overall.success[str(tolerance_rad)]


def within_symmetric(tolerance_rad: float) -> Measure:
    """The same up to symmetry."""
    return lambda _, row: row.result.overall.symmetric[str(tolerance_rad)]


def held(_: Comparison, row: Row) -> Interval | None:
    """Share of episodes stopped within the tolerance of the very goal that are there after the hold."""
    return row.held


def stops_within(bound_rad: float) -> Measure:
    """Share of episodes that stop within a tolerance, by the rule for it."""
    return lambda _, row: row.stops_within[str(bound_rad)]


def seen_within(bound_rad: float) -> Measure:
    """Share of the states truly within a bound that a student predicts within it."""

    def measure(comparison: Comparison, row: Row) -> float | None:
        for prediction in comparison.predictions:
            for bound in prediction.bounds:
                if prediction.group == row.group and bound.bound_rad == bound_rad:
                    return bound.seen
        return None

    return measure


def median_error(_: Comparison, row: Row) -> Interval:
    """Median of the errors at the stop or end, a lost object counting as pi [rad]."""
    return row.result.overall.median_error_rad


def dropped(_: Comparison, row: Row) -> Interval:
    """Share of episodes that lost the object before a stop."""
    return row.outcomes["object falls"]


def dropped_at_once(_: Comparison, row: Row) -> Interval:
    """Share of episodes that lost the object in the half second after the table went."""
    hz = row.result.protocol.control_hz
    gone = air_table_steps(hz)
    return _share(row, [e.fell and gone < e.steps <= gone + round(0.5 * hz) for e in row.result.episodes])


def success_without_table(_: Comparison, row: Row) -> Interval:
    """Share of episodes that were stopped within the tolerance when the table had gone."""
    protocol = row.result.protocol
    gone, tolerance = air_table_steps(protocol.control_hz), protocol.stop_tolerance_rad
    return _share(
        row, [e.stopped and e.exact_error_rad <= tolerance and e.steps > gone for e in row.result.episodes]
    )


def _share(row: Row, chosen: list[bool]) -> Interval:
    objects = len(row.result.object_names)
    return rate_intervals(np.reshape(chosen, (1, objects, -1)), choose_unit(objects))[0]


def time_to_success(_: Comparison, row: Row) -> Interval | None:
    """Median time of the episodes that were stopped within the tolerance [s]; None if none was."""
    protocol = row.result.protocol
    steps = [
        e.steps for e in row.result.episodes if e.stopped and e.exact_error_rad <= protocol.stop_tolerance_rad
    ]
    return order_interval(np.array(steps) / protocol.control_hz) if steps else None


def own_row(comparison: Comparison) -> Row:
    """The row of a policy's own rule: by its prediction if it is a student, else by the true distance."""
    rows = [row for row in comparison.rows if not row.ours]
    return min(rows, key=lambda row: row.stopped_by != "prediction")


@dataclass(frozen=True)
class Claim:
    """A figure of the paper, and how ours beside it is measured.

    Attributes:
        text: What it is.
        condition: Name of the condition.
        measure: Takes it from a row.
        paper: Name of the paper's figure in ``PAPER.results``; None: it gives no number.
        unit: share, rad or s.
        stopped_by: Whose rule: that of each policy (students by their prediction, others by the true
            distance), predictions alone, or the true distance for all.
    """

    text: str
    condition: str
    measure: Measure
    paper: str | None = None
    unit: Literal["share", "rad", "s"] = "share"
    stopped_by: Literal["own"] | StoppedBy = "own"

    @property
    def source(self) -> str:
        """Tag and place of the paper's figure (:mod:`vd.paper`); empty without one."""
        return "" if self.paper is None else SOURCES[f"results.{self.paper}"]

    def of(self, comparison: Comparison) -> Interval | float | None:
        """Ours, from the comparison of one policy; None where it has no such figure."""
        if self.stopped_by == "own":
            return self.measure(comparison, own_row(comparison))
        rows = [row for row in comparison.rows if row.stopped_by == self.stopped_by and not row.ours]
        return self.measure(comparison, rows[0]) if rows else None


def _table(name: str, key: str) -> tuple[Claim, ...]:
    """What is asked on the table; ``key`` begins the names of the paper's figures."""
    return (
        Claim("error at most 0.4 rad", name, within(0.4), key),
        Claim("the same up to symmetry", name, within_symmetric(0.4)),
        Claim(f"stopped within 0.4 rad, and held {HOLD_S:g} s", name, held),
        Claim("error at most 0.8 rad", name, within(0.8), f"{key}_rad08"),
        Claim("median error [rad]", name, median_error, f"{key}_median_rad", "rad"),
        Claim("stopped within 0.1 rad", name, stops_within(0.1)),
        Claim("median time to success [s]", name, time_to_success, unit="s"),
        Claim("object lost", name, dropped),
    )


def _air(name: str) -> tuple[Claim, ...]:
    """What is asked in the air."""
    ways: tuple[tuple[StoppedBy, str], ...] = (("prediction", "prediction"), ("true distance", "truth"))
    bounds = ((0.4, ""), (0.1, "_rad01"))
    stops = (
        Claim(
            f"stopped within {bound} rad by {way}",
            name,
            stops_within(bound),
            f"air_by_{key}{suffix}",
            stopped_by=way,
        )
        for way, key in ways
        for bound, suffix in bounds
    )
    return (
        *stops,
        Claim(f"stopped within 0.4 rad, and held {HOLD_S:g} s", name, held),
        Claim("error at most 0.4 rad up to symmetry", name, within_symmetric(0.4)),
        Claim("stopped within 0.4 rad without the table", name, success_without_table),
        Claim("median time to success [s]", name, time_to_success, "air_time_s", "s"),
        Claim("object lost", name, dropped, "air_dropped"),
        Claim("object lost within 0.5 s of the table", name, dropped_at_once, "air_dropped_at_once"),
        *(
            Claim(
                f"states within {bound} rad predicted so",
                name,
                seen_within(bound),
                f"near_seen{suffix}",
                stopped_by="prediction",
            )
            for bound, suffix in bounds
        ),
    )


def _claims(condition: Condition) -> tuple[Claim, ...]:
    name = condition.name
    if condition.in_air:
        return _air(name)
    if name.removesuffix("-points") in ("training", "held-out"):
        return _table(name, f"table_{condition.objects.replace('-', '_')}")
    return (
        Claim("error at most 0.4 rad", name, within(0.4)),
        Claim("the same up to symmetry", name, within_symmetric(0.4)),
        Claim(f"stopped within 0.4 rad, and held {HOLD_S:g} s", name, held),
    )


CLAIMS = tuple(claim for condition in CONDITIONS for claim in _claims(condition))
"""The paper's figures and what we measure beside them, in the order of the conditions. All are against the
very goal but for those that say otherwise (the paper's Figure 4F)."""
