"""Named object sets in the asset cache: built-in ones are authored on first use."""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from vd.assets_usd.cache import assets_dir
from vd.assets_usd.objects.model import (
    ObjectError,
    ObjectModel,
    object_files,
    read_object,
    write_object,
)
from vd.command.files import make_folder, writing

HELD_OUT_COUNT = 30
"""Objects of ``procedural-heldout``: a dozen worlds each in an evaluation of a few hundred."""

BUILT_IN = ("cube", "cuboid", "cylinder", "symmetric", "procedural-150-seed0", "procedural-heldout")
"""Sets named in help texts; ``procedural-<count>-seed<seed>`` and
``procedural-heldout-<count>-seed<seed>`` and ``procedural-tools-...`` take any numbers."""

_PROCEDURAL = re.compile(r"procedural-(?:(heldout|tools)-)?([1-9]\d*)-seed(\d+)")


def objects_dir() -> Path:
    """Folder of the object sets in the asset cache."""
    return assets_dir() / "objects"


def built_in_folder(name: str) -> Path:
    """Folder of a built-in set, apart from the sets of users.

    Each version of our families has its own.
    """
    from vd.assets_usd.objects.procedural import PROCEDURAL_VERSION

    return assets_dir() / "built-in" / f"version-{PROCEDURAL_VERSION}" / name


def is_built_in(name: str) -> bool:
    """Whether it is the name of a built-in set; a folder that happens to have one is left alone."""
    return name in BUILT_IN or _PROCEDURAL.fullmatch(name) is not None


def check_set_folder(folder: Path) -> None:
    """Refuse a folder for objects that commands would take for a built-in set by its name.

    Raises:
        ObjectError: Names it, and another folder.
    """
    if is_built_in(folder.name):
        raise ObjectError(
            f"{folder}: {folder.name!r} is the name of a built-in object set, which commands would "
            f"take instead; say where with --out, such as --out "
            f"{folder.with_name(f'my-{folder.name}')}"
        )


def _built_in_models(name: str) -> list[ObjectModel]:
    from vd.assets_usd.objects.procedural import cube, cuboid, cylinder, procedural_set

    if name == "symmetric":
        return [cube(), cuboid()]
    for make in (cube, cuboid, cylinder):
        if name == make.__name__:
            return [make()]
    match = _PROCEDURAL.fullmatch(name)
    if match is None:
        return procedural_set(HELD_OUT_COUNT, 0, families="heldout")
    return procedural_set(int(match[2]), int(match[3]), families=match[1] or "training")


def write_set(folder: Path, models: list[ObjectModel]) -> list[Path]:
    """Write one file per object into a folder; returns the paths."""
    return [write_object(folder / f"{model.name}.usd", model) for model in models]


def check_sets(names_or_paths: Iterable[str | Path]) -> None:
    """Refuse what :func:`load_set` would not find, without reading or making it.

    Raises:
        ObjectError: An entry is neither a path nor a set, or a folder holds no object.
    """
    for entry in names_or_paths:
        _place(entry)


def _holds_objects(place: Path) -> bool:
    return place.is_file() or bool(object_files(place))


def _place(entry: str | Path) -> Path:
    """The file or folder of the objects that an entry names.

    That of a built-in set may not be there yet.

    Raises:
        ObjectError: There are none, and the message lists the sets and the commands that make
            more; or the name means two places.
    """
    path = Path(entry).expanduser()
    root = objects_dir()
    if isinstance(entry, str) and is_built_in(entry) and not path.is_file():
        return built_in_folder(entry)
    named = root / path.name if path.name == str(entry) else root
    # A folder of meshes does not hide the set that was imported from it.
    there = _holds_objects(named)
    if _holds_objects(path):
        if there and not path.samefile(named):
            raise ObjectError(
                f"{str(entry)!r} is both a folder here and a set; write ./{entry}, or {named}"
            )
        return path
    if there:
        return named
    if path.is_dir():
        raise ObjectError(
            f"{path}: no object file (*.usd); make some of its meshes: vd-assets import {path}"
        )
    imported = sorted({file.parent.name for file in root.glob("*/[!.]*.usd*")})
    raise ObjectError(
        f"no object set or path {str(entry)!r}.\n"
        f"  built in, for --objects: {', '.join(BUILT_IN)}\n"
        f"  in {root}: {', '.join(imported) or 'none'}\n"
        f"  import meshes as a set: vd-assets import MESHES --out {named}\n"
        "  of our own: procedural-150-seed0, procedural-tools-150-seed0, procedural-heldout-30-seed0 "
        "and other numbers"
    )


def _author(folder: Path) -> None:
    """Write a built-in set into its folder."""
    make_folder(folder.parent)
    # Several ranks may ask at once: each writes aside, and the first to finish moves it into place.
    with writing(folder), TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as aside:
        made = Path(aside) / folder.name
        write_set(made, _built_in_models(folder.name))
        try:
            made.replace(folder)
        except OSError:
            if not _holds_objects(folder):
                raise


def set_files(names_or_paths: Iterable[str | Path]) -> list[Path]:
    """The files of :func:`load_set`'s objects, each once.

    Raises what that raises of entries and folders.
    """
    files: list[Path] = []
    for entry in names_or_paths:
        place = _place(entry)
        if not _holds_objects(place):
            _author(place)
        files += object_files(place) or [place]
    if not files:
        raise ObjectError(
            "no object set was named; for example: cube, procedural-150-seed0, or a folder"
        )
    return list(dict.fromkeys(files))


def load_set(names_or_paths: str | Path | Iterable[str | Path]) -> list[ObjectModel]:
    """Load objects: files, folders of files, or names of sets, in the order given.

    Of two that are called alike the second is called after its folder too: hammer-ycb.

    Args:
        names_or_paths: One entry or several. A name stands for a built-in set (``cube``,
            ``cuboid``, ``symmetric``, ``procedural-150-seed0``, ``procedural-heldout``), authored
            into the asset cache on first use, or for an imported set's folder there.

    Raises:
        ObjectError: An entry is neither, a folder holds no object, or two objects share the name of
            their folder, too.
    """
    files = set_files(
        [names_or_paths] if isinstance(names_or_paths, str | Path) else names_or_paths
    )
    models: dict[str, ObjectModel] = {}
    for path in files:
        model = read_object(path)
        name = model.name
        if name in models:
            name = f"{name}-{path.parent.name}"
        if name in models:
            raise ObjectError(f"{path}: there are two objects {name}; leave one out")
        models[name] = replace(model, name=name)
    return list(models.values())
