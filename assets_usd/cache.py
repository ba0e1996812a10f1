"""Where authored assets are kept between runs."""

import os
from pathlib import Path

ENVIRONMENT_VARIABLE = "VD_ASSETS"
"""Name of the variable that moves the cache."""


def assets_dir() -> Path:
    """The folder of authored hands and objects: ``$VD_ASSETS``, or ``~/.cache/visual-dexterity``.

    The folder need not exist: writers create what they need.
    """
    chosen = os.environ.get(ENVIRONMENT_VARIABLE)
    return Path(chosen).expanduser() if chosen else Path.home() / ".cache" / "visual-dexterity"
