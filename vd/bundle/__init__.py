"""Deployable bundles: a policy's weights, the contract it was made under, and golden values, without code."""

from pathlib import Path

CONTRACT_FILE = "contract.json"
"""The file that makes a folder a bundle."""


def is_bundle(path: str | Path) -> bool:
    """Whether a path is the folder of a bundle."""
    return (Path(path) / CONTRACT_FILE).is_file()
