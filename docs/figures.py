"""``python docs/figures.py run|collect|tables``: the published figures, from their commands to the pages.

The command lines are in docs/figures/NAME.yaml, suites of vd-eval. ``run`` measures what is not
there yet, in hours on a GPU; ``collect`` takes what was measured into docs/figures/NAME.json, and
``tables`` writes the tables of docs/figures/tables.yaml into the pages. A figure is marked where the
policy or the code that measures is another since. Nothing but the installed package is needed, or
this checkout's on PYTHONPATH.
"""

import argparse
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from vd.command.versions import GAP, MEASURING, code_fingerprint
from vd.evaluate.suite_run import code_of, fingerprint
from vd.paper import PAPER

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures"
STALE = "†"
STALE_NOTE = f"{STALE}: the policy or the code that measures has changed since, or is not known."
END = "<!-- figures: end -->"
KEEP = ("protocol", "stopped_by", "rule", "overall", "held", "precise", "in_air", "consecutive")
"""What is stored of a row of a result."""
DIGITS = {"with_policy": 0, "memory_gb": 1, "mean": 1, "revolutions": 1}
"""Of measures that are no shares."""
GROUP = re.compile(r"([\w-]+)=SET\b")
"""Objects that a command line leaves open."""
FIGURE = re.compile(r"\{(\w+)/([\w/-]+): ([^}]+)\}")
"""A figure in a table: ``{suite/line/policy: measure}``, where it is in a row."""


def suites() -> list[str]:
    """Names of the suites of figures."""
    return sorted(path.stem for path in FIGURES.glob("*.yaml") if path.stem != "tables")


def run(name: str, flags: argparse.Namespace) -> int:
    """Measure what is not there of a suite; the exit status."""
    file = FIGURES / f"{name}.yaml"
    out = flags.out / name
    text = file.read_text(encoding="utf-8")
    entries = yaml.safe_load(text)["lines"]
    given = {item.partition("=")[0] for item in flags.objects}
    missing = sorted(set(GROUP.findall(text)) - given)
    if missing:
        print(f"{name}: name the objects: --objects {missing[0]}=FOLDER", file=sys.stderr)
        return 1
    commands = [entry for entry in entries if "command" in entry]
    if commands:
        return max(_run_command(entry, out, flags) for entry in commands)
    objects = [item for item in flags.objects if f" {item.partition('=')[0]}=SET" in text]
    words = ["--suite", str(file), "--out", str(out), "--device", flags.device]
    words += ["--jobs", str(flags.jobs)]
    words += ["--objects", *objects] if objects else []
    words += ["--shard", flags.shard] if flags.shard else []
    return subprocess.run([sys.executable, "-m", "vd.evaluate.cli", *words]).returncode


def _run_command(entry: dict[str, str], out: Path, flags: argparse.Namespace) -> int:
    """Measure by a command that writes JSON, unless this code has; the exit status."""
    path = out / f"{entry['name']}.json"
    code = _code_of_command(entry["command"])
    if path.is_file() and not is_stale(entry["name"], entry | json.loads(path.read_text())):
        return 0
    given = dict(item.split("=", 1) for item in flags.objects)
    line = GROUP.sub(lambda group: given[group[1]], entry["command"])
    script, *words = shlex.split(line)
    if script == "vd-eval":
        return _run_spin(words, path, flags.device)
    module = {"vd-bench": "vd.bench.cli"}[script]
    words += ["--json", str(path)]
    if words[0] == "gap":  # a case is a file: what is there goes on, of this code alone
        words += ["--out", str(out / f"{entry['name']}-{code}"), "--jobs", str(flags.jobs)]
        words += ["--shard", flags.shard] if flags.shard else []
    words += [] if "--device" in words else ["--device", flags.device]
    out.mkdir(parents=True, exist_ok=True)
    return subprocess.run([sys.executable, "-m", module, *words]).returncode


def _run_spin(words: list[str], path: Path, device: str) -> int:
    """Measure turns without a goal by vd-eval, into ``path``; the exit status."""
    policy = words[0]
    out = path.with_suffix("")
    words += ["--out", str(out), "--device", device]
    status = subprocess.run([sys.executable, "-m", "vd.evaluate.cli", *words]).returncode
    if status == 0:
        measured = {"code": code_fingerprint(MEASURING), "policy": fingerprint(policy)}
        measured |= json.loads((out / "spin.json").read_text())
        path.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")
    return status


def _code_of_command(command: str) -> str:
    """The fingerprint of the code that decides what a command gives."""
    return code_fingerprint(GAP if command.startswith("vd-bench gap") else MEASURING)


def collect(name: str, out: Path) -> int:
    """Take what was measured of a suite into its JSON; how many figures that were."""
    path = FIGURES / f"{name}.json"
    measured = {}
    for entry in yaml.safe_load((FIGURES / f"{name}.yaml").read_text(encoding="utf-8"))["lines"]:
        for settings in sorted(out.glob(f"{name}/{entry['name']}/*/settings.json")):
            policy = settings.parent.name
            command = entry.get("teacher") or entry["camera"]
            measured[f"{entry['name']}/{policy}"] = {"command": command} | _evaluated(settings)
        for file in out.glob(f"{name}/{entry['name']}.json"):
            measured[entry["name"]] = {"command": entry["command"]} | json.loads(file.read_text())
    stored = json.loads(path.read_text()) if path.is_file() else {}
    path.write_text(json.dumps(stored | measured, indent=1) + "\n", encoding="utf-8")
    return len(measured)


def _evaluated(settings: Path) -> dict[str, Any]:
    """What is stored of a finished evaluation, beside whose result ``settings`` are."""
    told = json.loads(settings.read_text())
    result = json.loads((settings.parent / "eval.json").read_text())
    rows = [{key: row[key] for key in KEEP} for row in result["rows"]]
    for row in rows:
        row["consecutive"] = row["consecutive"][:1]
        row["protocol"]["objects"] = Path(row["protocol"]["objects"]).name  # no machine's folder
    return {"seed": told["seed"], "policy": told["policy"]} | result["software"] | {"rows": rows}


def is_stale(name: str, figure: dict[str, Any]) -> bool:
    """Whether the policy or the code that measures is another since, or is not known."""
    line, _, policy = name.rpartition("/")
    code = code_of(policy) if line else _code_of_command(figure.get("command", ""))
    if figure.get("code") != code:
        return True
    return bool(line) and figure["policy"] != fingerprint(policy)


def shown(suite: str, name: str, measure: str) -> str:
    """A stored figure, or one of the paper, as a table shows it.

    Raises:
        ValueError: It is not stored; names the command that measures it.
    """
    if suite == "paper":
        return _interval(*getattr(PAPER.results, name))
    path = FIGURES / f"{suite}.json"
    figures = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    try:
        figure = figures[name]
        value = figure["rows"][0]
        for key in measure.split("/"):
            value = value[int(key) if isinstance(value, list) else key]
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(
            f"{path}: no {measure} of {name}; python docs/figures.py run {suite}"
        ) from error
    mark = STALE if is_stale(name, figure) else ""
    if isinstance(value, dict):
        return _interval(value["value"], value["low"], value["high"]) + mark
    digits = DIGITS.get(measure.split("/")[-1])
    return (_interval(value) if digits is None else f"{value:.{digits}f}") + mark


def _interval(value: float, *bounds: float) -> str:
    """A share in per cent: ``88.0``, or with its interval ``88 (82-92)``."""
    if not bounds:
        return f"{100 * value:.1f}"
    low, high = bounds
    return f"{100 * value:.0f} ({100 * low:.0f}-{100 * high:.0f})"


def tables() -> dict[Path, str]:
    """The pages that have tables, by path, as they have to be."""
    pages: dict[Path, str] = {}
    for table in yaml.safe_load((FIGURES / "tables.yaml").read_text(encoding="utf-8")):
        path = ROOT / table["page"]
        page = pages.get(path) or path.read_text(encoding="utf-8")
        lines = [table["head"], ["---"] * len(table["head"]), *table["rows"]]
        text = "\n".join(f"|{'|'.join(cells)}|" for cells in lines)
        text = FIGURE.sub(lambda figure: shown(*figure.groups()), text)
        if "{" in text:
            raise ValueError(
                f"tables.yaml: {table['name']} has a figure that cannot be read: {text}"
            )
        begin = f"<!-- figures: {table['name']} -->"
        before, found, rest = page.partition(begin)
        if not found:
            raise ValueError(f"{path}: there is no {begin}")
        if STALE in text and STALE_NOTE not in before:
            text += f"\n\n{STALE_NOTE}"
        pages[path] = f"{before}{begin}\n{text}\n{END}{rest.partition(END)[2]}"
    return pages


def main() -> int:
    """Run, collect or write; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("step", choices=("run", "collect", "tables"))
    parser.add_argument("names", nargs="*", help=f"suites, all by default: {', '.join(suites())}")
    parser.add_argument("--objects", nargs="*", default=[], help="GROUP=SET, as of vd-eval --suite")
    parser.add_argument("--device", default="auto", help="auto spreads --jobs over all GPUs")
    parser.add_argument("--jobs", type=int, default=1, help="evaluations side by side")
    parser.add_argument("--shard", help="I/N: every N-th evaluation from the I-th")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "figures")
    flags = parser.parse_args()
    names = flags.names or suites()
    if flags.step == "run":
        return max(run(name, flags) for name in names)
    if flags.step == "collect":
        for name in names:
            print(f"{name}: {collect(name, flags.out)} figures")
    for path, page in tables().items():
        path.write_text(page, encoding="utf-8")
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
