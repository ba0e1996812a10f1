"""The battery of ``vd-gap contact``.

Does it name what is hidden in a plant of MuJoCo, and nothing else?
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from vd.assets_usd.objects.contact_layer import CONTACT, contact_of
from vd.assets_usd.objects.sets import load_set
from vd.command.files import write_json, write_text
from vd.gap.bench.cases import run_cases
from vd.gap.bench.hidden_contact import OUTSIDE, ContactPlant, hide_contact
from vd.gap.bench.score import Figure, table
from vd.gap.contact import by_weight, identify_contact, verdict
from vd.logs.contact_recording import read_contact_recording

FIRST_SEED = {"development": 0, "closed": 100_000}
OBJECTS = ("cube", "cuboid")
CASE_LIMIT_S = 900.0
"""Longest time of a case [s]; one that takes longer has failed."""
SIZES: Mapping[str, tuple[tuple[float, float], ...]] = {
    "table_friction": ((-0.4, -0.12), (0.12, 0.3)),
    "restitution": ((0.15, 0.6),),
    "mass": ((-0.06, -0.03), (0.03, 0.15)),
    "centre_of_mass": ((0.006, 0.015),),
    "tip_compliance": ((0.5e-3, 3.0e-3),),
    "speed_friction": ((0.2, 0.5),),
    "stiffening_tip": ((200.0, 500.0),),
    "tilted_table": ((0.03, 0.08),),
}
"""Ranges of what is hidden (ours): from twice what matters to a policy on, beside the nominal
value. Outside
the table: growth with the speed [s/m], growth with the depth [1/m], angle [rad]."""


@dataclass(frozen=True)
class ContactCase:
    """One recording: its kind, what is hidden, and its seed."""

    kind: str
    hidden: tuple[str, ...]
    seed: int

    @property
    def name(self) -> str:
        """Of its result file."""
        return "-".join([self.kind, *self.hidden, str(self.seed)])

    def plant(self) -> ContactPlant:
        """The plant with random sizes."""
        rng = np.random.default_rng(self.seed)
        item = load_set(OBJECTS[self.seed % len(OBJECTS)])[0]
        values = {}
        outside = {}
        for name in self.hidden:
            size = rng.uniform(*SIZES[name][rng.integers(len(SIZES[name]))])
            if name in OUTSIDE:
                outside[name] = size
                continue
            nominal = contact_of(item, name)
            direction = rng.normal(size=3)
            vector = size * direction / np.linalg.norm(direction)
            values[name] = nominal[0] + size if len(nominal) == 1 else tuple(vector.tolist())
        return ContactPlant(item, values, outside, self.seed)


def battery(which: str, seeds: int) -> list[ContactCase]:
    """The cases: every parameter and cause outside the table, ten times as often nothing, pairs.

    Args:
        which: ``development`` or ``closed``.
        seeds: Recordings of each parameter and cause; a quarter of each pair.
    """
    single = itertools.product(["single"], itertools.combinations(CONTACT, 1))
    outside = itertools.product(["outside"], itertools.combinations(OUTSIDE, 1))
    pairs = itertools.product(["pair"], itertools.combinations(CONTACT, 2))
    cases = [*single, *[("none", ())] * 10, *outside] * seeds + [*pairs] * math.ceil(seeds / 4)
    first = FIRST_SEED[which]
    return [ContactCase(*case, seed) for seed, case in enumerate(cases, first)]


def run_case(case: ContactCase, folder: Path) -> dict[str, Any]:
    """Make the recording, analyse it, compare; writes ``folder/CASE.json``."""
    plant = case.plant()
    with TemporaryDirectory() as work:
        true = hide_contact(plant, Path(work) / "recording")["parameters"]
        found = identify_contact(read_contact_recording(Path(work) / "recording"), plant.item)
    parameters = {}
    for each in found:
        covered = (each.low <= true[each.name]) & (true[each.name] <= each.high)
        parameters[each.name] = {
            "true": true[each.name],
            "value": [v if math.isfinite(v) else None for v in each.value.tolist()],
            "verdict": each.verdict,
            "covered": covered.tolist(),
        }
    result = {
        "case": asdict(case),
        "verdict": verdict(found),
        "named": [each.name for each in by_weight(found)],
        "parameters": parameters,
    }
    write_json(folder / f"{case.name}.json", result)
    return result


def run_battery(cases: Sequence[ContactCase], folder: Path, jobs: int) -> list[dict[str, Any]]:
    """Run the cases that have no result yet, with a line for each; returns the results of all."""
    results = run_cases(
        cases,
        folder,
        partial(run_case, folder=folder),
        lambda result: ", ".join(result["named"]) or "nothing",
        jobs=jobs,
        limit_s=CASE_LIMIT_S,
    )
    write_text(folder / "summary.md", summary(results))
    return results


def summary(results: Sequence[Mapping[str, Any]]) -> str:
    """The goals' figures as a table, failed cases counted against them.

    Then what was not named as hidden.
    """
    first = Figure("first name right", least=0.9)
    clean = Figure("one hidden: no false name", least=0.98)
    nothing = Figure("nothing hidden: no false name", least=0.98)
    both = Figure("two hidden: both named, nothing else")
    nearest = Figure("outside the table: nothing or the nearest")
    covers = Figure("95 % intervals that cover")
    told = Figure("parameters told")
    lines: list[str] = []
    for result in results:
        case = ContactCase(**result["case"])
        named = list(result.get("named", ["failed"]))
        hidden = [OUTSIDE.get(name, name) for name in case.hidden]
        right = {*named} == {*hidden}
        no_other = {*named} <= {*hidden}
        if case.kind == "outside":
            nearest.values.append(no_other)
            continue
        if case.kind == "single":
            first.values.append(named[:1] == hidden)
            clean.values.append(no_other)
        elif case.kind == "pair":
            both.values.append(right)
        else:
            nothing.values.append(no_other)
        for parameter in result.get("parameters", {}).values():
            known = parameter["verdict"] != "unknown"
            told.values.append(known)
            if known:
                covers.values += parameter["covered"]
        if not right:
            lines.append(f"- {case.name}: {', '.join(named) or 'nothing'}")
    figures = table([first, clean, nothing, both, nearest, covers, told])
    return "\n".join([figures, "Not as hidden:", "", *lines, ""])
