"""What made a file: versions of installed packages, and of the code that measures."""

import ast
import hashlib
import io
import tokenize
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

MEASURING = ("kernels", "geometry", "assets_usd", "sim", "envs", "policy", "evaluate")
"""Packages that decide what an evaluation gives."""
SEEING = (*MEASURING, "sensors", "vision")
"""The same of policies that see by a camera."""
GAP = ("kernels", "logs", "gap")
"""Packages that decide what the gap workflow finds."""
SHOWING = frozenset(
    ["cli.py", "page.py", "sheet.py", "claims.py", "suite.py", "suite_run.py", "store.py", "suites"]
)
"""Files and folders in them that only ask and show."""


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Version of each package by its distribution's name; ``not installed`` where there is none."""
    versions = {}
    for name in packages:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions


@cache
def code_fingerprint(packages: tuple[str, ...] = MEASURING) -> str:
    """What tells the code that measures from other code: a digest of its packages' statements.

    Hands and their descriptions count too. Comments, docstrings and blank lines do not, nor does
    where it is installed.
    """
    digest = hashlib.sha256()
    for package in packages:
        spec = find_spec(f"vd.{package}")
        assert spec is not None
        assert spec.submodule_search_locations is not None
        (folder,) = spec.submodule_search_locations
        for file in sorted(Path(folder).rglob("*.*")):
            name = file.relative_to(folder)
            if file.suffix not in (".py", ".usda", ".yaml") or SHOWING.intersection(name.parts):
                continue
            text = file.read_text(encoding="utf-8")
            if file.suffix == ".py":
                text = _statements(text)
            digest.update(f"{package}/{name.as_posix()}\n{text}\n".encode())
    return digest.hexdigest()[:16]


def _statements(text: str) -> str:
    """Lines of a module without comments, docstrings and blank ones: the same in every Python."""
    lines = text.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            assert node.end_lineno is not None
            for row in range(node.lineno - 1, node.end_lineno):
                lines[row] = ""
    return "\n".join(line.rstrip() for line in lines if line.strip())
