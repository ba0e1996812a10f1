"""Mesh files: what a file is, and its triangles."""

import json
import re
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.objects.settings import MeshError

KINDS = {
    ".obj": "obj",
    ".stl": "stl",
    ".ply": "ply",
    ".glb": "glb",
    ".usd": "usd",
    ".usda": "usd",
    ".usdc": "usd",
    ".usdz": "usd",
}
"""Kind of mesh by suffix."""

MESH_SUFFIXES = tuple(KINDS)

HEAD_BYTES = 65536
"""Bytes in which a file says what it is."""

_EXPORT = "export it as STL, OBJ, PLY or GLB from the program that made it"
_UNPACK = "unpack it and import what is in it"

_FOREIGN = (
    (rb"version https://git-lfs", "a Git LFS pointer, not the mesh itself; fetch the mesh with git lfs pull"),
    (rb"\s*(<!doctype html|<html)", "a web page, not a mesh: the download failed; download it again"),
    (rb"\s*ISO-10303-21", f"a STEP file: exact surfaces, no triangles; {_EXPORT}"),
    (rb"\s*(CASCADE Topology|DBRep_DrawableShape)", f"a BREP file: exact surfaces, no triangles; {_EXPORT}"),
    (rb"\x1f\x8b|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd|7z\xbc\xaf|Rar!", f"a compressed archive; {_UNPACK}"),
    (rb"(?s).{257}ustar", f"a tar archive; {_UNPACK}"),
    (rb"DRACO", f"a Draco compressed mesh; {_EXPORT}"),
    (rb"Kaydara FBX|; FBX", f"an FBX file; {_EXPORT}"),
    (rb"BLENDER", "a Blender file; export it as STL, OBJ, PLY or GLB from Blender"),
    (rb"(?s)\s*<\?xml.{0,400}<COLLADA", f"a COLLADA file; {_EXPORT}"),
)
"""Beginnings of files that are no mesh of a supported kind, and what to do with them."""

_FOREIGN_SUFFIXES = {
    ".igs": f"an IGES file: exact surfaces, no triangles; {_EXPORT}",
    ".iges": f"an IGES file: exact surfaces, no triangles; {_EXPORT}",
    ".gltf": "a glTF with its data in other files; export it as one .glb",
}
"""The same for what has no such beginning."""

_COMPRESSIONS = {"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshopt"}
"""Extensions of glTF without which no triangle can be read."""


def mesh_kind(path: Path) -> str:
    """Kind of a mesh file: ``obj``, ``stl``, ``ply``, ``glb`` or ``usd``.

    Raises:
        MeshError: The file is missing or empty, or something else, which the message names with a remedy.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError("a link to a file that is gone" if path.is_symlink() else "no such file")
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    if not head:
        raise MeshError("empty file")
    suffix = path.suffix.lower()
    for beginning, what in _FOREIGN:
        if re.match(beginning, head, re.IGNORECASE):
            raise MeshError(what)
    if suffix in _FOREIGN_SUFFIXES:
        raise MeshError(_FOREIGN_SUFFIXES[suffix])
    kind = KINDS.get(suffix)
    if head.startswith(b"PK\x03\x04") and suffix != ".usdz":
        raise MeshError(f"a 3MF file; {_EXPORT}" if suffix == ".3mf" else f"a zip archive; {_UNPACK}")
    if kind is None:
        raise MeshError(f"unsupported type {suffix or '(no suffix)'}; use {', '.join(MESH_SUFFIXES)}")
    if kind == "glb":
        _refuse_compressed(path)
    return kind


def _refuse_compressed(path: Path) -> None:
    """Refuse a binary glTF whose triangles need an extension that is not read."""
    with path.open("rb") as stream:
        header = stream.read(20)
        length = struct.unpack_from("<I", header, 12)[0] if len(header) == 20 else 0
        try:
            required = json.loads(stream.read(length)).get("extensionsRequired", ())
        except ValueError:  # reading it says so
            return
    for extension in _COMPRESSIONS.keys() & required:
        raise MeshError(
            f"a GLB with {_COMPRESSIONS[extension]} compression ({extension}), which is not read; "
            "export it again without compression"
        )


def declared_unit(path: Path) -> float | None:
    """Metres in the unit that a mesh file declares, None if it declares none.

    glTF is in metres; a USD says its ``metersPerUnit``; OBJ, STL and PLY have no unit.
    """
    kind = mesh_kind(path)
    if kind == "usd":
        from vd.assets_usd.objects.usd_mesh import usd_unit

        return usd_unit(path)
    return 1.0 if kind == "glb" else None


def load_mesh(path: Path) -> Any:
    """Load a mesh file as one ``trimesh.Trimesh`` in the file's unit, unprocessed.

    Raises:
        MeshError: Unsupported, unreadable, empty or cut short, without faces, or with non-finite vertices.
    """
    mesh = load_points(path)
    if not len(mesh.faces):
        points = len(mesh.vertices)
        raise MeshError(f"not a mesh: {points} points and no faces" if points else "empty: no faces")
    return mesh


def load_points(path: Path) -> Any:
    """As :func:`load_mesh`, but a cloud of points is a mesh without faces.

    Raises:
        MeshError: Unsupported, unreadable or cut short, or with non-finite vertices.
    """
    import trimesh

    path = Path(path)
    kind = mesh_kind(path)
    if kind == "usd":
        from vd.assets_usd.objects.usd_mesh import read_usd

        vertices, faces = read_usd(path)
    elif kind == "obj":
        vertices, faces = read_obj(path)
    else:
        vertices, faces = _read_with_trimesh(path, kind)
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices)).any(axis=1).sum())
        raise MeshError(f"{bad} of {len(vertices)} vertices are NaN or infinite")
    return trimesh.Trimesh(vertices, faces, process=False)


def _read_with_trimesh(path: Path, kind: str) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    declared = declared_faces(path, kind)
    try:
        # Textures and materials are not needed, and missing ones must not stop the import.
        loaded = trimesh.load(path, file_type=kind, process=False, skip_materials=True)
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        vertices = np.asarray(getattr(mesh, "vertices", ()), dtype=float).reshape(-1, 3)
        faces = np.asarray(getattr(mesh, "faces", ()), dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # parsers raise anything on a broken file
        raise MeshError(f"neither mesh nor points: {type(error).__name__}: {error}") from error
    if len(faces) < declared:
        raise MeshError(
            f"declares {declared} faces, of which {len(faces)} could be read: cut short or damaged; "
            "get it again, or export it again"
        )
    return vertices, faces


def declared_faces(path: Path, kind: str) -> int:
    """Least number of triangles that a file says it has; 0 for kinds that do not say."""
    if kind == "ply":
        with path.open("rb") as stream:
            said = re.search(rb"element\s+face\s+(\d+)", stream.read(HEAD_BYTES))
        return int(said.group(1)) if said else 0
    if kind == "stl":
        data = path.read_bytes()
        count = int(struct.unpack_from("<I", data, 80)[0]) if len(data) >= 84 else 0
        text = b"\0" not in data[:HEAD_BYTES] and len(data) != 84 + 50 * count
        return len(re.findall(rb"\bfacet\s+normal\b", data, re.IGNORECASE)) if text else count
    return 0


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and triangles [T, 3] of an OBJ, in the file's order; polygons become fans.

    Only ``v`` and ``f`` are read: groups, normals, textures and materials do not matter here.

    Raises:
        MeshError: A line cannot be read, or a face names a vertex that is not there.
    """
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    furthest, where = -1, 0
    text = re.sub(rb"\\\r?\n", b" ", Path(path).read_bytes())
    for number, line in enumerate(text.splitlines(), 1):
        word, *rest = line.partition(b"#")[0].split() or [b""]
        try:
            if word == b"v":
                x, y, z = map(float, rest[:3])
                vertices.append([x, y, z])
            elif word == b"f":
                corners = [_corner(name, len(vertices)) for name in rest]
                faces += [(corners[0], *pair) for pair in pairwise(corners[1:])]
                if max(corners) > furthest:
                    furthest, where = max(corners), number
        except (ValueError, IndexError) as error:
            shown = line.decode(errors="replace").strip()[:60]
            raise MeshError(f"damaged: line {number} is {shown!r}; export it again") from error
    if furthest >= len(vertices):
        raise MeshError(
            f"damaged: line {where} names vertex {furthest + 1} of {len(vertices)}; export it again"
        )
    return np.array(vertices, dtype=float).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)


def _corner(text: bytes, count: int) -> int:
    """Index from 0 of a face's corner such as ``3/1/2``, or ``-1`` for the last of ``count`` vertices."""
    index = int(text.partition(b"/")[0])
    row = index - 1 if index > 0 else count + index
    if index == 0 or row < 0:
        raise ValueError(f"no vertex {index}")
    return row
