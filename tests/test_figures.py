"""Published figures: each from a JSON that its command wrote, and marked once that is old."""

import importlib.util
import json
import re
import shlex
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from test_evaluate_trace import compared

from vd.bench.cli import Command, main
from vd.command.files import write_json
from vd.command.line import parse
from vd.command.versions import GAP, MEASURING, code_fingerprint
from vd.evaluate import suite_run
from vd.evaluate.cfg import EvalCfg
from vd.evaluate.result import Result
from vd.evaluate.suite import read_suite

ROOT = Path(__file__).resolve().parents[1]
SPEC = importlib.util.spec_from_file_location("figures", ROOT / "docs" / "figures.py")
figures = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(figures)
BLOCK = re.compile(r"<!-- figures: (?!end).*?<!-- figures: end -->", re.DOTALL)


def test_tables_are_those_of_the_stored_figures():
    for path, page in figures.tables().items():
        assert path.read_text() == page, "run: python docs/figures.py tables"


@pytest.mark.parametrize(
    "name", ["README.md", "docs/results.md", "docs/limitations.md", "docs/lessons.md"]
)
def test_no_figure_stands_outside_of_them(name):
    rest = BLOCK.sub("", (ROOT / name).read_text()).replace("95 % intervals", "")
    assert re.findall(r"[^\n]*\d ?%[^\n]*", rest) == []
    assert "|" not in rest, "a table by hand"


def test_every_stored_figure_of_a_suite_has_its_command_line():
    for path in sorted(figures.FIGURES.glob("*.yaml")):
        stored = path.with_suffix(".json")
        if path.stem == "tables":
            continue
        entries = yaml.safe_load(path.read_text())["lines"]
        for entry in entries:
            if "command" in entry:
                script, *words = shlex.split(entry["command"])
                parse({"vd-bench": Command, "vd-eval": EvalCfg}[script], words, prog=script)
        if "command" not in entries[0]:
            for entry in read_suite(str(path)).lines:
                for line in entry.lines:
                    suite_run.settings(EvalCfg(), line, "zero", _any_objects(line)).validate()
        names = {entry["name"].split("/")[0] for entry in entries}
        assert '"/' not in stored.read_text(), "a folder of the machine that measured"
        assert {key.split("/")[0] for key in json.loads(stored.read_text())} <= names


def _any_objects(line):
    return dict.fromkeys(figures.GROUP.findall(line), suite_run.ObjectGroup(("cube",), "cube"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of figures with a suite of one line and a page, and what its command wrote."""
    monkeypatch.setattr(figures, "FIGURES", tmp_path)
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    line = "vd-eval zero --objects held-out=SET --episodes 4"
    (tmp_path / "x.yaml").write_text(f"title: X\nlines: [{{name: a, teacher: {line}}}]\n")
    (tmp_path / "tables.yaml").write_text(
        "- {page: page.md, name: t, head: [what, zero],\n"
        "   rows: [[a, '{x/a/zero: overall/outcomes/success}']]}\n"
    )
    (tmp_path / "page.md").write_text("before\n<!-- figures: t -->\n<!-- figures: end -->\nafter\n")
    return tmp_path


def measured(folder, monkeypatch, code):
    """Run the suite with a test double of the evaluation, and collect."""

    def compare(cfg, condition):
        rows = [replace(row, policy="zero", kind="zero", sees="nothing") for row in compared()[1:]]
        software = {"device": "a double", "date": "2026-11-28", "code": code, "torch": "2"}
        Result(tuple(rows), software).write(cfg.out / "eval.json")

    monkeypatch.setattr(suite_run, "compare", compare)
    suite = str(folder / "x.yaml")
    cfg = EvalCfg(suite=suite, objects=("held-out=cube",), out=folder / "out" / "x", device="cpu")
    suite_run.run_suite(cfg)
    return figures.collect("x", folder / "out")


def test_what_a_command_wrote_is_stored_and_shown_until_the_code_is_another(folder, monkeypatch):
    with pytest.raises(ValueError, match=r"a/zero; python docs/figures\.py run x"):
        figures.tables()
    assert measured(folder, monkeypatch, code_fingerprint()) == 1
    (page,) = figures.tables().values()
    assert "|a|100 (" in page and figures.STALE not in page
    assert page.startswith("before\n") and page.endswith("after\n")
    stored = json.loads((folder / "x.json").read_text())["a/zero"]
    assert stored["seed"] == 0 and stored["device"] == "a double" and stored["date"] == "2026-11-28"
    assert stored["command"].startswith("vd-eval zero") and stored["torch"] == "2"
    assert "episodes" not in stored["rows"][0]
    for change in ({"code": "older"}, {"policy": "other weights"}, {"code": None}):
        (folder / "x.json").write_text(json.dumps({"a/zero": stored | change}))
        (page,) = figures.tables().values()
        assert figures.STALE in page.splitlines()[4] and figures.STALE_NOTE in page, change


def test_a_battery_of_the_gap_goes_on_and_is_of_its_own_code(folder, monkeypatch):
    """A case that is there is not run again, and what the battery finds stands in the table."""
    ran = []

    def found(case, folder, device):
        ran.append(case.name)
        result = {"case": vars(case), "verdict": "no_gap", "named": []} | NOTHING
        write_json(folder / f"{case.name}.json", result)
        return result

    def here(work, cases, finished, **_):
        for case in cases:
            finished(case, work(case), "")

    nothing = folder / "x.yaml"
    line = "vd-bench gap --model servo --kinds none --seeds 1"
    nothing.write_text(f"title: X\nlines: [{{name: a, command: {line}}}]\n")
    cell = "{x/a: nothing hidden: no false name/value}"
    tables = folder / "tables.yaml"
    tables.write_text(tables.read_text().replace("{x/a/zero: overall/outcomes/success}", cell))
    monkeypatch.setattr("vd.gap.bench.cases.run_tasks", here)
    monkeypatch.setattr("vd.gap.bench.battery.run_case", found)
    monkeypatch.setattr(
        subprocess,
        "run",
        lambda words: subprocess.CompletedProcess(words, main(words[words.index("-m") + 2 :])),
    )
    where = ["--out", str(folder / "out"), "--device", "cpu"]
    for extra in (["--shard", "0/2"], [], []):
        monkeypatch.setattr("sys.argv", ["figures.py", "run", "x", *where, *extra])
        assert figures.main() == 0
    assert len(ran) == len(set(ran)) == 40
    assert figures.collect("x", folder / "out") == 1
    (page,) = figures.tables().values()
    assert "|a|100.0|" in page
    stored = json.loads((folder / "x.json").read_text())["a"]
    assert stored["seed"] == 0 and stored["code"] == code_fingerprint(GAP) != code_fingerprint()
    assert stored["visual-dexterity"] and stored["date"] and stored["command"] == line


def test_turns_are_stored_with_their_policy_and_code(folder, monkeypatch):
    def turned(words):
        out = Path(words[words.index("--out") + 1])
        write_json(out / "spin.json", {"rows": [{"revolutions": 2.41}]})
        return subprocess.CompletedProcess(words, 0)

    suite = folder / "x.yaml"
    suite.write_text("title: X\nlines: [{name: a/zero, command: vd-eval zero --objects cube}]\n")
    tables = folder / "tables.yaml"
    cell = "{x/a/zero: overall/outcomes/success}"
    tables.write_text(tables.read_text().replace(cell, "{x/a/zero: revolutions}"))
    monkeypatch.setattr(subprocess, "run", turned)
    monkeypatch.setattr("sys.argv", ["figures.py", "run", "x", "--out", str(folder / "out")])
    assert figures.main() == 0
    assert figures.collect("x", folder / "out") == 1
    (page,) = figures.tables().values()
    assert "|a|2.4|" in page
    stored = json.loads((folder / "x.json").read_text())["a/zero"]
    (folder / "x.json").write_text(json.dumps({"a/zero": stored | {"policy": "other"}}))
    (page,) = figures.tables().values()
    assert figures.STALE in page


NOTHING = {"sets": [], "false": [], "found": [], "gap": 1.0, "left": 1.0, "shrunk": None}


def test_objects_of_a_figure_are_never_replaced(folder, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["figures.py", "run", "x", "--out", str(folder / "out")])
    assert figures.main() == 1
    assert "--objects held-out=FOLDER" in capsys.readouterr().err


def test_code_is_known_by_its_statements(tmp_path, monkeypatch):
    from importlib.machinery import ModuleSpec

    def digest(text):
        for name in ("", "shown"):
            (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / "a.py").write_text(text)
        code_fingerprint.cache_clear()
        return code_fingerprint()

    spec = ModuleSpec("x", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr("vd.command.versions.find_spec", lambda name: spec)
        first = digest("x = 1\n")
        assert digest('"""What it is."""\n\n# why\nx = 1  # because\n') == first
        assert digest("x = 2\n") != first
        assert digest('x = "#1"\n') != digest('x = "#2"\n'), "no comment"
        (tmp_path / "page.py").write_text("y = 1\n")
        assert digest("x = 1\n") == first, "what shows a result does not measure it"
        (tmp_path / "shown" / "sheet.py").write_text("y = 1\n")
        assert digest("x = 1\n") == first, "in folders, too"
        (tmp_path / "hand.usda").write_text("mass = 1\n")
        assert digest("x = 1\n") != first, "a hand is measured"
    assert "assets_usd" in MEASURING, "what imports decides what is measured"
    code_fingerprint.cache_clear()
