"""Rules of ARCHITECTURE.md that a machine can check.

Layers, sizes, light commands, sourced constants.
"""

import ast
import math
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import networkx as nx
import pytest

from vd.paper import provenance

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SCRIPTS: dict[str, str] = PROJECT["project"]["scripts"]
PACKAGE_DIRS: dict[str, str] = PROJECT["tool"]["setuptools"]["package-dir"]
DOCUMENTS = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")} - {ROOT / "CHANGELOG.md"})
"""What users read; the list of changes names what is gone."""

MAX_FUNCTION_LINES = 80
LOOSE = {"__init__", "api", "gym", "paper"}
"""Modules of ``vd`` that stand in none of its folders."""
LEAVES = ("vd.paper", "vd.command")
"""The paper's constants, and what every command stands on."""
USD = (*LEAVES, "vd.kernels", "vd.assets_usd")
"""What simulation and perception stand on: kernels, hands and objects."""
DESCRIPTIONS = ("vd.envs.cfg", "vd.envs.shapes", "vd.envs.symmetry_frames", "vd.sensors.cfg")
"""What describes a task, and needs no simulator either."""
CAMERA = (*USD, "vd.geometry", "vd.policy", "vd.vision")
"""What policies that see by camera are made of; no simulator."""
ISLAND = (*LEAVES, "vd.logs", "vd.assets_usd", "vd.kernels.servo")
"""What the gap workflow reads: servo models, hands and objects in USD, recordings."""
# What each part may import of this project; the longest prefix of a module's name decides.
ALLOWED: dict[str, tuple[str, ...]] = {
    "vd.paper": (),
    "vd.command": ("vd.command",),
    "vd.kernels": ("vd.kernels",),
    "vd.assets_usd": USD,
    "vd.assets_usd.cli": (*USD, "vd.evaluate"),  # chooses a start by the task
    "vd.logs": (*LEAVES, "vd.assets_usd", "vd.logs"),
    "vd.sim": (*USD, "vd.sim"),
    "vd.sim.replay": ("vd.logs.motions", "vd.kernels", "vd.assets_usd", "vd.sim"),
    "vd.gap": (*ISLAND, "vd.gap"),
    "vd.gap.close": (*ISLAND, "vd.gap", "vd.sim.replay"),  # proves the outcome in Newton
    # Hidden machines know nothing of what they test.
    "vd.gap.bench.hidden_plant": ("vd.gap.bench.hidden_finger",),
    "vd.gap.bench.hidden_finger": ("vd.assets_usd.hand_data",),
    "vd.gap.bench.hidden_contact": (*LEAVES, "vd.logs", "vd.assets_usd", "vd.gap.bench"),
    "vd.gap.bench.hide": (
        *LEAVES,
        "vd.logs",
        "vd.assets_usd",
        "vd.kernels.servo.effects",
        "vd.gap.bench",
    ),
    "vd.geometry": (*USD, *DESCRIPTIONS, "vd.geometry"),
    "vd.policy": (*CAMERA, *DESCRIPTIONS),
    "vd.vision": (*CAMERA, *DESCRIPTIONS),
    "vd.envs": (*USD, "vd.sim", "vd.envs"),
    "vd.sensors": (*USD, "vd.sim", "vd.sensors"),
    "vd": ("vd",),
    "vd.train": ("vd",),
    "vd.deploy": ("vd",),
}
_ABOVE = ("vd.train", "vd.deploy")
FORBIDDEN: dict[str, tuple[str, ...]] = {
    "vd": (*_ABOVE, "vd.gap"),
    "vd.train": ("vd.deploy", "vd.gap"),
    "vd.deploy": ("vd.train", "vd.gap"),
    "vd.gap": (*_ABOVE, "vd.gap.bench"),
    "vd.gap.bench": _ABOVE,
    # The doors of the island: its commands, and those of its batteries and of programs.
    "vd.gap.cli": _ABOVE,
    "vd.bench.cli": _ABOVE,
    "vd.api": _ABOVE,
}
MAX_DEPTH = 8
"""Modules of ``vd.gap`` in the longest chain of imports."""
# Libraries that one part keeps to itself.
OWNED_LIBRARIES = {"pxr": "vd.assets_usd", "coacd": "vd.assets_usd", "rsl_rl": "vd.train"}
# Libraries whose import takes seconds: help must not wait for them.
HEAVY = {"torch", "newton", "mujoco", "pxr", "rsl_rl", "matplotlib", "coacd", "trimesh", "viser"}


def modules() -> Iterator[tuple[str, Path]]:
    """Every module of the package with its file, each once."""
    for package, folder in PACKAGE_DIRS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            yield ".".join([package, *(part for part in parts if part != "__init__")]), path


@cache
def tree(path: Path) -> ast.Module:
    """A file as its syntax."""
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> set[str]:
    """Names of all modules a file imports, inside functions and for type checking too."""
    names = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; name the module in full"
            names |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def within(name: str, prefix: str) -> bool:
    """Whether ``name`` is the module ``prefix`` or lies below it."""
    return name == prefix or name.startswith(prefix + ".")


def rule(table: dict[str, tuple[str, ...]], module: str) -> tuple[str, ...]:
    """The entry of the longest prefix of ``module`` in ``table``."""
    return table.get(max((key for key in table if within(module, key)), key=len, default=""), ())


def test_imports_go_one_way():
    wrong = []
    for module, path in modules():
        for name in imports(path):
            if not within(name, "vd") or name == "vd":
                continue
            # `from vd.paper import PAPER` yields vd.paper and vd.paper.PAPER: both lie within
            # vd.paper.
            allowed = any(within(name, prefix) for prefix in rule(ALLOWED, module))
            forbidden = any(within(name, prefix) for prefix in rule(FORBIDDEN, module))
            if forbidden or not allowed:
                wrong.append(f"{module} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_modules_stand_in_folders():
    assert {path.stem for path in (ROOT / "vd").glob("*.py")} == LOOSE, "ARCHITECTURE.md"


def imports_graph() -> nx.DiGraph:
    """Which module imports which."""
    names = dict(modules())
    return nx.DiGraph(
        (module, name)
        for module, path in names.items()
        for name in imports(path) & names.keys() - {module}
    )


def test_chains_of_imports_in_the_gap_workflow_are_short():
    graph = imports_graph()
    island = graph.subgraph(module for module in graph if within(module, "vd.gap"))
    chain = nx.dag_longest_path(island)
    assert len(chain) <= MAX_DEPTH, f"{len(chain)} modules: {' -> '.join(chain)}"


def test_no_modules_import_each_other():
    graph = imports_graph()
    circles = [circle for circle in nx.strongly_connected_components(graph) if len(circle) > 1]
    wrong = ["\n".join(f"{a} imports {b}" for a, b in graph.subgraph(c).edges) for c in circles]
    assert not wrong, "in circles:\n" + "\n\n".join(wrong)


def test_kernels_import_nothing_but_warp():
    for module, path in modules():
        if within(module, "vd.kernels"):
            others = {name.split(".")[0] for name in imports(path)} - {
                "vd",
                "warp",
                *sys.stdlib_module_names,
            }
            assert not others, f"{module} imports {others}"


def test_libraries_stay_with_their_owner():
    wrong = [
        f"{module} imports {name}"
        for module, path in modules()
        for name in imports(path)
        if not within(module, OWNED_LIBRARIES.get(name.split(".")[0], "vd"))
    ]
    assert not wrong, "\n".join(wrong)


def test_functions_are_short():
    long = {
        (module, node.name): lines
        for module, path in modules()
        if not within(module, "vd.kernels")
        for node in ast.walk(tree(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (lines := node.end_lineno - node.lineno + 1 - docstring_lines(node))
        > MAX_FUNCTION_LINES
    }
    assert not long, f"over {MAX_FUNCTION_LINES} lines, docstring apart: {long}"


def docstring_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function's docstring."""
    first = function.body[0]
    return first.end_lineno - first.lineno + 1 if ast.get_docstring(function) is not None else 0


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_works_and_loads_nothing_heavy(script, tmp_path):
    """Of the command alone, and of each subcommand that documents name."""
    text = "\n".join(path.read_text() for path in DOCUMENTS)
    subcommands = sorted({"", *re.findall(rf"\b{script} ([a-z][a-z-]*[a-z])\b", text)})
    module, function = SCRIPTS[script].split(":")
    code = f"""
import contextlib, importlib, io, sys
for words in {[name.split() for name in subcommands]!r}:
    sys.argv, said = [{script!r}, *words, "--help"], io.StringIO()
    with contextlib.redirect_stdout(said):
        try:
            status = importlib.import_module({module!r}).{function}()
        except SystemExit as stop:
            status = stop.code
    loaded = {HEAVY!r} & set(sys.modules)
    assert not status and "--help" in said.getvalue() and not loaded, (words, status, loaded)
"""
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_every_constant_names_its_source():
    rows = provenance()
    assert rows
    for name, value, tag, note in rows:
        assert tag in {"P", "C", "U", "D"}, f"{name}: unknown tag {tag!r}"
        assert len(note) > 3, f"{name}: where does it come from?"
        if name.endswith("_code"):
            assert tag == "C", f"{name}: *_code is for values of the released code"
        numbers = value if isinstance(value, tuple) else (value,)
        assert all(math.isfinite(number) for number in numbers), name
