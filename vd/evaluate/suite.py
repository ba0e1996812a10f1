"""Suites: the paper's evaluations in simulation, with what the paper says of them (CLAIMS), and robustness.

:mod:`vd.evaluate.suite_run` runs the lists.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from vd.evaluate import conditions
from vd.evaluate.goals import Goals
from vd.evaluate.result import Row, StoppedBy
from vd.evaluate.statistics import Interval, choose_unit, rate_intervals
from vd.evaluate.trace import air_table_steps
from vd.paper import PAPER

Suite = Literal["paper", "robust"]
Group = Literal["training", "validation", "held-out", "symmetric"]

OWN_SETS: dict[Group, str | None] = {
    "training": "procedural-150-seed0",
    "validation": None,
    "held-out": "procedural-heldout",
    "symmetric": "symmetric",
}
"""Object sets where none is given: ours, which are made on demand. The paper's are meshes. Choices are made
on training and validation, held-out judges. For validation nothing stands in: its condition is left out."""

FRICTIONS = (*PAPER.randomisation.table_friction, 0.25, 0.75)
"""Frictions of the table beside the nominal one. The paper's five materials have no published values; these
span the range of its training."""

QUICK_OBJECTS, QUICK_EPISODES, QUICK_CAMERA_EPISODES = 6, 4, 1
"""Objects of a group and episodes of each in the reduced suite; a control step of a camera policy takes a
second and more on a CPU."""
QUICK_S = 540.0
"""Time after which the reduced suite shows what it has [s]: with start and page ten minutes."""


@dataclass(frozen=True)
class Condition:
    """One evaluation of every policy: an invocation of ``vd-eval`` with a name.

    Attributes:
        name: Of its folder.
        objects: Group of objects.
        episodes: Starts and goals of every object.
        camera_episodes: The same for a camera policy, whose clouds and fits take most of the time.
        paper: Where the paper shows the same, or what is changed.
        in_air: The table is taken away.
        table_friction: Of the table; None: nominal.
        goals: What camera policies know shapes and goals by; others have the mesh's alone.
        quick: Part of the reduced suite.
        condition: What is drawn; None: nothing.
        by_camera: Whether camera policies meet it too.
    """

    name: str
    objects: Group
    episodes: int
    camera_episodes: int
    paper: str
    in_air: bool = False
    table_friction: float | None = None
    goals: Goals = "mesh"
    quick: bool = True
    condition: conditions.Condition | None = None
    by_camera: bool = True

    @property
    def flags(self) -> str:
        """What ``vd-eval`` is told to do the same, policy and objects apart."""
        flags = [f"--episodes {self.episodes} (camera policies {self.camera_episodes})", "--no-at-rest"]
        flags += ["--in-air"] if self.in_air else []
        flags += [] if self.table_friction is None else [f"--table-friction {self.table_friction:g}"]
        flags += [] if self.goals == "mesh" else [f"--goals {self.goals}"]
        flags += [] if self.condition is None else [f"--condition {self.condition}"]
        return " ".join(flags)


_TRAINING = Condition("training", "training", 50, 8, "Table 1, Figures 2D and 7D")
_HELD_OUT = Condition("held-out", "held-out", 100, 50, "Table 1, Figures 2D, 4E, 7E-G")
_AIR = Condition("air", "held-out", 100, 50, "Figures S12 to S14", in_air=True)
CONDITIONS = (
    _TRAINING,
    replace(_TRAINING, name="training-points", goals="points", quick=False),
    _HELD_OUT,
    replace(_HELD_OUT, name="held-out-points", goals="points"),
    Condition("validation", "validation", 100, 50, ""),
    Condition("symmetric", "symmetric", 100, 50, "Figure 4F"),
    *(
        Condition(
            f"friction-{friction:g}",
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
    replace(_AIR, name="air-points", goals="points"),
    Condition("air-training", "training", 20, 4, "Figures S12 to S14", in_air=True, quick=False),
    Condition("scanned-goals", "held-out", 100, 24, "Figure 5", goals="scan"),
)
"""What the paper's suite runs, in this order."""

_FRICTION = PAPER.randomisation.friction
_VARIED: dict[conditions.Condition, str] = {
    "nominal": "nothing",
    "s3": "all of Table S3",
    "hard": "Table S3, forces last a control step",
    "mixed": "Table S3, friction, backlash, late commands, late object",
    "observation-late": f"object seen {conditions.STEP_LATE_S:.3f} s late",
    "all-late": f"object and joints seen {conditions.STEP_LATE_S:.3f} s late",
    "command-late": f"commands {conditions.STEP_LATE_S:.3f} s late",
    "joint-friction": f"friction of {conditions.FRICTION_NM:g} N m in every joint",
    "light": f"objects of {conditions.MASS_KG[0]:g} kg",
    "heavy": f"objects of {conditions.MASS_KG[1]:g} kg",
    "slippery": f"friction of hand and object {_FRICTION[0]:g}",
    "grippy": f"friction of hand and object {_FRICTION[1]:g}",
    "off-centre": f"centre of mass {conditions.OFF_CENTRE_M:g} m off",
    "soft-tips": "soft fingertips",
    "stiff-contacts": "contacts twice as stiff, physics steps half as long",
    "pose-error": f"object seen {conditions.POSE_ERROR[0]:g} m and {conditions.POSE_ERROR[1]:g} rad off",
}
ROBUST = tuple(
    Condition(
        name,
        "held-out",
        20,
        4,
        changed,
        condition=name,
        quick=name in ("nominal", "s3", "mixed"),
        by_camera=name
        not in ("observation-late", "all-late", "pose-error"),  # it looks for itself, as late as images are
    )
    for name, changed in _VARIED.items()
)
"""What ``--suite robust`` runs: one thing changed in each, but in the first four."""
SUITES: dict[Suite, tuple[Condition, ...]] = {"paper": CONDITIONS, "robust": ROBUST}


@dataclass(frozen=True)
class Claim:
    """A figure of the paper, and how ours beside it is measured.

    Attributes:
        text: What it is.
        condition: Name of the condition.
        measure: Takes it from a row; None where it has no meaning.
        paper: Name of the paper's figure in ``PAPER.results``; None: it gives no number.
        unit: share, rad or s.
        stopped_by: Whose rule: that of each policy, or one for all.
    """

    text: str
    condition: str
    measure: Callable[[Row], Interval | float | None]
    paper: str | None
    unit: Literal["share", "rad", "s"] = "share"
    stopped_by: Literal["own"] | StoppedBy = "own"

    def of(self, rows: list[Row]) -> Interval | float | None:
        """Ours, from the rows of one policy in the condition; None where it has no such figure."""
        for row in rows:
            if not row.ours and (
                row.headline if self.stopped_by == "own" else row.stopped_by == self.stopped_by
            ):
                return self.measure(row)
        return None

    def paper_text(self) -> str:
        """What the paper says: ``96 % (94 to 97)``, ``0.12 to 0.13``, ``below 7``; empty: nothing."""
        if self.paper is None:
            return ""
        value: tuple[float, ...] = getattr(PAPER.results, self.paper)
        if self.unit == "share":
            return share_text(*value)
        return f"{value[0]:.2f} to {value[1]:.2f}" if self.unit == "rad" else f"below {value[0]:g}"


def share_text(value: float, *interval: float) -> str:
    """``85 % (82 to 88)``, with a decimal where whole per cents would hide how small it is."""
    digits = 0 if interval and value >= 0.1 else 1
    texts = [f"{100.0 * part:.{digits}f}" for part in (value, *interval)]
    return f"{texts[0]} %" + (f" ({texts[1]} to {texts[2]})" if interval else "")


def ended_within(row: Row, tolerance_rad: float) -> Interval:
    """Share of episodes whose error to the very goal, at the stop or end, is at most this."""
    return row.overall.success[str(tolerance_rad)]


def outcome(row: Row, name: str) -> Interval:
    """Share of episodes that end so."""
    return row.overall.outcomes[name]


def precise(row: Row) -> Interval:
    """Share of episodes that stop within 0.1 rad, by the rule for it."""
    return row.precise


def seen_within(row: Row, bound_rad: float) -> float | None:
    """Share of the states truly within a bound, up to symmetry, that a camera policy predicts within it."""
    return None if row.prediction is None else row.prediction.seen[str(bound_rad)]


def lost_at_once(row: Row) -> Interval:
    """Share of episodes that lost the object in the half second after the table went."""
    gone = air_table_steps(row.protocol.control_hz)
    soon = gone + round(0.5 * row.protocol.control_hz)
    return _share(row, [e.fell and gone < e.steps <= soon for e in row.episodes])


def success_without_table(row: Row) -> Interval:
    """Share of episodes that were stopped within the tolerance when the table had gone."""
    gone = air_table_steps(row.protocol.control_hz)
    late = np.array([e.steps > gone for e in row.episodes])
    return _share(row, row.successes.ravel() & late)


def _share(row: Row, chosen: list[bool] | np.ndarray) -> Interval:
    objects = len(row.object_names)
    return rate_intervals(np.reshape(chosen, (1, objects, -1)), choose_unit(objects))[0]


def _on_table(name: str, key: str) -> list[Claim]:
    """The paper's figures on the table; ``key`` begins their names."""
    return [
        Claim("error at most 0.4 rad", name, partial(ended_within, tolerance_rad=0.4), key),
        Claim("error at most 0.8 rad", name, partial(ended_within, tolerance_rad=0.8), f"{key}_rad08"),
        Claim("median error [rad]", name, lambda r: r.overall.median_error_rad, f"{key}_median_rad", "rad"),
    ]


def _in_air(name: str) -> list[Claim]:
    """The paper's figures in the air."""
    success, lost = partial(outcome, name="success"), partial(outcome, name="object falls")
    ways: tuple[tuple[StoppedBy, str], ...] = (("prediction", "prediction"), ("true distance", "truth"))
    claims = []
    for way, key in ways:
        claims += [
            Claim(f"stopped within 0.4 rad by {way}", name, success, f"air_by_{key}", stopped_by=way),
            Claim(f"stopped within 0.1 rad by {way}", name, precise, f"air_by_{key}_rad01", stopped_by=way),
        ]
    return [
        *claims,
        Claim("stopped within 0.4 rad without the table", name, success_without_table, None),
        Claim("median time to success [s]", name, lambda row: row.overall.time_s, "air_time_s", "s"),
        Claim("object lost", name, lost, "air_dropped"),
        Claim("object lost within 0.5 s of the table", name, lost_at_once, "air_dropped_at_once"),
        Claim(
            "states within 0.4 rad up to symmetry seen so",
            name,
            partial(seen_within, bound_rad=0.4),
            "near_seen",
        ),
        Claim(
            "states within 0.1 rad up to symmetry seen so",
            name,
            partial(seen_within, bound_rad=0.1),
            "near_seen_rad01",
        ),
    ]


CLAIMS = (
    *_on_table("training", "table_training"),
    *_on_table("training-points", "table_training"),
    *_on_table("held-out", "table_held_out"),
    *_on_table("held-out-points", "table_held_out"),
    *_in_air("air"),
    *_in_air("air-points"),
)
"""The paper's figures and what we measure beside them, in the order of the conditions."""
