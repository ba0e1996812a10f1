"""Compare what the gap workflow says with what was hidden, and gather the figures to reach."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from vd.gap.bench.hidden_plant import CABLE, COGGING, TUNED, WARMING, Physics
from vd.gap.bench.hide import Hiding
from vd.gap.bench.sizes import sized_effect
from vd.kernels.servo.effects import TOGETHER, equivalent

KINDS = ("single", "none", "pair", "outside")
MASS_SPREAD = 0.2
"""Of links whose mass is changed, as the paper's randomisation has it."""
CLEAR_GAP = 3.0
"""Gap in noise floors from which a single effect counts for the goals."""
NOT_NAMED = ("command_jitter",)
"""Effects of the table that no model has."""
NEIGHBOURS: Mapping[str, tuple[str, ...]] = {
    COGGING: (),
    CABLE: ("gravity_load",),
    "command_jitter": ("command_delay", "command_filter"),
    WARMING: ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "load_friction"),
}
"""Effects of the table that are of the kind of one that is not named, so that naming them is no
error: delays that vary have a mean, and smooth; a
cable pulls with the position, as only gravity does in the table; friction that falls as the joint
warms is friction, of one form or another; torque ripple is like nothing in it."""
SUMS: Mapping[frozenset[str], str] = {
    frozenset({"coulomb_friction", "stribeck_friction"}): "stribeck_friction",
    frozenset({"coulomb_friction", "asymmetric_friction"}): "asymmetric_friction",
}
"""Pairs that are exactly one of the two, with other numbers: no recording shows the second."""
MASS_EFFECTS = ("gravity_load", "payload_inertia")
"""What a hand with other masses than its model has: naming them is right."""


@dataclass(frozen=True)
class Battery:
    """Recordings of machines that are alike.

    Attributes:
        first_seed: Added to every seed.
        plants: What obeys the laws in its own way; a seed takes the next.
    """

    first_seed: int
    plants: tuple[Physics, ...]


BATTERIES: Mapping[str, Battery] = {
    "tuned": Battery(0, (TUNED,)),
    "development": Battery(
        20000,
        (
            Physics(5.0e-4, 1.0e-3, 0.006, 5.0e-4, 31.0),
            Physics(2.5e-4, 2.5e-3, 0.003, 1.0e-3, 11.0),
            Physics(3.3e-4, 5.0e-4, 0.012, 3.0e-4, 53.0),
        ),
    ),
    "closed": Battery(
        40000,
        (
            Physics(2.8e-4, 1.7e-3, 0.008, 4.0e-4, 19.0),
            Physics(4.5e-4, 7.0e-4, 0.004, 8.0e-4, 41.0),
            Physics(3.7e-4, 3.0e-3, 0.002, 6.0e-4, 73.0),
            Physics(2.3e-4, 4.0e-4, 0.015, 1.0e-3, 8.0),
        ),
    ),
}
"""The one that the rules of the search were tuned on; one whose plants solve, stick, read and turn
otherwise, to develop on; and one that stays closed until a method is finished, and is then run
once. A gear's ripple is below the noise floor on its own; a tooth bends by less than two encoder
counts.
"""


@dataclass(frozen=True)
class Case:
    """One recording of the battery.

    Attributes:
        kind: ``single``, ``none``, ``pair`` or ``outside``.
        model: Hand (one finger of it), ``servo`` or ``pendulum``.
        effects: What is hidden.
        size: Index of the size, 0 .. 3.
        seed: Of base parameters and noise.
        change: With nothing hidden: ``exact`` (the model's own base), ``base`` (other stiffness,
            damping, speed limit) or ``mass`` (other masses as well).
        battery: One of :data:`BATTERIES`.
    """

    kind: str
    model: str
    effects: tuple[str, ...]
    size: int
    seed: int
    change: str = "base"
    battery: str = "tuned"

    @property
    def name(self) -> str:
        """Name of its result file."""
        what = "+".join(self.effects) or self.change
        own = "" if self.battery == "tuned" else f"-{self.battery}"
        return f"{self.kind}-{self.model}-{what}-size{self.size}-seed{self.seed}{own}"

    def hiding(self) -> Hiding:
        """The recording to make."""
        index = KINDS.index(self.kind)
        battery = BATTERIES[self.battery]
        return Hiding(
            model=self.model,
            effects={name: sized_effect(name, self.size, self.model) for name in self.effects},
            seed=battery.first_seed + 1000 * index + self.seed,
            base_spread=0.0 if self.change == "exact" else Hiding.base_spread,
            mass_spread=MASS_SPREAD if self.change == "mass" else 0.0,
            physics=battery.plants[self.seed % len(battery.plants)],
        )


def score(case: Case, report: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, Any]:
    """Compare a report (``vd-gap-report/1``), in the truth's unit of torque, with the truth.

    Returns:
        The case; verdict; names and sets given; hidden effects that are named, by an effect that
        stands for them too; names that are wrong; gaps in noise floors; relative errors and
        interval coverage of the parameters of effects named rightly.
    """
    floor = truth["noise_floor_rad"]
    named = list(dict.fromkeys(effect["name"] for effect in report["effects"]))
    sets = [*map(list, report["ambiguous"])]
    hidden = {*case.effects}
    found = hidden.intersection(named)
    right = hidden.union(MASS_EFFECTS) if case.change == "mass" else {*hidden}
    # A name that is the same as several hidden effects together is right if the report says that.
    for name, *others in sets:
        together = len(hidden) > 1 and hidden <= {*others} <= {*TOGETHER.get(name, ())}
        if together and name in named:
            right |= {name, *others}
            found |= hidden
    # So is one that stands for a hidden effect.
    in_sets = {*itertools.chain.from_iterable(sets)}
    for name, same in equivalent(case.model).items():
        meant = hidden.intersection(same)
        if meant & in_sets:
            right.add(name)
        if name in right.intersection(named):
            found |= meant
    if SUMS.get(frozenset(hidden)) in named:
        found |= hidden
    for name in hidden:
        right = right.union(NEIGHBOURS.get(name, ()))
    held_out = report["held_out"]
    return {
        "case": asdict(case),
        "verdict": report["verdict"],
        "named": named,
        "sets": sets,
        "found": [n for n in case.effects if n in found],
        "false": [n for n in named if n not in right],
        "gap": _ratio(report["baseline"]["rmse_rad"], floor),
        "left": _ratio(held_out["identified_rmse_rad"], floor),
        "shrunk": _ratio(held_out["baseline_rmse_rad"], held_out["identified_rmse_rad"]),
        "parameters": _parameters(report, truth),
    }


def _ratio(a: float | None, b: float | None) -> float | None:
    return a / b if a is not None and b else None


def _parameters(report: Mapping[str, Any], truth: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Relative error and coverage of every parameter of every effect named rightly, joint by joint."""
    rows = []
    for effect in report["effects"]:
        name = effect["name"]
        hidden = truth["effects"].get(name, {"parameters": {}})["parameters"]
        for key, true_values in hidden.items():
            estimate = effect["parameters"].get(key, {"value": None})
            for joint in effect["joints"]:
                true = true_values[joint]
                if not true or estimate["value"] is None:
                    continue  # a parameter that is not hidden has no relative error
                low, high = estimate["ci95"]
                rows.append(
                    {
                        "parameter": f"{name}.{key}",
                        "joint": joint,
                        "error": abs(estimate["value"] / true - 1.0),
                        "covered": low is not None and high is not None and low <= true <= high,
                    }
                )
    return rows


def said(result: Mapping[str, Any]) -> str:
    """The names and sets of a result in a few words."""
    sets = [f"{{{' or '.join(group)}}}" for group in result["sets"]]
    return ", ".join([*result["named"], *sets]) or "nothing"


Results = Sequence[Mapping[str, Any]]
HEAD = ("| figure | goal | measured | cases | reached |", "|---|---|---|---|---|")
"""Of the table of :class:`Figure`."""


@dataclass
class Figure:
    """One of the figures to reach.

    Attributes:
        what: In words.
        least: Goal: at least this.
        most: Goal: at most this.
        values: Of the cases: whether each is a hit, or numbers, whose median counts.
    """

    what: str
    least: float = -math.inf
    most: float = math.inf
    values: list[float] = field(default_factory=list)

    @property
    def value(self) -> float:
        """Share of hits, in [0, 1], or the median; NaN without cases."""
        if not self.values:
            return math.nan
        hits = isinstance(self.values[0], bool)
        return float(np.mean(self.values) if hits else np.median(self.values))

    @property
    def reached(self) -> bool:
        """Whether the value is within its bounds."""
        return self.least <= self.value <= self.most

    def row(self) -> str:
        """A row of a table."""
        goals = []
        for sign, bound in ((">=", self.least), ("<=", self.most)):
            if math.isfinite(bound):
                goals.append(f"{sign} {bound:.3g}")
        value = "-"
        reached = ""
        if self.values:
            value = f"{self.value:.3f}"
            reached = "yes" if self.reached else "no"
        return f"| {self.what} | {', '.join(goals)} | {value} | {len(self.values)} | {reached} |"


def figures(results: Results) -> list[Figure]:
    """The goals' figures over all results, failed cases counted against them."""
    first = Figure("first name right", least=0.95)
    both = Figure("two hidden: both named", least=0.8)
    none_wrong = Figure("two hidden: one or both, none wrong", least=0.98)
    nothing = Figure("nothing hidden: no false name", least=0.98)
    outside = Figure("outside: unknown or neighbours", least=0.9)
    error = Figure("relative error of parameters", most=0.1)
    covered = Figure("95 % intervals that cover", least=0.9, most=0.98)
    shrunk = Figure("held-out gap: times smaller", least=5.0)
    left = Figure("held-out gap: noise floors left", most=1.3)
    for result in results:
        kind = result["case"]["kind"]
        done = "error" not in result
        if kind == "pair":
            both.values.append(done and _all_found(result))
            none_wrong.values.append(done and bool(result["found"]) and not result["false"])
        elif kind == "none":
            nothing.values.append(done and not result["false"])
        elif kind == "outside":
            outside.values.append(done and _unknown_or_near(result))
        elif not done:
            first.values.append(False)
        elif (result["gap"] or 0.0) >= CLEAR_GAP:
            first.values.append(_first_right(result))
            shrunk.values += filter(None, [result["shrunk"]])
            left.values += filter(None, [result["left"]])
            if result["case"]["effects"][0] in result["named"]:
                for row in result["parameters"]:
                    error.values.append(row["error"])
                    covered.values.append(row["covered"])
    return [first, both, none_wrong, nothing, outside, error, covered, shrunk, left]


def _first_right(result: Mapping[str, Any]) -> bool:
    """The named effect, or the first of the set, is the hidden one, or what stands for it."""
    first = [*result["named"], *itertools.chain(*result["sets"])][:1]
    hidden = list(result["case"]["effects"])
    return first == hidden or (_all_found(result) and len(result["named"]) == len(hidden))


def _all_found(result: Mapping[str, Any]) -> bool:
    return len(result["found"]) == len(result["case"]["effects"])


def _unknown_or_near(result: Mapping[str, Any]) -> bool:
    """Abstains, or names and sets hold neighbours only."""
    if result["false"]:
        return False
    near = NEIGHBOURS.get(result["case"]["effects"][0], ())
    abstains = result["verdict"] in ("unknown", "no_gap", "under_excited")
    return abstains or not any({*near}.isdisjoint(group) for group in result["sets"])


def table(rows: Iterable[Figure]) -> str:
    """Figures as a table."""
    return "\n".join([*HEAD, *map(Figure.row, rows), ""])
