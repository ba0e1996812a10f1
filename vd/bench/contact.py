"""The battery of ``vd-gap contact``: does it name what is hidden in a plant of MuJoCo, and nothing else?

Development and closed seeds are apart; cases are one JSON file each, so that a run goes on where it stopped.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from vd.assets_usd.objects.contact_layer import CONTACT
from vd.assets_usd.objects.sets import load_set
from vd.bench.gap_score import Figure
from vd.bench.hidden_contact import OUTSIDE, ContactPlant, hide_contact
from vd.files import make_folder, write_json, write_text
from vd.gap.contact import by_weight, identify_contact, verdict
from vd.gap.contact_recording import read_contact_recording
from vd.workers import run_tasks

FIRST_SEED = {"development": 0, "closed": 100_000}
OBJECTS = ("cube", "cuboid")
CASE_LIMIT_S = 900.0
"""Longest time of a case [s]; one that takes longer has failed."""
SIZES: Mapping[str, tuple[tuple[float, float], ...]] = {
    "table_friction": ((0.12, 0.3), (-0.4, -0.12)),
    "restitution": ((0.15, 0.6),),
    "mass": ((0.03, 0.15), (-0.06, -0.03)),
    "centre_of_mass": ((0.006, 0.015),),
    "tip_compliance": ((0.5e-3, 3.0e-3),),
}
"""Ranges of what is hidden, as differences from the nominal value: what changes a policy's success."""
OUTSIDE_SIZES = {"speed_friction": (0.5, 1.0), "stiffening_tip": (200.0, 500.0), "tilted_table": (0.03, 0.08)}
"""Of causes outside the table: growth with the speed [s/m], with the depth [1/m], and angle [rad]."""


@dataclass(frozen=True)
class Case:
    """One recording: what is hidden, on which object."""

    kind: Literal["single", "none", "pair", "outside"]
    hidden: tuple[str, ...]
    seed: int

    @property
    def name(self) -> str:
        """Of its result file."""
        return "-".join([self.kind, *self.hidden, str(self.seed)])

    def plant(self) -> ContactPlant:
        """The plant with random sizes."""
        rng = np.random.default_rng(self.seed + 1)
        item = load_set(OBJECTS[self.seed % len(OBJECTS)])[0]
        values: dict[str, Any] = {}
        for name in (n for n in self.hidden if n in CONTACT):
            size = rng.uniform(*SIZES[name][rng.integers(len(SIZES[name]))])
            direction = rng.normal(size=len(CONTACT[name].nominal))
            vector = size * direction / np.linalg.norm(direction)
            single = len(vector) == 1
            values[name] = CONTACT[name].nominal[0] + size if single else tuple(vector.tolist())
        outside = {name: rng.uniform(*OUTSIDE_SIZES[name]) for name in self.hidden if name in OUTSIDE}
        return ContactPlant(item, values, outside, self.seed)


def battery(which: str, seeds: int) -> list[Case]:
    """The cases: every parameter and cause outside ``seeds`` times, ten times as often nothing, every pair once.

    Args:
        which: ``development`` or ``closed``.
        seeds: Recordings of each.
    """
    first, names = FIRST_SEED[which], tuple(CONTACT)
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    kinds = [("single", (name,)) for name in names for _ in range(seeds)]
    kinds += [("none", ()) for _ in range(10 * seeds)]
    kinds += [("pair", pair) for pair in pairs for _ in range(math.ceil(seeds / 4))]
    kinds += [("outside", (name,)) for name in OUTSIDE for _ in range(seeds)]
    return [Case(kind, hidden, first + i) for i, (kind, hidden) in enumerate(kinds)]  # type: ignore[arg-type]


def run_case(case: Case, folder: Path) -> dict[str, Any]:
    """Make the recording, analyse it, compare; writes ``folder/CASE.json``."""
    plant = case.plant()
    with TemporaryDirectory() as work:
        truth = hide_contact(plant, Path(work) / "recording")
        found = identify_contact(read_contact_recording(Path(work) / "recording"), plant.item)
    covered = {}
    for each in found:
        true = np.atleast_1d(truth["parameters"][each.name])
        if each.verdict != "unknown":
            covered[each.name] = [bool(v) for v in (each.low <= true) & (true <= each.high)]
    result = {
        "case": asdict(case),
        "verdict": verdict(found),
        "named": [each.name for each in by_weight(found)],
        "unknown": [each.name for each in found if each.verdict == "unknown"],
        "covered": covered,
        "estimates": {
            each.name: [each.value.tolist(), each.low.tolist(), each.high.tolist()] for each in found
        },
        "truth": truth["parameters"],
    }
    write_json(folder / f"{case.name}.json", result)
    return result


def run_battery(cases: Sequence[Case], folder: Path, jobs: int) -> list[dict[str, Any]]:
    """Run the cases that have no result yet, and write ``summary.md``; returns the results of all."""
    make_folder(folder)
    done = {
        case: json.loads(path.read_text())
        for case in cases
        if (path := folder / f"{case.name}.json").is_file()
    }
    waiting = [case for case in cases if case not in done]

    def finished(case: Case, result: dict[str, Any] | None, why: str) -> None:
        done[case] = result or {"case": asdict(case), "error": why}
        said = why if result is None else f"{result['verdict']}: {', '.join(result['named']) or 'nothing'}"
        print(f"[{len(done)}/{len(cases)}] {case.name}: {said}", flush=True)

    run_tasks(partial(run_case, folder=folder), waiting, finished, jobs=jobs, limit_s=CASE_LIMIT_S)
    results = [done[case] for case in cases]
    write_text(folder / "summary.md", summary(results))
    return results


def summary(results: Sequence[Mapping[str, Any]]) -> str:
    """The goals' figures as a table; failed cases count against them."""
    single, none, pair, outside = (
        [r for r in results if r["case"]["kind"] == kind] for kind in ("single", "none", "pair", "outside")
    )
    good = [r for r in results if "error" not in r]

    def right(result: Mapping[str, Any]) -> bool:
        return result.get("named", [])[: len(result["case"]["hidden"])] == list(result["case"]["hidden"])

    def both(result: Mapping[str, Any]) -> bool:
        return set(result.get("named", ())) == set(result["case"]["hidden"])

    def false(result: Mapping[str, Any]) -> bool:
        return "error" in result or bool(set(result["named"]) - set(result["case"]["hidden"]))

    known = [r for r in good if r["case"]["kind"] != "outside"]
    figures = [
        Figure("first name right", [right(r) for r in single], least=0.9),
        Figure("single: no false name", [not false(r) for r in single], least=0.98),
        Figure("nothing hidden: no false name", [not false(r) for r in none], least=0.98),
        Figure("two hidden: both named, nothing else", [both(r) for r in pair], least=0.8),
        Figure("outside the table: no false name", [not false(r) for r in outside], least=0.9),
        Figure(
            "95 % intervals that cover",
            [c for r in known for v in r["covered"].values() for c in v],
            least=0.9,
        ),
        Figure("parameters told, of all", [n not in r["unknown"] for r in known for n in CONTACT]),
    ]
    head = ["| figure | goal | measured | cases | reached |", "|---|---|---|---|---|"]
    wrong = [
        f"- {Case(**{**r['case'], 'hidden': tuple(r['case']['hidden'])}).name}: "
        f"{', '.join(r.get('named', ['failed'])) or 'nothing'}"
        for r in results
        if ("error" in r or set(r["named"]) != set(r["case"]["hidden"])) and r["case"]["kind"] != "outside"
    ]
    return "\n".join([*head, *(figure.row() for figure in figures), "", "Not as hidden:", "", *wrong]) + "\n"
