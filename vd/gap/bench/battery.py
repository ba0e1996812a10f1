"""The battery of the gap workflow: does it name what is hidden, and nothing else?

Every case is a recording from :mod:`vd.gap.bench.hide`, analysed by :mod:`vd.gap.workflow` from the
recording
alone, and compared with the truth: every effect of the table at four sizes, all pairs at one,
nothing hidden, and effects outside the table. Results are one JSON file per case, so that a run can
be interrupted, resumed and split over machines.
"""

import itertools
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import warp as wp

from vd.assets_usd.hands import HANDS, load_hand
from vd.command.files import write_json
from vd.command.warp_quiet import quiet_warp
from vd.gap import workflow
from vd.gap.bench.cases import run_cases
from vd.gap.bench.hidden_plant import OUTSIDE
from vd.gap.bench.hide import hide
from vd.gap.bench.score import KINDS, NOT_NAMED, Case, said, score
from vd.gap.bench.sizes import showing
from vd.kernels.servo import chains

PAIR_SIZE = 2
"""Size of both effects of a pair, some six noise floors each: from there on single effects are told
apart.
"""
NOTHING_A_SEED = 40
"""Recordings with nothing hidden, for each recording of an effect and size."""
CASE_LIMIT_S = 1800.0
"""Longest time of a case [s]; one that takes longer has failed."""


def battery(
    model: str,
    *,
    kinds: Sequence[str] = KINDS,
    effects: Sequence[str] = (),
    sizes: Sequence[int] = (0, 1, 2, 3),
    seeds: int = 5,
    first_seed: int = 0,
    which: str = "tuned",
) -> list[Case]:
    """The cases; arguments as in :class:`vd.bench.cli.GapCommand`, ``which`` its battery.

    Raises:
        ValueError: An effect is unknown, or cannot show on the model.
    """
    shown = showing(model)
    for name in effects:
        if name not in shown:
            raise ValueError(f"--effects: there is no {name}; choose from {', '.join(shown)}")
    names = effects or [name for name in shown if name not in NOT_NAMED]
    changes = ("exact", "base", "mass") if model in HANDS else ("exact", "base")
    numbers = range(first_seed, first_seed + seeds)

    def sized(kind: str, among: Sequence[str]) -> list[Case]:
        result = []
        for seed, size, name in itertools.product(numbers, sizes, among):
            result.append(Case(kind, model, (name,), size, seed, battery=which))
        return result

    nothing = []
    for number in range(NOTHING_A_SEED * seeds):
        change = changes[number % len(changes)]
        nothing.append(Case("none", model, (), 0, first_seed + number, change, which))
    pairs = []
    for seed, pair in enumerate(itertools.combinations(names, 2), first_seed):
        pairs.append(Case("pair", model, pair, PAIR_SIZE, seed, battery=which))
    cases = {
        "single": sized("single", names),
        "none": nothing,
        "pair": pairs,
        "outside": sized("outside", (*OUTSIDE, *NOT_NAMED)),
    }
    return [*itertools.chain(*map(cases.__getitem__, kinds))]


def run_case(case: Case, folder: Path, device: str = "cpu") -> dict[str, Any]:
    """Make the recording, analyse it on a Warp device, and compare; writes ``folder/CASE.json``.

    Returns:
        What :func:`score` returns, or the traceback under ``error``; with the commit and the
        processor time of this process ``cpu_s`` [s].
    """
    quiet_warp()
    begin = time.process_time()
    try:
        with TemporaryDirectory() as work:
            recording = Path(work) / "recording"
            hidden = hide(case.hiding(), recording)
            hand = load_hand(case.model) if case.model in HANDS else None
            report = workflow.explain(
                recording, hand, Path(work) / "analysis", seed=case.seed, device=device, workers=1
            )
        result = score(case, report.to_dict(), hidden.truth)
    except Exception:  # one case that fails is a figure of the battery, not its end
        result = {"case": asdict(case), "error": traceback.format_exc(limit=6)}
    result["cpu_s"] = time.process_time() - begin
    write_json(folder / f"{case.name}.json", result)
    return result


def run_battery(
    cases: Sequence[Case], folder: Path, *, jobs: int = 1, device: str = "cpu"
) -> list[dict[str, Any]]:
    """Run the cases that have no result in the folder yet, with a line for each.

    Returns the results of all.
    """
    _prepare(device, {case.model for case in cases})
    return run_cases(
        cases,
        folder,
        partial(run_case, folder=folder, device=device),
        lambda result: f"{result['verdict']}: {said(result)}",
        jobs=jobs,
        limit_s=CASE_LIMIT_S,
        gpu=device.startswith("cuda"),
    )


def _prepare(device: str, models: set[str]) -> None:
    """Fill the caches of kernels and hands before many processes want the same at once."""
    for model in models & set(HANDS):
        load_hand(model)
    quiet_warp()
    wp.load_module(chains, device=device)
