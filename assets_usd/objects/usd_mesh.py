"""A USD made elsewhere, read as one mesh; stage units, z up."""

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdUtils, Vt
from trimesh.util import append_faces

from vd.assets_usd.objects.geometry import MeshError, Surface
from vd.assets_usd.objects.model import is_object

_UNREAD = (
    "Cube",
    "Sphere",
    "Cylinder",
    "Capsule",
    "Cone",
    "PointInstancer",
    "NurbsPatch",
    "TetMesh",
)
"""Kinds of solid geometry that are not read."""

Z_FROM_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From a frame with y up to one with z up."""


def opened(path: Path) -> Any:
    """The stage of a USD file as it is composed: references, payloads and selected variants.

    Raises:
        MeshError: No USD, one of our own objects, or a file it refers to is missing.
    """
    silence = UsdUtils.CoalescingDiagnosticDelegate()  # what matters is raised here
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise MeshError("not a USD file, or a damaged one; export it again") from error
    finally:
        del silence
    if is_object(stage):
        raise MeshError("an object of vd-assets already; name it, or its folder, as an object set")
    errors = stage.GetCompositionErrors()
    if errors:
        raise MeshError(
            f"incomplete: {errors[0]}; put the file there, or export with everything in one file"
        )
    return stage


def usd_unit(path: Path) -> float | None:
    """``metersPerUnit`` of a USD file; None where it is not authored."""
    stage = opened(path)
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        return None
    return float(UsdGeom.GetStageMetersPerUnit(stage))


def usd_files(path: Path) -> list[Path]:
    """The files that a USD is composed of, itself included, sorted."""
    stage = opened(path)  # its layers live as long as it does
    used = {Path(layer.realPath).resolve() for layer in stage.GetUsedLayers() if layer.realPath}
    # Layers within a package have paths such as x.usdz[y.usdc].
    return sorted(file for file in used | {path.resolve()} if file.is_file())


def read_usd(path: Path) -> Surface:
    """All visible meshes below the default prim.

    Meshes for rendering are taken; where there are none, stand-ins (purpose ``proxy``). Those of
    purpose ``guide``, mostly colliders, are not. A surface to be subdivided is taken by its cage.

    Raises:
        MeshError: No USD, nothing to read in it, or geometry of a kind that is not read.
    """
    stage = opened(path)
    cache = UsdGeom.XformCache()
    parts = []
    for prim in _shown(stage):
        kind = prim.GetTypeName()
        if kind in _UNREAD:
            raise MeshError(f"{prim.GetPath()} is a {kind}, which is not read; make it a mesh")
        if kind == "Mesh":
            matrix = np.array(cache.GetLocalToWorldTransform(prim))
            parts.append(mesh_triangles(prim, matrix))
    if not parts:
        raise MeshError("no visible mesh below the default prim")
    vertices, faces = append_faces(*zip(*parts, strict=True))
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        vertices = vertices @ Z_FROM_Y.T
    return Surface(vertices, faces)


def _shown(stage: Any) -> list[Any]:
    """Visible prims below the default prim, instances included, with a purpose that is shown."""
    root = stage.GetDefaultPrim() or stage.GetPseudoRoot()
    rendered = []
    stand_ins = []
    for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies()):
        imageable = UsdGeom.Imageable(prim)
        shown = prim.IsA(UsdGeom.Boundable) and imageable.ComputeVisibility() != "invisible"
        purpose = imageable.ComputePurpose()
        if shown and purpose in ("default", "render"):
            rendered.append(prim)
        elif shown and purpose == "proxy":
            stand_ins.append(prim)
    return rendered or stand_ins


def mesh_triangles(prim: Any, matrix: np.ndarray) -> Surface:
    """A UsdGeomMesh as triangles: polygons become fans.

    Args:
        prim: The mesh.
        matrix: Where it is moved, a transform of row vectors [4, 4]; a mirror turns the triangles.

    Raises:
        MeshError: Its faces do not fit together.
    """
    mesh = UsdGeom.Mesh(prim)
    first = Usd.TimeCode.EarliestTime()
    points = mesh.GetPointsAttr().Get(first) or ()
    corners = mesh.GetFaceVertexIndicesAttr().Get(first) or Vt.IntArray()
    counts = mesh.GetFaceVertexCountsAttr().Get(first) or Vt.IntArray()
    sound, why = UsdGeom.Mesh.ValidateTopology(corners, counts, len(points))
    if not sound or not len(counts):
        raise MeshError(f"{prim.GetPath()} is no valid mesh: {why or 'no faces'}; export it again")
    triangles = np.maximum(np.array(counts) - 2, 0)
    first_corner = np.repeat(np.cumsum(counts) - counts, triangles)
    step = 1 + np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    fans = np.stack([first_corner, first_corner + step, first_corner + step + 1], axis=1)
    faces = np.array(corners)[fans]
    linear = matrix[:3, :3]
    mirrored = np.linalg.det(linear) < 0.0
    if mirrored != (mesh.GetOrientationAttr().Get(first) == UsdGeom.Tokens.leftHanded):
        faces = faces[:, ::-1]
    return Surface(np.array(points, dtype=float) @ linear + matrix[3, :3], faces)
