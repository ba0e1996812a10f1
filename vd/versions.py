"""Versions of installed packages, to be written beside what they made."""

import os
import subprocess
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Version of each package by its distribution's name; ``not installed`` where there is none."""
    found = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def source_commit() -> str:
    """Short hash of the commit of this source, ``-dirty`` where it was changed since.

    Of a copy without git's data the variable ``VD_COMMIT`` says it; else it is empty.
    """
    if told := os.environ.get("VD_COMMIT"):
        return told
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        here = Path(__file__).resolve().parent
        done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()
