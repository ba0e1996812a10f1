"""Named object sets in the asset cache: built-in ones are authored on first use."""

import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from vd.assets_usd.objects import procedural
from vd.assets_usd.objects.model import ObjectError, ObjectModel, object_files, read_hash, write_object

HELD_OUT_COUNT = 30
"""Objects of ``procedural-heldout``: a dozen worlds each in an evaluation of a few hundred."""

BUILT_IN = ("cube", "cuboid", "symmetric", "procedural-150-seed0", "procedural-heldout")
"""Sets named in help texts; ``procedural-<count>-seed<seed>`` and ``procedural-heldout-<count>-seed<seed>``
take any numbers."""


def objects_dir() -> Path:
    """Folder of the object sets in the asset cache."""
    from vd.assets_usd.cache import assets_dir

    return Path(assets_dir()) / "objects"


def built_in_models(name: str) -> Callable[[], list[ObjectModel]] | None:
    """The function that makes a built-in set, or None if the name is no built-in one."""
    if name == "cube":
        return lambda: [procedural.cube()]
    if name == "cuboid":
        return lambda: [procedural.cuboid()]
    if name == "symmetric":
        return lambda: [procedural.cube(), procedural.cuboid()]
    if name == "procedural-heldout":
        return lambda: procedural.procedural_set(HELD_OUT_COUNT, 0, held_out=True)
    match = re.fullmatch(r"procedural-(heldout-)?([1-9]\d*)-seed(\d+)", name)
    if match is None:
        return None
    count, seed, held_out = int(match.group(2)), int(match.group(3)), match.group(1) is not None
    return lambda: procedural.procedural_set(count, seed, held_out=held_out)


def write_set(folder: Path, models: list[ObjectModel]) -> list[Path]:
    """Write one file per object into a folder; returns the paths."""
    return [write_object(Path(folder) / f"{model.name}.usd", model) for model in models]


def set_folder(name: str) -> Path:
    """Folder of a named set, authored first if it is a built-in one that is not there yet.

    Args:
        name: Such as ``cube``, ``procedural-150-seed0`` or the name of an imported set.

    Raises:
        ObjectError: No such set; the message lists those there are and the commands that make more.
    """
    root = objects_dir()
    plain = re.fullmatch(r"[\w.-]+", name) is not None and name not in (".", "..")
    folder = root / name
    make = built_in_models(name) if plain else None
    if plain and folder.is_dir() and (files := object_files(folder)):
        if make is None or procedural.is_current(read_hash(files[0])):
            return folder
        shutil.rmtree(folder)  # of an older version of our families
    if make is None:
        there = (
            sorted(p.name for p in root.iterdir() if p.is_dir() and object_files(p)) if root.is_dir() else []
        )
        raise ObjectError(
            f"no object set or path {name!r}.\n"
            f"  built in: {', '.join(BUILT_IN)}\n"
            f"  in {root}: {', '.join(there) or 'none'}\n"
            f"  import meshes as a set: vd-assets import MESHES --out {root / name if plain else root}\n"
            "  author our own: vd-assets objects --procedural 150 --seed 0"
        )
    root.mkdir(parents=True, exist_ok=True)
    # Several ranks may ask at once: each writes aside, and the first to finish moves it into place.
    aside = Path(tempfile.mkdtemp(prefix=f".{name}.", dir=root))
    try:
        write_set(aside, make())
        aside.chmod(0o755)
        try:
            aside.replace(folder)
        except OSError:
            if not (folder.is_dir() and object_files(folder)):
                raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return folder
