"""Compare what the gap workflow says with what was hidden, and gather the figures to reach."""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vd.bench.gap_sizes import sized_effect
from vd.bench.hidden_plant import CABLE, COGGING, WARMING
from vd.bench.hide import Hiding
from vd.kernels.servo.effects import EFFECTS, TOGETHER, equivalent

KINDS = ("single", "none", "pair", "outside")
MASS_SPREAD = 0.2
"""Of links whose mass is changed, as the paper's randomisation has it."""
CLEAR_GAP = 3.0
"""Gap in noise floors from which a single effect counts for the goals."""
NEIGHBOURS: Mapping[str, tuple[str, ...]] = {
    COGGING: (),
    CABLE: ("gravity_load",),
    WARMING: ("coulomb_friction", "stribeck_friction", "asymmetric_friction", "load_friction"),
}
"""Effects of the table that are of the kind of one outside, so that naming them is no error: a cable pulls
with the position, as only gravity does in the table; friction that falls as the joint warms is friction, of
one form or another; torque ripple is like nothing in it."""
SUMS: Mapping[frozenset[str], str] = {
    frozenset({"coulomb_friction", "stribeck_friction"}): "stribeck_friction",
    frozenset({"coulomb_friction", "asymmetric_friction"}): "asymmetric_friction",
}
"""Pairs that are exactly one of the two, with other numbers: no recording shows the second."""
MASS_EFFECTS = ("gravity_load", "payload_inertia")
"""What a hand with other masses than its model has: naming them is right."""


@dataclass(frozen=True)
class Case:
    """One recording of the battery.

    Attributes:
        kind: ``single``, ``none``, ``pair`` or ``outside``.
        model: Hand (one finger of it), ``servo`` or ``pendulum``.
        effects: What is hidden.
        size: Index of the size, 0 .. 3.
        seed: Of base parameters and noise.
        change: With nothing hidden: ``exact`` (the model's own base), ``base`` (other stiffness, damping,
            speed limit) or ``mass`` (other masses as well).
    """

    kind: str
    model: str
    effects: tuple[str, ...]
    size: int
    seed: int
    change: str = "base"

    @property
    def name(self) -> str:
        """Name of its result file."""
        what = "+".join(self.effects) or self.change
        return f"{self.kind}-{self.model}-{what}-size{self.size}-seed{self.seed}"

    def hiding(self) -> Hiding:
        """The recording to make."""
        index = KINDS.index(self.kind)
        return Hiding(
            model=self.model,
            effects={name: sized_effect(name, self.size, self.model) for name in self.effects},
            seed=1000 * index + self.seed,
            base_spread=0.0 if self.change == "exact" else Hiding.base_spread,
            mass_spread=MASS_SPREAD if self.change == "mass" else 0.0,
        )


def score(case: Case, report: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, Any]:
    """Compare a report (``vd-gap-report/1``), in the truth's unit of torque, with the truth.

    Returns:
        The case; verdict; names and sets given; which are right and wrong; gaps in noise floors; relative
        errors and interval coverage of the parameters of effects named rightly; seconds.
    """
    floor = truth["noise_floor_rad"]
    named = list(dict.fromkeys(effect["name"] for effect in report["effects"]))
    sets = [list(group) for group in report["ambiguous"]]
    right = set(case.effects) | (set(MASS_EFFECTS) if case.change == "mass" else set())
    # The name that stands for a hidden effect is right if the report says that it does.
    stands = {o: name for name, others in equivalent(case.model, named).items() for o in others}
    right |= {stands[n] for n in case.effects if n in stands and any(n in group for group in sets)}
    # So is one that is the same as the hidden ones together, if the report says that.
    stood_for = {
        n
        for group in sets
        if group[0] in named and len(case.effects) > 1 and {*case.effects} <= {*group[1:]}
        if {*group[1:]} <= {*TOGETHER.get(group[0], ())}
        for n in group
    }
    right |= stood_for
    both = SUMS.get(frozenset(case.effects))
    summed = {*case.effects} if both in named else set()
    tolerated = right | {n for name in case.effects for n in NEIGHBOURS.get(name, ())}
    held_out = report["held_out"]
    return {
        "case": asdict(case),
        "verdict": report["verdict"],
        "named": named,
        "sets": sets,
        "by_convention": [
            n
            for n in case.effects
            if n not in named and (stands.get(n) in {*named} & right or n in stood_for | summed)
        ],
        "missed": [n for n in case.effects if n not in named and not any(n in group for group in sets)],
        "false": [n for n in named if n not in tolerated],
        "gap": _ratio(report["baseline"]["rmse_rad"], floor),
        "left": _ratio(held_out["identified_rmse_rad"], floor),
        "shrunk": _ratio(held_out["baseline_rmse_rad"], held_out["identified_rmse_rad"]),
        "parameters": _parameters(report, truth),
        "seconds": report["seconds"],
    }


def _ratio(a: float | None, b: float | None) -> float | None:
    return a / b if a is not None and b else None


def _parameters(report: Mapping[str, Any], truth: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Relative error and coverage of every parameter of every effect named rightly, joint by joint."""
    rows = []
    for effect in report["effects"]:
        hidden = truth["effects"].get(effect["name"])
        if hidden is None or effect["name"] not in EFFECTS:
            continue
        for joint, (key, estimate) in itertools.product(effect["joints"], effect["parameters"].items()):
            true = hidden["parameters"][key][joint]
            low, high = estimate["ci95"]
            if not true or estimate["value"] is None:
                continue  # a parameter that is not hidden has no relative error
            rows.append(
                {
                    "parameter": f"{effect['name']}.{key}",
                    "joint": joint,
                    "error": abs(estimate["value"] / true - 1.0),
                    "covered": low is not None and high is not None and low <= true <= high,
                }
            )
    return rows


def said(result: Mapping[str, Any]) -> str:
    """The names and sets of a result in a few words."""
    sets = [" or ".join(group) for group in result["sets"]]
    return ", ".join([*result["named"], *(f"{{{group}}}" for group in sets)]) or "nothing"


@dataclass(frozen=True)
class Figure:
    """One of the figures to reach.

    Attributes:
        what: In words.
        value: Share of cases in [0, 1], or a median; None if no case says anything.
        cases: Values behind it.
        least: Goal: at least this; None: no bound.
        most: Goal: at most this; None: no bound.
        share: Whether the value is a share of cases.
    """

    what: str
    value: float | None
    cases: int
    least: float | None = None
    most: float | None = None
    share: bool = False

    @property
    def reached(self) -> bool | None:
        """Whether the value is within its bounds; None without bounds or value."""
        if self.value is None or self.least is self.most is None:
            return None
        low = -math.inf if self.least is None else self.least
        return low <= self.value <= (math.inf if self.most is None else self.most)

    def row(self) -> str:
        """A row of a table."""

        def text(value: float | None) -> str:
            return "-" if value is None else f"{100 * value:.1f} %" if self.share else f"{value:.3g}"

        goal = [f"{sign} {text(bound)}" for sign, bound in ((">=", self.least), ("<=", self.most))
                if bound is not None]  # fmt: skip
        reached = {True: "yes", False: "no", None: ""}[self.reached]
        return f"| {self.what} | {', '.join(goal)} | {text(self.value)} | {self.cases} | {reached} |"


Results = Sequence[Mapping[str, Any]]


def figures(results: Results) -> list[Figure]:
    """The goals' figures over all results, failed cases counted against them."""
    single, none, pair, outside = ([r for r in results if r["case"]["kind"] == kind] for kind in KINDS)
    single = [r for r in single if "error" in r or (r["gap"] or 0.0) >= CLEAR_GAP]
    good = [r for r in single if "error" not in r]
    parameters = [row for r in good if r["case"]["effects"][0] in r["named"] for row in r["parameters"]]

    def values(key: str, among: Results = good) -> list[float]:
        return [r[key] for r in among if r.get(key) is not None]

    return [
        _share("first name right", single, _first_right, least=0.95),
        _share("right, or in the named set", single, lambda r: not r["missed"], least=0.99),
        _median("size of the set", [_set_size(r) for r in good], most=1.0),
        _share("single: a wrong name", single, _any_false),
        _share("nothing hidden: a false name", none, _any_false, most=0.02),
        _share("nothing hidden: any name at all (mass included)", none, lambda r: bool(r["named"])),
        _share("two hidden: both named", pair, _all_named, least=0.8),
        _share("two hidden: one or both, none wrong", pair, _one_and_none_wrong, least=0.98),
        _share("outside: unknown or neighbours", outside, _unknown_or_near, least=0.9),
        _share("outside: a confident wrong name", outside, _any_false, most=0.02),
        _median("relative error of parameters", [row["error"] for row in parameters], most=0.1),
        _rate("95 % intervals that cover", [row["covered"] for row in parameters], least=0.9, most=0.98),
        _median("held-out gap: times smaller", values("shrunk"), least=5.0),
        _median("held-out gap: noise floors left", values("left"), most=1.3),
        _median("seconds a recording", values("seconds", results)),
        _rate("cases that failed to run", ["error" in r for r in results], most=0.0),
    ]


def _rate(
    what: str, hits: Sequence[bool], *, least: float | None = None, most: float | None = None
) -> Figure:
    return Figure(what, float(np.mean(hits)) if hits else None, len(hits), least, most, share=True)


def _share(
    what: str,
    results: Results,
    says: Callable[[Mapping[str, Any]], bool],
    *,
    least: float | None = None,
    most: float | None = None,
) -> Figure:
    """Share of cases; one that failed counts against the goal."""
    hits = [most is not None if "error" in r else says(r) for r in results]
    return _rate(what, hits, least=least, most=most)


def _median(
    what: str, values: Sequence[float], *, least: float | None = None, most: float | None = None
) -> Figure:
    return Figure(what, float(np.median(values)) if values else None, len(values), least, most)


def _any_false(result: Mapping[str, Any]) -> bool:
    return bool(result["false"])


def _first_right(result: Mapping[str, Any]) -> bool:
    """The named effect, or the first of the set, is the hidden one."""
    first = result["named"][:1] or [group[0] for group in result["sets"][:1]]
    return first == list(result["case"]["effects"]) or _conventional(result)


def _conventional(result: Mapping[str, Any]) -> bool:
    """What is hidden is named by the effect that stands for it, and by nothing else."""
    return bool(result["by_convention"]) and len(result["named"]) == len(result["case"]["effects"])


def _set_size(result: Mapping[str, Any]) -> float:
    """Candidates among which the answer leaves the choice: 1 for a name, none counts as all."""
    truth = result["case"]["effects"][0]
    if truth in result["named"] or _conventional(result):
        return 1.0
    return float(min((len(group) for group in result["sets"] if truth in group), default=len(EFFECTS)))


def _found(result: Mapping[str, Any]) -> set[str]:
    """Hidden effects that are named, by convention too."""
    return set(result["case"]["effects"]) & {*result["named"], *result["by_convention"]}


def _all_named(result: Mapping[str, Any]) -> bool:
    return len(_found(result)) == len(result["case"]["effects"])


def _one_and_none_wrong(result: Mapping[str, Any]) -> bool:
    return bool(_found(result)) and not result["false"]


def _unknown_or_near(result: Mapping[str, Any]) -> bool:
    """Abstains, or names and sets hold neighbours only."""
    near = NEIGHBOURS.get(result["case"]["effects"][0], ())
    sets_near = all(any(name in near for name in group) for group in result["sets"])
    return not result["false"] and (result["verdict"] in ("unknown", "no_gap", "under_excited") or sets_near)


def markdown(results: Results) -> str:
    """The figures as tables: the goals first, then what came of every effect at each size."""
    lines = ["| figure | goal | measured | cases | reached |", "|---|---|---|---|---|"]
    lines += [figure.row() for figure in figures(results)]
    lines += ["", "| hidden | size | gap / floor | cases | named | answers |", "|---|---|---|---|---|---|"]
    groups: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for result in results:
        case = result["case"]
        if case["kind"] in ("single", "outside"):
            groups.setdefault((case["effects"][0], case["size"]), []).append(result)
    for (name, size), group in sorted(groups.items()):
        good = [r for r in group if "error" not in r]
        answers = Counter(said(r) if r["named"] or r["sets"] else r["verdict"] for r in good)
        if failed := len(group) - len(good):
            answers["failed"] = failed
        told = "; ".join(f"{count} x {answer}" for answer, count in answers.items())
        gap = f"{np.median([r['gap'] or 0.0 for r in good]):.1f}" if good else "-"
        named = sum(name in _found(r) for r in good)
        lines.append(f"| `{name}` | {size} | {gap} | {len(group)} | {named} | {told} |")
    return "\n".join(lines) + "\n"
