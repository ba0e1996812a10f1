"""Mesh files: what a file is, and its triangles."""

import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from vd.assets_usd.objects.settings import MeshError
from vd.assets_usd.objects.usd_mesh import read_usd, usd_unit

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".usd", ".usda", ".usdc", ".usdz")

HEAD_BYTES = 65536
"""Bytes in which a file says what it is."""

_FOREIGN = (
    (
        rb"version https://git-lfs",
        "a Git LFS pointer, not the mesh itself; fetch the mesh with git lfs pull",
    ),
    (
        rb"\s*(<!doctype html|<html)",
        "a web page, not a mesh: the download failed; download it again",
    ),
    (rb"\x1f\x8b|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd|7z\xbc\xaf|Rar!", "an archive; unpack it"),
)
"""Beginnings of what has the name of a mesh and is none, and what to do with it."""


def mesh_kind(path: Path) -> str:
    """Kind of a mesh file: ``obj``, ``stl``, ``ply``, ``glb`` or ``usd``.

    Raises:
        MeshError: The file is missing or empty, or something else, which the message names with a
            remedy.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError("a link to a file that is gone" if path.is_symlink() else "no such file")
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    if not head:
        raise MeshError("empty file")
    for beginning, what in _FOREIGN:
        if re.match(beginning, head, re.IGNORECASE):
            raise MeshError(what)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise MeshError(
            f"unsupported type {suffix or '(no suffix)'}; use {', '.join(MESH_SUFFIXES)}: export a "
            "CAD or scene file from the program that made it, and unpack an archive"
        )
    return suffix[1:4]  # usdz is a usd


def declared_unit(path: Path) -> float | None:
    """Metres in the unit that a mesh file declares, None if it declares none.

    glTF is in metres; a USD says its ``metersPerUnit``; OBJ, STL and PLY have no unit.
    """
    kind = mesh_kind(path)
    if kind == "usd":
        return usd_unit(path)
    return 1.0 if kind == "glb" else None


def load_mesh(path: Path) -> Any:
    """Load a mesh file as one ``trimesh.Trimesh`` in the file's unit, unprocessed.

    Raises:
        MeshError: Unsupported, unreadable, empty or cut short, without faces, or with non-finite
            vertices.
    """
    mesh = load_points(path)
    if not len(mesh.faces):
        points = f"{len(mesh.vertices)} points and " if len(mesh.vertices) else ""
        raise MeshError(
            f"not a mesh, or cut short: {points}no faces; get it again, or export it again"
        )
    return mesh


def load_points(path: Path) -> Any:
    """As :func:`load_mesh`, but a cloud of points is a mesh without faces.

    Raises:
        MeshError: Unsupported, unreadable or cut short, or with non-finite vertices.
    """
    path = Path(path)
    kind = mesh_kind(path)
    if kind == "usd":
        vertices, faces = read_usd(path)
    else:
        vertices, faces = _read_with_trimesh(path, kind)
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices)).any(axis=1).sum())
        raise MeshError(f"{bad} of {len(vertices)} vertices are NaN or infinite")
    return trimesh.Trimesh(vertices, faces, process=False)


def _read_with_trimesh(path: Path, kind: str) -> tuple[np.ndarray, np.ndarray]:
    data = path.read_bytes()
    declared = 0  # of a damaged file fewer faces would be read without a word
    if kind == "obj":
        # What trimesh stumbles over: tabs, lines that go on, comments behind corners.
        data = re.sub(rb"\t|\\\r?\n|#[^\n]*", b" ", data)
        declared = len(re.findall(rb"^\s*f ", data, re.MULTILINE))
    elif kind == "ply" and (said := re.search(rb"element\s+face\s+(\d+)", data[:HEAD_BYTES])):
        declared = int(said.group(1))
    try:
        # Textures and materials are not needed, and missing ones must not stop the import.
        loaded = trimesh.load(
            BytesIO(data), file_type=kind, process=False, maintain_order=True, skip_materials=True
        )
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        vertices = np.asarray(getattr(mesh, "vertices", ()), dtype=float).reshape(-1, 3)
        faces = np.asarray(getattr(mesh, "faces", ()), dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # parsers raise anything on a broken file
        raise MeshError(f"neither mesh nor points: {type(error).__name__}: {error}") from error
    if len(faces) < declared:
        raise MeshError(
            f"declares {declared} faces, of which {len(faces)} could be read: cut short or "
            "damaged; get it again, or export it again"
        )
    return vertices, faces
