"""The folders are one package, `vd`, in a wheel as in the editable install that runs the tests."""

import configparser
import importlib.metadata
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from vd.evaluate.agents import SHIPPED_POLICIES

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE_DIRS: dict[str, str] = PROJECT["tool"]["setuptools"]["package-dir"]
MAX_POLICY_BYTES = 10 * 2**20
# One module of every top-level package, among them the ones whose folder lies outside vd/.
IMPORTED = ["vd.paper", "vd.kernels", "vd.assets_usd", "vd.assets_usd.hands", "vd.train", "vd.deploy"]


def installed_names() -> set[str]:
    """Every Python file of the package folders, by its path after installation."""
    return {
        f"{package.replace('.', '/')}/{path.relative_to(ROOT / folder)}"
        for package, folder in PACKAGE_DIRS.items()
        for path in (ROOT / folder).rglob("*.py")
    }


def required_distributions() -> set[str]:
    """Names of everything that the package with its extra ``dev`` needs on this machine, directly or not."""
    needed: set[str] = set()
    project = PROJECT["project"]
    waiting = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    while waiting:
        requirement = Requirement(waiting.pop())
        name = canonicalize_name(requirement.name)
        extras = {"", *requirement.extras}
        if requirement.marker and not any(requirement.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        key = f"{name}[{','.join(sorted(requirement.extras))}]"
        if key in needed:
            continue
        needed.add(key)
        for text in importlib.metadata.requires(name) or []:
            child = Requirement(text)
            if not child.marker or any(child.marker.evaluate({"extra": extra}) for extra in extras):
                child.marker = None
                waiting.append(str(child))
    return {key.split("[")[0] for key in needed}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy: setuptools leaves build products beside its sources."""
    source = tmp_path_factory.mktemp("source")
    for folder in PACKAGE_DIRS.values():
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "--wheel-dir",
        folder,
        source,
    ]
    subprocess.run([sys.executable, "-m", "pip", *map(str, command)], check=True)
    (path,) = folder.glob("*.whl")
    return path


def imported_files(folder: Path | None, cwd: Path) -> dict[str, Path]:
    """Import the modules in a fresh interpreter, from ``folder`` first if given, and say where they lie."""
    code = (
        f"import sys, importlib; sys.path[:0] = {[str(folder)] if folder else []}\n"
        f"for name in {IMPORTED}: print(name, importlib.import_module(name).__file__)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    lines = [line.split(" ", 1) for line in run.stdout.splitlines() if line.startswith("vd.")]
    return {name: Path(path) for name, path in lines}


def test_wheel_holds_every_module_below_vd(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name for name in names if name.endswith(".py")} == installed_names()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"vd"}


def test_wheel_ships_every_policy_that_has_a_name(wheel):
    with zipfile.ZipFile(wheel) as archive:
        sizes = {name: archive.getinfo(name).file_size for name in archive.namelist() if name.endswith(".pt")}
    assert set(sizes) == {f"vd/policies/{path.name}" for path in SHIPPED_POLICIES.values()}
    assert {"dclaw4-cube", "dclaw3-table", "dclaw4-table"} <= set(SHIPPED_POLICIES)
    for name, path in SHIPPED_POLICIES.items():
        # An export, not a checkpoint: those hold optimiser and environments, and are larger.
        assert sizes[f"vd/policies/{name}.pt"] == path.stat().st_size < MAX_POLICY_BYTES


def test_wheel_ships_hands_templates_types_and_licence(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {"vd/assets_usd/usd/dclaw3.usda", "vd/assets_usd/usd/dclaw4.usda"} <= names
    templates = {name for name in names if name.endswith(".html")}
    assert templates == {f"vd/templates/{path.name}" for path in (ROOT / "vd/templates").iterdir()}
    assert "vd/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_console_scripts_point_at_functions(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (entry_points,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
        parser = configparser.ConfigParser()
        parser.read_string(archive.read(entry_points).decode())
        scripts = dict(parser["console_scripts"])
        assert scripts == PROJECT["project"]["scripts"]
        for script, target in scripts.items():
            module, function = target.split(":")
            source = archive.read(f"{module.replace('.', '/')}.py").decode()
            assert f"\ndef {function}(" in source, f"{script} calls {target}, which is not there"


def test_wheel_imports_from_a_fresh_folder(wheel, tmp_path):
    target = tmp_path / "site"
    command = ["install", "--quiet", "--no-deps", "--no-index", "--target", target, wheel]
    subprocess.run([sys.executable, "-m", "pip", *map(str, command)], check=True)
    assert {path.name for path in target.iterdir() if not path.name.endswith(".dist-info")} == {"vd", "bin"}
    scripts = {path.name for path in (target / "bin").iterdir()}
    assert scripts == set(PROJECT["project"]["scripts"])
    files = imported_files(target, tmp_path)
    assert set(files) == set(IMPORTED)
    assert all(path.is_relative_to(target) for path in files.values())


def test_editable_install_imports_the_checkout(tmp_path):
    files = imported_files(None, tmp_path)
    assert set(files) == set(IMPORTED)
    assert all(path.is_relative_to(ROOT) for path in files.values())


def test_constraints_pin_everything():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert not [name for name, version in pins.items() if "+" in version], "a build tag binds to one machine"
    pinned = {canonicalize_name(name) for name in pins}
    # torch itself pins the libraries of its CUDA build.
    missing = {
        n for n in required_distributions() - pinned if not n.startswith(("nvidia-", "cuda-", "triton"))
    }
    assert not missing, f"add to constraints.txt: {sorted(missing)}"


def test_what_messages_and_pages_tell_to_install_exists():
    told = set()
    for folder in (*PACKAGE_DIRS.values(), "docs"):
        for path in (ROOT / folder).rglob("*.*"):
            if path.suffix in (".py", ".md"):
                told |= set(re.findall(r"pip install [^\n`]*?'([^'\n]*\[[^'\n]*)'", path.read_text()))
    assert told == {f".[{extra}]" for extra in ("hardware", "export", "docs")}
    assert {"hardware", "export", "docs"} <= PROJECT["project"]["optional-dependencies"].keys()
