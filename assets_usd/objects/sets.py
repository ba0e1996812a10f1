"""Named object sets in the asset cache: built-in ones are authored on first use."""

import re
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from vd.assets_usd.objects.model import (
    ObjectError,
    ObjectModel,
    object_files,
    read_object,
    read_origin,
    write_object,
)
from vd.files import make_folder, writing

HELD_OUT_COUNT = 30
"""Objects of ``procedural-heldout``: a dozen worlds each in an evaluation of a few hundred."""

BUILT_IN = ("cube", "cuboid", "symmetric", "procedural-150-seed0", "procedural-heldout")
"""Sets named in help texts; ``procedural-<count>-seed<seed>`` and ``procedural-heldout-<count>-seed<seed>``
take any numbers."""

_PROCEDURAL = re.compile(r"procedural-(heldout-)?([1-9]\d*)-seed(\d+)")


def objects_dir() -> Path:
    """Folder of the object sets in the asset cache."""
    from vd.assets_usd.cache import assets_dir

    return Path(assets_dir()) / "objects"


def built_in_models(name: str) -> Callable[[], list[ObjectModel]] | None:
    """The function that makes a built-in set, or None if the name is no built-in one."""
    from vd.assets_usd.objects import procedural

    if name == "cube":
        return lambda: [procedural.cube()]
    if name == "cuboid":
        return lambda: [procedural.cuboid()]
    if name == "symmetric":
        return lambda: [procedural.cube(), procedural.cuboid()]
    if name == "procedural-heldout":
        return lambda: procedural.procedural_set(HELD_OUT_COUNT, 0, held_out=True)
    match = _PROCEDURAL.fullmatch(name)
    if match is None:
        return None
    count, seed, held_out = int(match.group(2)), int(match.group(3)), match.group(1) is not None
    return lambda: procedural.procedural_set(count, seed, held_out=held_out)


def built_in_folder(name: str) -> Path:
    """Folder of a built-in set, apart from the sets of users; each version of our families has its own."""
    from vd.assets_usd.cache import assets_dir
    from vd.assets_usd.objects import procedural

    return Path(assets_dir()) / "built-in" / f"version-{procedural.PROCEDURAL_VERSION}" / name


def write_set(folder: Path, models: list[ObjectModel]) -> list[Path]:
    """Write one file per authored object into a folder; returns the paths.

    Raises:
        ObjectError: A file that is there is another object; nothing is written.
    """
    targets = [Path(folder) / f"{model.name}.usd" for model in models]
    for target, model in zip(targets, models, strict=True):
        if target.exists() and read_origin(target) != (model.source, model.file):
            raise ObjectError(f"{target} is there and another object; write to another folder (--out)")
    return [write_object(target, model) for target, model in zip(targets, models, strict=True)]


def check_sets(names_or_paths: Iterable[str | Path]) -> None:
    """Refuse what :func:`load_set` would not find, without reading or making it.

    Raises:
        ObjectError: An entry is neither a path nor a set, or a folder holds no object.
    """
    for entry in names_or_paths:
        if not _is_built_in(str(entry)) and _named_path(entry) is None and not _is_there(str(entry)):
            raise _no_such_set(str(entry))


def _is_built_in(name: str) -> bool:
    """Whether it is the name of a built-in set; a folder that happens to have one is left alone."""
    return name in BUILT_IN or _PROCEDURAL.fullmatch(name) is not None


def _named_path(entry: str | Path) -> Path | None:
    """The file or folder of objects that an entry names, if it is no set's name.

    Raises:
        ObjectError: The folder holds no object, and no set in the cache has its name.
    """
    path = Path(entry).expanduser()
    if path.is_file():
        return path
    if not path.is_dir() or (isinstance(entry, str) and _is_built_in(entry)):
        return None
    if object_files(path):
        return path
    if not _is_there(str(entry)):  # a folder of meshes, beside the set that was imported from it
        raise ObjectError(f"{path}: no object file (*.usd); make some of its meshes: vd-assets import {path}")
    return None


def _is_plain(name: str) -> bool:
    """Whether it can be a folder's name in the cache."""
    return re.fullmatch(r"[\w.-]+", name) is not None and name not in (".", "..")


def _is_there(name: str) -> bool:
    """Whether the cache has a set of this name."""
    folder = objects_dir() / name
    return _is_plain(name) and folder.is_dir() and bool(object_files(folder))


def _no_such_set(name: str) -> ObjectError:
    root = objects_dir()
    out = root / name if _is_plain(name) else root
    there = sorted(p.name for p in root.iterdir() if p.is_dir() and object_files(p)) if root.is_dir() else []
    return ObjectError(
        f"no object set or path {name!r}.\n"
        f"  built in: {', '.join(BUILT_IN)}\n"
        f"  in {root}: {', '.join(there) or 'none'}\n"
        f"  import meshes as a set: vd-assets import MESHES --out {out}\n"
        "  author our own: vd-assets objects --procedural 150 --seed 0"
    )


def set_folder(name: str) -> Path:
    """Folder of a named set, authored first if it is a built-in one that is not there yet.

    The names of built-in sets are reserved: a folder that happens to have one is left alone.

    Args:
        name: Such as ``cube``, ``procedural-150-seed0`` or the name of an imported set.

    Raises:
        ObjectError: No such set; the message lists those there are and the commands that make more.
    """
    make = built_in_models(name) if _is_plain(name) else None
    if make is None:
        if not _is_there(name):
            raise _no_such_set(name)
        return objects_dir() / name
    folder = built_in_folder(name)
    if folder.is_dir() and object_files(folder):
        return folder
    make_folder(folder.parent)
    # Several ranks may ask at once: each writes aside, and the first to finish moves it into place.
    with writing(folder):
        aside = Path(tempfile.mkdtemp(prefix=f".{name}.", dir=folder.parent))
    try:
        with writing(folder):
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


def set_files(names_or_paths: Iterable[str | Path]) -> list[Path]:
    """The files of :func:`load_set`'s objects, each once; raises what that raises of entries and folders."""
    files: list[Path] = []
    for entry in names_or_paths:
        path = _named_path(entry) or set_folder(str(entry))
        files += [path] if path.is_file() else object_files(path)
    if not files:
        raise ObjectError("no object set was named; for example: cube, procedural-150-seed0, or a folder")
    return list(dict.fromkeys(files))


def load_set(names_or_paths: str | Path | Iterable[str | Path]) -> list[ObjectModel]:
    """Load objects: files, folders of files, or names of sets, in the order given.

    Args:
        names_or_paths: One entry or several. A name stands for a built-in set (``cube``, ``cuboid``,
            ``symmetric``, ``procedural-150-seed0``, ``procedural-heldout``), authored into the asset
            cache on first use, or for an imported set's folder there.

    Raises:
        ObjectError: An entry is neither, a folder holds no object, or two objects share a name.
    """
    files = set_files([names_or_paths] if isinstance(names_or_paths, str | Path) else names_or_paths)
    models = [read_object(path) for path in files]
    seen: dict[str, Path] = {}
    for model, path in zip(models, files, strict=True):
        if model.name in seen:
            raise ObjectError(f"{path}: object {model.name} is also in {seen[model.name]}; leave one out")
        seen[model.name] = path
    return models
