"""Functions of a user by name, ``module:function``, also of modules of the working folder."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def named_function(name: str, what: str) -> Callable[..., Any]:
    """The function ``module:function``.

    Args:
        name: Its name.
        what: What it is to be, for the message.

    Raises:
        ValueError: There is none.
    """
    module, _, function = name.partition(":")
    here = str(Path.cwd())
    sys.path.append(here)
    try:
        found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    except Exception as error:
        raise ValueError(
            f"{what} {name!r} is not found ({error}); name it module:function, and run where "
            "that module can be imported"
        ) from error
    finally:
        sys.path.remove(here)
    return found
