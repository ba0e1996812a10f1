"""Functions of a user by name, ``module:function``, also of modules of the working folder."""

import sys
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any


def named_function(name: str, what: str) -> Callable[..., Any]:
    """The function ``module:function``.

    Args:
        name: Its name.
        what: What it is to be, for the message.

    Raises:
        ValueError: There is none.
    """
    here = str(Path.cwd())
    sys.path.append(here)
    try:
        found: Callable[..., Any] = resolve_name(name)
    except Exception as error:
        raise ValueError(
            f"{what} {name!r} is not found ({error}); name it module:function, and run where "
            "that module can be imported"
        ) from error
    finally:
        sys.path.remove(here)
    return found
