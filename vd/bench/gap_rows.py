"""Results of the gap workflow's battery as one small table, to carry from machine to machine and to keep.

One line a case, with all that the figures are made of: a battery that one machine has begun goes on on
another, or months later (``vd-bench gap --merge``).
"""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vd.files import write_text

CASE = ("kind", "model", "effects", "size", "seed", "change")
NUMBERS = ("gap", "left", "shrunk", "seconds", "cpu_s")
LISTS = ("named", "by_convention", "missed", "false")
COLUMNS = (*CASE, "verdict", *LISTS, "sets", "beside", *NUMBERS, "parameters", "commit", "error")
DIGITS = 5
"""Of numbers: more than any figure shows."""


def write_rows(path: Path, results: Iterable[Mapping[str, Any]]) -> None:
    """Write results, as :func:`vd.bench.gap_score.score` has them, in the order of their cases' names."""
    lines = sorted((_line(result) for result in results), key=lambda line: [line[key] for key in CASE])
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    write_text(path, text.getvalue())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Results that :func:`write_rows` has written.

    Raises:
        ValueError: Another file, or a line that is damaged; the message says which.
    """
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(f"{path} has not the columns of a battery's rows.csv: {', '.join(COLUMNS)}")
        results = []
        for number, line in enumerate(reader, start=2):
            try:
                results.append(_result(line))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise ValueError(
                    f"{path}, line {number}: {error}; remove the line to run its case again"
                ) from error
    return results


def _line(result: Mapping[str, Any]) -> dict[str, str]:
    case = result["case"]
    line = {key: str(case[key]) for key in CASE}
    line["effects"] = "+".join(case["effects"])
    for key in ("verdict", "commit", "error"):
        line[key] = str(result.get(key) or "").strip().replace("\n", " | ")
    for key in LISTS:
        line[key] = " ".join(result.get(key, ()))
    line["sets"] = " ".join("|".join(group) for group in result.get("sets", ()))
    line["beside"] = " ".join(f"{name}={_number(gap)}" for name, gap in result.get("beside", {}).items())
    for key in NUMBERS:
        line[key] = _number(result.get(key))
    groups: dict[str, list[str]] = {}
    for row in result.get("parameters", ()):
        covered = "+" if row["covered"] else "-"
        groups.setdefault(row["parameter"], []).append(f"{row['joint']}={_number(row['error'])}{covered}")
    line["parameters"] = " ".join(",".join([name, *joints]) for name, joints in groups.items())
    return line


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.{DIGITS}g}"


def _result(line: Mapping[str, str]) -> dict[str, Any]:
    case: dict[str, Any] = {key: int(line[key]) if key in ("size", "seed") else line[key] for key in CASE}
    case["effects"] = [name for name in line["effects"].split("+") if name]
    result: dict[str, Any] = {"case": case, "commit": line["commit"]}
    if line["cpu_s"]:
        result["cpu_s"] = float(line["cpu_s"])
    if line["error"]:
        return {**result, "error": line["error"]}
    result["verdict"] = line["verdict"]
    result.update({key: line[key].split() for key in LISTS})
    result["sets"] = [group.split("|") for group in line["sets"].split()]
    if line["beside"]:
        result["beside"] = {
            name: float(gap) for name, gap in (item.split("=") for item in line["beside"].split())
        }
    result.update({key: float(line[key]) if line[key] else None for key in NUMBERS if key != "cpu_s"})
    result["parameters"] = [
        {
            "parameter": group.split(",")[0],
            "joint": item.split("=")[0],
            "error": float(item.split("=")[1][:-1]),
            "covered": item.endswith("+"),
        }
        for group in line["parameters"].split()
        for item in group.split(",")[1:]
    ]
    return result


def merged(sources: Sequence[Path]) -> list[dict[str, Any]]:
    """Results of folders and tables; of a case in several, the first that did not fail.

    Raises:
        ValueError: A source that is neither a folder nor a table, or is damaged.
    """
    found: dict[str, dict[str, Any]] = {}
    for source in sources:
        if source.is_dir():
            parts = [_read_result(path) for path in sorted(source.glob("*-seed*.json"))]
        elif source.is_file():
            parts = read_rows(source)
        else:
            raise ValueError(f"--merge {source}: there is no such folder of results or rows.csv")
        for result in parts:
            key = json.dumps(result["case"], sort_keys=True)
            if key not in found or ("error" in found[key] and "error" not in result):
                found[key] = result
    return list(found.values())


def _read_result(path: Path) -> dict[str, Any]:
    """One result of a folder."""
    try:
        result: dict[str, Any] = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); remove it to run its case again") from error
    return result
