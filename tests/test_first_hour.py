"""What a newcomer meets first.

Names that are wrong, quiet starts, and command lines of the documentation.
"""

import importlib
import importlib.util
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import warp as wp

from vd.train.cli import USAGE as TRAIN_USAGE

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
PAGES = (
    *sorted({*ROOT.glob("*.md")} - {ROOT / "CHANGELOG.md"}),
    *sorted((ROOT / "docs").rglob("*.md")),
)
"""What users read; the list of changes names what is gone."""
HEAVY = {"torch", "newton", "warp", "pxr", "mujoco", "matplotlib", "viser"}
RUN = """
import contextlib, importlib, io, json, sys
for module, arguments, said in json.loads(sys.argv[1]):
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors):
        status = importlib.import_module(module).main(arguments)
    loaded = {heavy} & set(sys.modules)
    assert status == 1 and said in errors.getvalue(), (arguments, status, errors.getvalue())
    assert not loaded, (arguments, loaded)
"""
WRONG = {
    "vd-play nosuch": "no policy at nosuch",
    "vd-play --objects nosuchset": "no object set or path 'nosuchset'",
    "vd-eval nosuch": "no policy at nosuch",
    "vd-eval dclaw4-cube --objects held-out=nosuchset": "no object set or path 'nosuchset'",
    "vd-eval zero --hand dclaw9": "no hand is called 'dclaw9'",
    "vd-deploy --hand dclaw9 --twin": "no hand is called 'dclaw9'",
    "vd-deploy --hand dclaw3 --twin --object nosuchset": "no object set or path 'nosuchset'",
    "vd-deploy zero --ros2 --random-goals 2": "--random-goals is in place of --ros2",
    "vd-train teacher --env.objects nosuchset": "no object set or path 'nosuchset'",
    "vd-train student --stage 1 --teacher nosuch": "no policy at nosuch",
}
DAMAGED = dict.fromkeys(
    ("vd-eval bad.pt", "vd-play bad.pt", "vd-bench sim --policy bad.pt"), "bad.pt"
)


@pytest.mark.parametrize(
    ("lines", "heavy"),
    [(WRONG, HEAVY), (DAMAGED, {"newton", "mujoco", "pxr"})],
    ids=["wrong names", "no policy"],
)
def test_what_cannot_be_used_is_refused_before_anything_slow_is_imported(lines, heavy, tmp_path):
    """Torch and Warp are needed to read a policy; the simulator is not."""
    (tmp_path / "bad.pt").write_text("no policy")
    calls = []
    for line, said in lines.items():
        command, *arguments = shlex.split(line)
        calls.append((SCRIPTS[command].partition(":")[0], arguments, said))
    run = [sys.executable, "-c", RUN.format(heavy=heavy), json.dumps(calls)]
    done = subprocess.run(run, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["bad.pt"], (
        "what is refused leaves nothing behind"
    )


@pytest.mark.skipif(wp.is_cuda_available(), reason="this machine has a GPU driver")
def test_warp_does_not_warn_of_the_gpu_that_a_cpu_machine_lacks():
    code = "import warp, os, vd.command.warp_quiet as w; w.quiet_warp(); warp.init(); os.write(2, b'ours')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "ours"


class ParsedError(Exception):
    """Raised in place of running a command, once its line was understood."""


def documented_lines():
    """Every command line of the pages: those of code blocks, and those in running text."""
    for page in PAGES:
        text = page.read_text()
        for block in re.findall(
            r"^ *```(?:bash|sh|console)?\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE
        ):
            for line in block.replace("\\\n", " ").splitlines():
                if re.match(r"\s*vd-\w+(\s|$)", line):
                    yield (
                        page.name,
                        shlex.join(shlex.split(line.partition(" > ")[0], comments=True)),
                    )
        running = re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
        for code in re.findall(r"`(vd-[^`]* --[^`]+)`", running):
            yield page.name, " ".join(code.split())
    for example in re.findall(r" {2,}(vd-train .+)", TRAIN_USAGE):
        yield "vd-train --help", example


@pytest.mark.parametrize(("page", "line"), sorted(set(documented_lines())))
def test_command_lines_of_the_documentation_are_understood(page, line, monkeypatch):
    import tyro

    parse = tyro.cli

    def only_parse(*args, **kwargs):
        parse(*args, **kwargs)
        raise ParsedError

    monkeypatch.setattr(tyro, "cli", only_parse)
    command, *arguments = shlex.split(line)
    monkeypatch.setattr(sys, "argv", [command, *arguments])
    try:
        importlib.import_module(SCRIPTS[command].partition(":")[0]).main()
    except (ParsedError, SystemExit) as end:
        assert isinstance(end, ParsedError) or end.code == 0, f"{page}: {line}"


def test_pages_of_the_reference_are_what_the_code_says():
    """``make reference`` writes them anew."""
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "site_pages.py")
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    written = {page: page.read_text() for page in (ROOT / "docs").rglob("*.md")}
    stale = [page.name for page, text in written.items() if pages.generated(text) != text]
    assert not stale, "make reference"
    made = set(re.findall(r"<!-- generated: (\w+) -->", "".join(written.values())))
    assert made == set(pages.GENERATED)
    for name in ("cli", "constants", "effects", "python", "registers"):
        assert len((ROOT / "docs" / "reference" / f"{name}.md").read_text()) > 1900, name


def test_all_places_name_the_same_versions_of_python():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    first, last = (int(version.partition(".")[2]) for version in (versions[0], versions[-1]))
    assert [f"3.{minor}" for minor in range(first, last + 1)] == versions and last >= 13
    assert project["requires-python"] == f">=3.{first},<3.{last + 1}"
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    assert f"python: {json.dumps(versions)}" in workflow
    makefile = (ROOT / "Makefile").read_text()
    for version in versions:
        assert f"python{version}" in makefile and f"(3, {version[2:]})" in makefile
    for page in ("README.md", "docs/install.md", ".ci/run", "constraints.txt"):
        assert f"Python {versions[0]} to {versions[-1]}" in (ROOT / page).read_text(), page


def test_the_tests_say_which_file_they_are_in():
    run = [sys.executable, "-m", "pytest", "-n", "1", "--dist", "loadfile", "tests/test_clouds.py"]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and re.search(r"\d s  tests/test_clouds\.py$", done.stdout, re.M)
