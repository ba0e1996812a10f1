"""Run the cases of a battery, one JSON file for each: interrupted, it goes on where it was."""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vd.command.files import make_folder, write_json
from vd.command.workers import run_tasks


def read_result(path: Path) -> dict[str, Any] | None:
    """The result of a case, or None if it has not been run, was cut short or is of an earlier version."""
    try:
        result = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return result if {"named", "error"} & result.keys() else None


def run_cases(
    cases: Sequence[Any],
    folder: Path,
    work: Callable[[Any], dict[str, Any]],
    told: Callable[[Mapping[str, Any]], str],
    *,
    jobs: int,
    limit_s: float,
    gpu: bool = False,
) -> list[dict[str, Any]]:
    """Run the cases that have no result in the folder yet, with a line for each.

    Args:
        cases: Tuples or data with a ``name``.
        folder: Of their results.
        work: Runs a case, writes and returns its result.
        told: A result in words.
        jobs: Cases at a time.
        limit_s: Longest time of a case [s]; one that takes longer has failed.
        gpu: Whether they need one.

    Returns:
        The results of all.
    """
    make_folder(folder)
    done = {}
    waiting = []
    for case in cases:
        result = done[case] = read_result(folder / f"{case.name}.json")
        if result is None or "error" in result:
            waiting.append(case)
    print(
        f"{len(cases) - len(waiting)} of {len(cases)} cases have results; {len(waiting)} to run",
        flush=True,
    )
    numbers = itertools.count(1)

    def finished(case: Any, result: dict[str, Any] | None, why: str) -> None:
        if result is None:
            result = {"case": vars(case), "error": why}
            write_json(folder / f"{case.name}.json", result)
        done[case] = result
        answer = f"failed: {why}" if "error" in result else told(result)
        print(f"[{next(numbers)}/{len(waiting)}] {case.name}: {answer}", flush=True)

    run_tasks(work, waiting, finished, jobs=jobs, limit_s=limit_s, gpu=gpu)
    return [*filter(None, done.values())]
