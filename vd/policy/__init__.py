"""Policies: layers, the contract they were made under, their files, and what they are told."""

from pathlib import Path

SUFFIX = ".safetensors"
"""How names of policies end."""
ONNX_SUFFIX = ".onnx"
"""How names end of what :mod:`vd.policy.onnx` runs."""


def has_suffix(path: str | Path, suffix: str) -> bool:
    """Whether a file's name ends so, in small letters or capital ones."""
    return Path(path).suffix.lower() == suffix


def check_suffix(path: Path, *suffixes: str) -> None:
    """Refuse a name for a file that ends otherwise.

    Raises:
        ValueError: It ends otherwise.
    """
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path} has to end in {' or '.join(suffixes)}; choose such a name")
