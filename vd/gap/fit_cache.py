"""Results of the calls of a search, kept in files, so that an interrupted search goes on where it was.

A search is nothing but calls, each with all that its result depends on. Made again with the results at hand
it takes the same path, in no time, to where it was ended.
"""

import hashlib
import json
import pickle
import shutil
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vd.files import atomic_path

FOLDER = "fit-cache"
"""Where an analysis keeps what a step has found, while it runs."""
MADE_OF = {
    "vd.gap.coordinates": {"Coordinate", "Scales"},
    "vd.gap.joint_fit": {"JointFit", "SampleWeighting"},
    "numpy": {"dtype", "ndarray"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
}
"""What a result consists of, by module: a file from elsewhere can make nothing else, and run nothing."""


def digest_of(*values: Any) -> str:
    """A hash of values, the same for equal ones in any process.

    Raises:
        TypeError: A value, or one inside, is of another kind than what calls and their results are.
    """
    return hashlib.sha256(json.dumps(values, default=_plain, sort_keys=True).encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes().hex()]
    if is_dataclass(value):
        return [type(value).__name__, *(getattr(value, field.name) for field in fields(value))]
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} has no digest")


class FitCache:
    """Results by the digest of their calls, in memory and in a folder.

    Args:
        folder: Where to keep them; None: in memory only.
        about: What all of them depend on besides; results about something else are not found.
    """

    def __init__(self, folder: Path | None = None, about: str = ""):
        self.folder, self.about = folder, about
        self._known: dict[str, Any] = {}

    def __contains__(self, call: str) -> bool:
        """Whether a result is known; one that was cut short is not."""
        if call not in self._known and self.folder is not None:
            try:
                with self._file(call).open("rb") as file:
                    self._known[call] = _Reader(file).load()
            except (FileNotFoundError, EOFError, pickle.UnpicklingError):
                return False
        return call in self._known

    def __getitem__(self, call: str) -> Any:
        """The result; the same object every time."""
        return self._known[call]

    def add(self, call: str, result: Any) -> None:
        """Keep a result."""
        self._known[call] = result
        if self.folder is not None:
            with atomic_path(self._file(call)) as path:
                path.write_bytes(pickle.dumps(result))

    def forget(self) -> None:
        """Delete the files."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _file(self, call: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{digest_of(self.about, call)}.pickle"


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if name not in MADE_OF.get(module, ()):
            raise pickle.UnpicklingError(f"no result is made of {module}.{name}")
        return super().find_class(module, name)
