"""The folders are one package, `vd`, in a wheel as in the editable install that runs the tests."""

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

from vd.command.interrupt import EXTRAS, command
from vd.policy.agents import DEFAULT_POLICY, SHIPPED_POLICIES
from vd.train.cli import main

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE_DIRS: dict[str, str] = PROJECT["tool"]["setuptools"]["package-dir"]
MAX_POLICY_BYTES = 8 * 2**20


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
        if requirement.marker and not any(
            requirement.marker.evaluate({"extra": extra}) for extra in extras
        ):
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
    return {key.split("[")[0] for key in needed} - {canonicalize_name(project["name"])}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy: setuptools leaves build products beside its sources."""
    source = tmp_path_factory.mktemp("source")
    for folder in PACKAGE_DIRS.values():
        shutil.copytree(
            ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    folder = tmp_path_factory.mktemp("wheel")
    flags = ["--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir"]
    command = ["wheel", "--quiet", *flags, folder, source]
    subprocess.run([sys.executable, "-m", "pip", *map(str, command)], check=True)
    (path,) = folder.glob("*.whl")
    return path


def test_wheel_holds_modules_policies_and_what_else_is_read(wheel):
    with zipfile.ZipFile(wheel) as archive:
        sizes = {item.filename: item.file_size for item in archive.infolist()}
    assert {name for name in sizes if name.endswith(".py")} == installed_names()
    assert {name.split("/")[0] for name in sizes if ".dist-info/" not in name} == {"vd"}
    assert {
        f"vd/command/templates/{path.name}" for path in (ROOT / "vd/command/templates").iterdir()
    } <= sizes.keys()
    assert {
        f"vd/assets_usd/usd/{path.name}" for path in (ROOT / "assets_usd/usd").iterdir()
    } <= sizes.keys()
    assert "vd/py.typed" in sizes and any(name.endswith("licenses/LICENSE") for name in sizes)
    shipped = {DEFAULT_POLICY, f"{DEFAULT_POLICY}-vision"}  # others are pulled
    assert {name for name in sizes if name.endswith(".safetensors")} == {
        f"vd/policies/{name}.safetensors" for name in shipped
    }
    for path in SHIPPED_POLICIES.values():  # checkpoints hold optimiser and worlds: 100 MB
        assert path.stat().st_size < MAX_POLICY_BYTES


def test_wheel_runs_from_a_fresh_folder(wheel, tmp_path):
    target = tmp_path / "site"
    command = ["install", "--quiet", "--no-deps", "--no-index", "--target", target, wheel]
    subprocess.run([sys.executable, "-m", "pip", *map(str, command)], check=True)
    assert {path.name for path in target.iterdir() if not path.name.endswith(".dist-info")} == {
        "vd",
        "bin",
    }
    scripts = PROJECT["project"]["scripts"]
    assert {path.name for path in (target / "bin").iterdir()} == set(scripts)
    code = f"import sys, importlib\nsys.path.insert(0, {str(target)!r})\n"
    for script in scripts.values():
        module, function = script.split(":")
        code += f"m = importlib.import_module({module!r}); m.{function}; print(m.__file__)\n"
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert all(Path(line).is_relative_to(target) for line in run.stdout.splitlines())


def test_constraints_pin_everything():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert not [name for name, version in pins.items() if "+" in version], (
        "a build tag binds to one machine"
    )
    pinned = {canonicalize_name(name) for name in pins}
    # torch itself pins the libraries of its CUDA build.
    missing = {
        n
        for n in required_distributions() - pinned
        if not n.startswith(("nvidia-", "cuda-", "triton"))
    }
    assert not missing, f"add to constraints.txt: {sorted(missing)}"


def test_what_may_be_missing_is_in_the_extra_that_messages_and_pages_name():
    extras = PROJECT["project"]["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        brought = {canonicalize_name(Requirement(text).name) for text in extras[extra]}
        here = importlib.metadata.packages_distributions()
        assert {canonicalize_name(here[p][0]) for p in packages if p in here} <= brought, extra
    told = set()
    for folder in (*PACKAGE_DIRS.values(), "docs"):
        for path in (ROOT / folder).rglob("*.*"):
            if path.suffix in (".py", ".md"):
                told |= set(re.findall(r"'visual-dexterity\[(\w+)\]'", path.read_text()))
    assert {"hardware", "gym"} <= told <= EXTRAS.keys()


def test_a_missing_extra_is_named_before_anything_slow(monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["teacher"]) == 1 and "'visual-dexterity[train]'" in capsys.readouterr().err

    @command("vd-some")
    def imports_it() -> None:
        raise ModuleNotFoundError(name="pyarrow.parquet")

    assert imports_it() == 1 and "'visual-dexterity[recordings]'" in capsys.readouterr().err
