"""The battery of the gap workflow: does it name what is hidden, and nothing else?

Every case is a recording from :mod:`vd.gap.hide`, analysed by :mod:`vd.gap.workflow` from the recording
alone, and compared with the truth: every effect of the table at four sizes, all pairs at one, nothing
hidden, and effects outside the table. Results are one JSON file per case, so that a run can be
interrupted, resumed and split over machines.
"""

import itertools
import json
import shutil
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from vd.bench.gap_score import KINDS, Case, said, score
from vd.files import write_json
from vd.gap.hidden_plant import OUTSIDE
from vd.gap.hide import simulate_hidden, write_hidden
from vd.gap.recording import BARE_MODELS
from vd.gap.sizes import GAPS, showing

PAIR_SIZE = 2
"""Size of both effects of a pair: about six noise floors each."""
NOTHING_HIDDEN = 200


def battery(
    model: str,
    *,
    kinds: Sequence[str] = KINDS,
    effects: Sequence[str] = (),
    sizes: Sequence[int] = (0, 1, 2, 3),
    seeds: int = 5,
    nothing: int = NOTHING_HIDDEN,
) -> list[Case]:
    """The cases, in an order whose every part is a fair sample: seeds outside, effects inside.

    Args:
        model: Hand, ``servo`` or ``pendulum``.
        kinds: Kinds of cases, of :data:`KINDS`.
        effects: Effects to hide; empty: all that show on the model.
        sizes: Sizes of single effects and of those outside the table.
        seeds: Recordings of each effect and size.
        nothing: Recordings with nothing hidden.

    Raises:
        ValueError: An unknown kind, effect or size.
    """
    if unknown := sorted(set(kinds) - set(KINDS)):
        raise ValueError(f"no kinds of cases are called {', '.join(unknown)}; choose from {', '.join(KINDS)}")
    if bad := [size for size in sizes if size not in range(len(GAPS))]:
        raise ValueError(f"there is no size {bad[0]}; sizes are 0 to {len(GAPS) - 1}")
    shown = showing(model)
    if unknown := sorted(set(effects) - set(shown)):
        raise ValueError(
            f"{', '.join(unknown)} cannot be hidden in a {model}; choose from {', '.join(shown)}"
        )
    names = tuple(effects) or shown
    changes = ("exact", "base") if model in BARE_MODELS else ("exact", "base", "mass")
    cases = {
        "single": [
            Case("single", model, (name,), size, seed)
            for seed, size, name in itertools.product(range(seeds), sizes, names)
        ],
        "none": [Case("none", model, (), 0, seed, changes[seed % len(changes)]) for seed in range(nothing)],
        "pair": [
            Case("pair", model, pair, PAIR_SIZE, seed)
            for seed, pair in enumerate(itertools.combinations(names, 2))
        ],
        "outside": [
            Case("outside", model, (name,), size, seed)
            for seed, size, name in itertools.product(range(seeds), sizes, OUTSIDE)
        ],
    }
    return [case for kind in KINDS if kind in kinds for case in cases[kind]]


def run_case(case: Case, folder: Path, device: str = "cpu", keep: bool = False) -> dict[str, Any]:
    """Make the recording, analyse it, and compare; writes ``folder/CASE.json``.

    Args:
        case: The case.
        folder: Folder of results.
        device: Warp device of the analysis.
        keep: Keep the recording and the analysis beside the result.

    Returns:
        What :func:`score` returns; or the traceback under ``error``.
    """
    import warp as wp

    from vd.assets_usd.hands import load_hand
    from vd.gap import workflow

    wp.config.log_level = wp.LOG_WARNING
    work = folder / "work" / case.name
    try:
        (hidden,) = simulate_hidden([case.hiding()])
        write_hidden(hidden, work / "recording")
        hand = None if case.model in BARE_MODELS else load_hand(case.model)
        report = workflow.run(
            work / "recording", hand, work / "analysis", seed=case.seed, device=device, workers=1
        )
        result = score(case, report.to_dict(), hidden.truth)
    except Exception:  # one case that fails is a figure of the battery, not its end
        result = {"case": asdict(case), "error": traceback.format_exc(limit=6)}
    if not keep:
        shutil.rmtree(work, ignore_errors=True)
    write_json(folder / f"{case.name}.json", result)
    return result


def run_battery(
    cases: Sequence[Case],
    folder: Path,
    *,
    shard: tuple[int, int] = (0, 1),
    jobs: int = 1,
    device: str = "cpu",
    keep: bool = False,
    report: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Run what has no result yet of one shard of the cases.

    Args:
        cases: The battery.
        folder: Folder of results; those of all shards may lie in one.
        shard: (index, count): this process takes every ``count``-th case from ``index`` on.
        jobs: Processes.
        device: Warp device of the analyses.
        keep: Keep recordings and analyses.
        report: Called with a line per case.

    Returns:
        The results of the shard's cases, in order.
    """
    folder.mkdir(parents=True, exist_ok=True)
    mine = list(cases[shard[0] :: shard[1]])
    done = {case: read_result(folder / f"{case.name}.json") for case in mine}
    open_cases = [case for case in mine if done[case] is None or "error" in (done[case] or {})]
    report(f"{len(mine) - len(open_cases)} of {len(mine)} cases have results; {len(open_cases)} to run")

    def finished(number: int, case: Case, result: dict[str, Any]) -> None:
        done[case] = result
        answer = "failed" if "error" in result else f"{result['verdict']}: {said(result)}"
        report(f"[{number}/{len(open_cases)}] {case.name}: {answer}")

    if jobs == 1:
        for number, case in enumerate(open_cases, 1):
            finished(number, case, run_case(case, folder, device, keep))
    else:
        # Fresh processes: Warp and a CUDA context do not survive a fork.
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            running = {pool.submit(run_case, case, folder, device, keep): case for case in open_cases}
            for number, future in enumerate(as_completed(running), 1):
                finished(number, running[future], future.result())
    return [result for result in done.values() if result is not None]


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


def quick(model: str = "servo", effects: Sequence[str] = ("coulomb_friction", "command_delay")) -> list[Case]:
    """A battery of a minute: two effects, and nothing."""
    single = battery(model, kinds=("single",), effects=effects, sizes=(3,), seeds=1)
    return [*single, replace(single[0], kind="none", effects=(), size=0)]
