"""What an import reads, what the objects are called and where they are written."""

import csv
import os
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vd.assets_usd.objects.model import object_files, stored_facts
from vd.assets_usd.objects.reading import MESH_SUFFIXES
from vd.assets_usd.objects.sets import check_set_folder, objects_dir
from vd.assets_usd.objects.settings import MeshError
from vd.assets_usd.objects.usd_mesh import usd_files

GENERIC_WORDS = frozenset(
    re.findall(
        r"\w+",
        """asset clean cleaned collision convex decimated export exported geometry glb google
        highres lowres merged mesh meshes model models nontextured normalized obj object objects
        output ply poisson processed scan scene simple simplified stl textured tsdf untitled usd
        visual watertight""",
    )
)
"""Words that say what kind of file something is, not of what thing. Data sets have a folder for
each object and call the files alike (``003_cracker_box/google_16k/textured.obj``,
``Mug/meshes/model.obj``).
"""

CLASHES_SHOWN = 3
"""Files with one name that an error shows."""


@dataclass(frozen=True)
class Job:
    """One mesh to import.

    Attributes:
        source: Mesh file, absolute.
        name: Object name.
        target: USD file to write.
        licence: Licence of the shape.
        provenance: Where the shape comes from.
        split: ``train``, ``test`` or empty.
    """

    source: str
    name: str
    target: str
    licence: str = ""
    provenance: str = ""
    split: str = ""


def prim_name(stem: str) -> str:
    """A valid prim name from a file's stem: letters, digits and underscores, no leading digit.

    Latin letters lose their accents; others become their code points, so that names stay apart.
    """
    bare = re.sub("[\u0300-\u036f]", "", unicodedata.normalize("NFD", stem))
    spelled = [
        f"u{ord(letter):04x}" if letter.isalnum() and not letter.isascii() else letter
        for letter in unicodedata.normalize("NFC", bare)
    ]
    name = re.sub(r"[^0-9A-Za-z_]+", "_", "".join(spelled)).strip("_") or "object"
    return name if not name[0].isdigit() else f"o_{name}"


def says_nothing(word: str) -> bool:
    """Whether a file's or folder's name is of ``GENERIC_WORDS`` and resolutions (16k) alone."""
    words = [part for part in re.split(r"[\W_]+", word.lower()) if part]
    return all(part in GENERIC_WORDS or re.fullmatch(r"\d+k", part) for part in words)


def absolute(path: Path) -> Path:
    """The path without links to folders.

    A file keeps its name: downloads are links to nameless files.
    """
    return path.resolve() if path.is_dir() else path.parent.resolve() / path.name


def object_name(path: Path) -> str:
    """Name of the object in a mesh file.

    Its stem, or the nearest folder above it that says something.

    It depends on the file's path alone, so that it stays the same whatever else is imported.
    """
    path = absolute(path)
    names = [path.stem, *(folder.name for folder in path.parents if folder.name)]
    return prim_name(next((name for name in names if not says_nothing(name)), path.stem))


def find_meshes(paths: Iterable[Path]) -> list[Path]:
    """Mesh files among files and folders, each once, in a fixed order, absolute.

    A file that was named is kept whatever it is, so that it is refused by name. In a folder files
    count that have a mesh's suffix. Left out are what is hidden, our own objects, and parts of a
    USD that is found too.

    Raises:
        MeshError: A path does not exist, or nothing was found.
    """
    paths = list(paths)
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += _meshes_below(path)
        elif path.exists() or path.is_symlink():
            files.append(path)
        else:
            raise MeshError(f"{path}: no such file or folder")
    if not files:
        raise MeshError(
            f"no mesh in {', '.join(map(str, paths))}; supported: {', '.join(MESH_SUFFIXES)}; to "
            "be told what is wrong with a file, name it"
        )
    return list(dict.fromkeys(map(absolute, files)))


def _meshes_below(folder: Path) -> list[Path]:
    files = []
    left_out: set[Path] = set()
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        suffix = path.suffix.lower()
        if hidden or suffix not in MESH_SUFFIXES or not path.is_file():
            continue
        files.append(path)
        if suffix.startswith(".usd"):
            left_out |= {path.resolve()} if stored_facts(path) else _parts_of_usd(path)
    return [path for path in files if path.resolve() not in left_out]


def _parts_of_usd(path: Path) -> set[Path]:
    """The other files a USD is composed of; none if it cannot be opened, which its import says."""
    try:
        return set(usd_files(path)) - {path.resolve()}
    except MeshError:
        return set()


def read_sidecar(folder: Path) -> dict[str, dict[str, str]]:
    """Rows by name of the ``objects.csv`` in a folder or its parent; empty where there is none.

    Columns: ``name`` and ``source``; optionally ``licence`` and ``split``. Without a licence
    column, the licence is what stands in brackets in the source.
    """
    for table in (folder / "objects.csv", folder.parent / "objects.csv"):
        if table.is_file():
            with table.open(newline="") as stream:
                rows = list(csv.DictReader(stream))
            return {row["name"]: row for row in rows if row.get("name")}
    return {}


def plan_jobs(meshes: Iterable[Path], out: Path, licence: str) -> list[Job]:
    """What to make of each mesh; ``licence`` where no ``objects.csv`` names one.

    Raises:
        MeshError: Two meshes would have one name; the message has both, and the remedy.
    """
    taken: dict[str, Path] = {}
    clashes: list[str] = []
    for mesh in meshes:
        other = taken.setdefault(object_name(mesh), mesh)
        if other != mesh:
            clashes.append(f"  {object_name(mesh)}: {other} and {mesh}")
    if clashes:
        more = (
            f"\n  and {len(clashes) - CLASHES_SHOWN} more" if len(clashes) > CLASHES_SHOWN else ""
        )
        raise MeshError(
            "two meshes would have one name in the set:\n"
            + "\n".join(clashes[:CLASHES_SHOWN])
            + f"{more}\nName only the files that you want (such as FOLDER/*/textured.obj), "
            "rename one, or import one into another set (--out)"
        )
    sidecars: dict[Path, dict[str, dict[str, str]]] = {}
    jobs = []
    for name, mesh in taken.items():
        if mesh.parent not in sidecars:
            sidecars[mesh.parent] = read_sidecar(mesh.parent)
        row = sidecars[mesh.parent].get(mesh.stem, {})
        source = row.get("source") or ""
        bracket = re.search(r"\(([^)]*)\)", source)
        jobs.append(
            Job(
                str(mesh),
                name,
                str(out / f"{name}.usd"),
                licence=row.get("licence") or (bracket.group(1) if bracket else licence),
                provenance=f"{source}: {mesh.name}" if source else mesh.name,
                split=row.get("split") or "",
            )
        )
    return jobs


def check_target(job: Job) -> None:
    """Refuse to write over what is not this mesh's own object.

    Raises:
        MeshError: Names both, and the remedy.
    """
    target = Path(job.target)
    if not target.exists():
        return
    facts = stored_facts(target)
    if not facts:
        raise MeshError(
            f"{target} is there and no object of vd-assets, or a damaged one; remove it, or import "
            "into another folder (--out)"
        )
    file = str(facts["file"])
    if file and os.path.realpath(file) == os.path.realpath(job.source):
        return
    raise MeshError(
        f"{job.source} would be written over {target}, which was made from "
        f"{file or facts['source']}; rename the mesh, import it into another set (--out), or "
        "remove the object"
    )


def default_set(paths: Sequence[Path]) -> Path:
    """Folder in the asset cache for the objects of these paths.

    Named after the folder that holds them all.

    Raises:
        MeshError: The set holds objects from elsewhere.
        ObjectError: The name is that of a built-in set.
    """
    above = Path(os.path.commonpath(list(map(absolute, paths))))
    plain = re.sub(r"[^\w.-]+", "_", above.name).strip(".") or "objects"
    name = object_name(above) if above.is_file() else plain
    folder = objects_dir() / name
    other = f"say where with --out, such as --out {objects_dir() / f'my-{name}'}"
    check_set_folder(folder)
    for path in object_files(folder) if folder.is_dir() else ():
        file = stored_facts(path).get("file")
        if file and not Path(file).is_relative_to(above):
            raise MeshError(f"the set {folder} holds objects from elsewhere ({file}); {other}")
    return folder
