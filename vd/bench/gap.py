"""The battery of the gap workflow: does it name what is hidden, and nothing else?

Every case is a recording from :mod:`vd.bench.hide`, analysed by :mod:`vd.gap.workflow` from the recording
alone, and compared with the truth: every effect of the table at four sizes, all pairs at one, nothing
hidden, and effects outside the table. Results are one JSON file per case, so that a run can be
interrupted, resumed and split over machines.
"""

import itertools
import json
import shutil
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hands import HANDS
from vd.bench.gap_beside import beside
from vd.bench.gap_score import KINDS, Case, said, score
from vd.bench.gap_sizes import GAPS, showing
from vd.bench.hidden_plant import OUTSIDE
from vd.bench.hide import simulate_hidden, write_hidden
from vd.files import make_folder, write_json
from vd.gap.recording import BARE_MODELS
from vd.versions import source_commit
from vd.warp_quiet import quiet_warp
from vd.workers import run_tasks

PAIR_SIZE = 2
"""Size of both effects of a pair, some six noise floors each: from there on single effects are told apart."""
NOTHING_HIDDEN = 200
CASE_LIMIT_S = 1800.0
"""Longest time of a case [s]."""


def battery(
    model: str,
    *,
    kinds: Sequence[str] = KINDS,
    effects: Sequence[str] = (),
    sizes: Sequence[int] = (0, 1, 2, 3),
    seeds: int = 5,
    first_seed: int = 0,
    nothing: int = NOTHING_HIDDEN,
    pairs: int | None = None,
) -> list[Case]:
    """The cases, in a random order with all kinds mixed in proportion: any first part is a fair sample.

    Args:
        model: Hand, ``servo`` or ``pendulum``.
        kinds: Kinds of cases, of :data:`KINDS`.
        effects: Effects to hide; empty: all that show on the model.
        sizes: Sizes of single effects and of those outside the table.
        seeds: Recordings of each effect and size.
        first_seed: Seed of the first: recordings that the method has not been tuned on.
        nothing: Recordings with nothing hidden.
        pairs: Pairs of effects, drawn at random; all if None.

    Raises:
        ValueError: An unknown kind, effect or size.
    """
    if unknown := sorted(set(kinds) - set(KINDS)):
        raise ValueError(f"no kinds of cases are called {', '.join(unknown)}; choose from {', '.join(KINDS)}")
    if bad := [size for size in sizes if size not in range(len(GAPS))]:
        raise ValueError(f"there is no size {bad[0]}; sizes are 0 to {len(GAPS) - 1}")
    if model not in (*HANDS, *BARE_MODELS):
        raise ValueError(f"--model is {model}; choose one of {', '.join((*HANDS, *BARE_MODELS))}")
    shown = showing(model)
    if unknown := sorted(set(effects) - set(shown)):
        raise ValueError(
            f"{', '.join(unknown)} cannot be hidden in a {model}; choose from {', '.join(shown)}"
        )
    names = tuple(effects) or shown
    changes = ("exact", "base") if model in BARE_MODELS else ("exact", "base", "mass")
    numbers = range(first_seed, first_seed + seeds)
    cases = {
        "single": [
            Case("single", model, (name,), size, seed)
            for seed, size, name in itertools.product(numbers, sizes, names)
        ],
        "none": [
            Case("none", model, (), 0, first_seed + i, changes[i % len(changes)]) for i in range(nothing)
        ],
        "pair": [
            Case("pair", model, pair, PAIR_SIZE, first_seed + number)
            for number, pair in enumerate(itertools.combinations(names, 2))
        ],
        "outside": [
            Case("outside", model, (name,), size, seed)
            for seed, size, name in itertools.product(numbers, sizes, OUTSIDE)
        ],
    }
    chosen = [_shuffled(cases[kind]) for kind in KINDS if kind in kinds]
    if pairs is not None:
        chosen = [group[:pairs] if group and group[0].kind == "pair" else group for group in chosen]
    placed = [((i + 0.5) / len(group), case) for group in chosen for i, case in enumerate(group)]
    return [case for _, case in sorted(placed, key=lambda item: item[0])]


def _shuffled(cases: Sequence[Case]) -> list[Case]:
    return [cases[i] for i in np.random.default_rng(0).permutation(len(cases))]


def run_case(case: Case, folder: Path, device: str = "cpu", keep: bool = False) -> dict[str, Any]:
    """Make the recording, analyse it, and compare; writes ``folder/CASE.json``.

    Args:
        case: The case.
        folder: Folder of results.
        device: Warp device of the analysis.
        keep: Keep the recording and the analysis beside the result.

    Returns:
        What :func:`score` returns, or the traceback under ``error``; with the commit and the processor time
        of this process ``cpu_s`` [s].
    """
    from vd.assets_usd.hands import load_hand
    from vd.gap import workflow

    quiet_warp()
    work, begin = folder / "work" / case.name, time.process_time()
    try:
        (hidden,) = simulate_hidden([case.hiding()])
        write_hidden(hidden, work / "recording")
        hand = None if case.model in BARE_MODELS else load_hand(case.model)
        report = workflow.explain(
            work / "recording", hand, work / "analysis", seed=case.seed, device=device, workers=1
        )
        result = score(case, report.to_dict(), hidden.truth)
        if case.kind == "pair":
            result["beside"] = beside(case.hiding())
    except Exception:  # one case that fails is a figure of the battery, not its end
        result = {"case": asdict(case), "error": traceback.format_exc(limit=6)}
    result |= {"commit": source_commit(), "cpu_s": time.process_time() - begin}
    if not keep:
        shutil.rmtree(work, ignore_errors=True)
    write_json(folder / f"{case.name}.json", result)
    return result


def run_battery(
    cases: Sequence[Case],
    folder: Path,
    *,
    shard: tuple[int, int] = (0, 1),
    jobs: int = 0,
    device: str = "cpu",
    keep: bool = False,
    limit_s: float = CASE_LIMIT_S,
    report: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Run what has no result yet of one shard of the cases; what failed before comes last.

    Args:
        cases: The battery.
        folder: Folder of results; those of all shards may lie in one.
        shard: (index, count): this process takes every ``count``-th case from ``index`` on.
        jobs: Processes; 0 runs the cases in this one, without limits of time.
        device: Warp device of the analyses.
        keep: Keep recordings and analyses.
        limit_s: Longest time of a case [s]; one that takes longer has failed.
        report: Called with a line per case.

    Returns:
        The results of the shard's cases, in order.
    """
    make_folder(folder)
    mine = cases[shard[0] :: shard[1]]
    done = {case: read_result(folder / f"{case.name}.json") for case in mine}
    failed = [case for case in mine if "error" in (done[case] or {})]
    open_cases = [*(case for case in mine if done[case] is None), *failed]
    report(f"{len(mine) - len(open_cases)} of {len(mine)} cases have results; {len(open_cases)} to run")
    number = 0

    def finished(case: Case, result: dict[str, Any] | None, why: str) -> None:
        nonlocal number
        number += 1
        if result is None:
            result = {"case": asdict(case), "error": why}
            write_json(folder / f"{case.name}.json", result)
        done[case] = result
        answer = f"failed: {why}" if "error" in result else f"{result['verdict']}: {said(result)}"
        report(f"[{number}/{len(open_cases)}] {case.name}: {answer}")

    work = partial(run_case, folder=folder, device=device, keep=keep)
    if jobs == 0:
        for case in open_cases:
            finished(case, work(case), "")
        return [result for result in done.values() if result is not None]
    if open_cases:
        _prepare(device, {case.model for case in open_cases})
    gpu = device.startswith("cuda")
    run_tasks(work, open_cases, finished, jobs=jobs, limit_s=limit_s, gpu=gpu)
    return [result for result in done.values() if result is not None]


def _prepare(device: str, models: set[str]) -> None:
    """Fill the caches of kernels and hands before many processes want the same at once."""
    import warp as wp

    import vd.kernels.servo.chains
    from vd.assets_usd.hands import load_hand

    for model in models - set(BARE_MODELS):
        load_hand(model)

    quiet_warp()
    wp.load_module(vd.kernels.servo.chains, device=device)


def read_result(path: Path) -> dict[str, Any] | None:
    """The result of a case, or None if it has not been run or was cut short."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def collect(folder: Path) -> list[dict[str, Any]]:
    """All results in a folder, those of other shards too."""
    found = [read_result(path) for path in sorted(folder.glob("*-seed*.json"))]
    return [result for result in found if result is not None]


def parse_shard(text: str) -> tuple[int, int]:
    """Index from 0 and count of a shard ``i/n``, i from 1.

    Raises:
        ValueError: Not of that form.
    """
    index, slash, count = text.partition("/")
    if slash and index.isdigit() and count.isdigit() and 1 <= int(index) <= int(count):
        return int(index) - 1, int(count)
    raise ValueError(f"--shard is {text!r}; write i/n, such as 1/4 for the first of four parts")
