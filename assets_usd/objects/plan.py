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
    letters = unicodedata.normalize("NFC", bare)
    spelled = re.sub(r"[^\W\x00-\x7f]", lambda found: f"u{ord(found[0]):04x}", letters)
    name = re.sub(r"\W+", "_", spelled, flags=re.ASCII).strip("_") or "object"
    return f"o_{name}" if name[0].isdigit() else name


def says_nothing(word: str) -> bool:
    """Whether a file's or folder's name is of ``GENERIC_WORDS`` and resolutions (16k) alone."""
    words = set(re.findall(r"[^\W_]+", re.sub(r"\b\d+k\b", "", word.lower().replace("_", " "))))
    return words <= GENERIC_WORDS


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
    place = path.with_suffix("")
    while place.name and says_nothing(place.name):
        place = place.parent
    return prim_name(place.name or path.stem)


def find_meshes(paths: Sequence[Path]) -> list[Path]:
    """Mesh files among files and folders, each once, in a fixed order, absolute.

    A file that was named is kept whatever it is, so that it is refused by name. In a folder files
    count that have a mesh's suffix. Left out are what is hidden, our own objects, and parts of a
    USD that is found too.

    Raises:
        MeshError: A path does not exist, or nothing was found.
    """
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
        hidden = "/." in f"/{path.relative_to(folder)}"
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
                return {row.get("name", ""): row for row in csv.DictReader(stream)}
    return {}


def plan_jobs(meshes: Iterable[Path], out: Path, licence: str) -> list[Job]:
    """What to make of each mesh; ``licence`` where no ``objects.csv`` names one.

    Raises:
        MeshError: Two meshes would have one name; the message has both, and the remedy.
    """
    jobs: dict[str, Job] = {}
    sidecars: dict[Path, dict[str, dict[str, str]]] = {}
    for mesh in meshes:
        name = object_name(mesh)
        if name in jobs:
            raise MeshError(
                f"two meshes would have one name in the set, {name}: {jobs[name].source} and "
                f"{mesh}; name only the files that you want (such as FOLDER/*/textured.obj), "
                "rename one, or import one into another set (--out)"
            )
        if mesh.parent not in sidecars:
            sidecars[mesh.parent] = read_sidecar(mesh.parent)
        row = sidecars[mesh.parent].get(mesh.stem, {})
        source = row.get("source") or ""
        bracket = re.search(r"\(([^)]*)\)", source)
        jobs[name] = Job(
            str(mesh),
            name,
            str(out / f"{name}.usd"),
            licence=row.get("licence") or (bracket[1] if bracket else licence),
            provenance=f"{source}: {mesh.name}" if source else mesh.name,
            split=row.get("split") or "",
        )
    return list(jobs.values())


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
    above = Path(os.path.commonpath([absolute(path) for path in paths]))
    name = re.sub(r"[^\w.-]+", "_", above.name).strip(".") or "objects"
    if above.is_file():
        name = object_name(above)
    folder = objects_dir() / name
    check_set_folder(folder)
    for path in object_files(folder):
        file = stored_facts(path).get("file")
        if file and not Path(file).is_relative_to(above):
            raise MeshError(
                f"the set {folder} holds objects from elsewhere ({file}); say where with --out, "
                f"such as --out {objects_dir() / f'my-{name}'}"
            )
    return folder
