"""The drawn surface of a hand, read from its USD: what a depth camera sees."""

import numpy as np
from pxr import Usd, UsdGeom
from trimesh.util import append_faces

from vd.assets_usd.hand_data import HandError, HandModel
from vd.assets_usd.hand_model import open_stage
from vd.assets_usd.objects.geometry import Surface


def read_surfaces(hand: HandModel) -> dict[int, Surface]:
    """What is drawn of each link, by its index; in its frame [m], float32 and int32.

    Raises:
        HandError: A mesh is not of triangles, or nothing is drawn at all.
    """
    stage = open_stage(hand.path, hand.fingertip, hand.layer)
    cache = UsdGeom.XformCache()
    root = stage.GetDefaultPrim().GetPath()
    found: dict[int, Surface] = {}
    for link, name in enumerate(hand.link_names):
        body, parts = stage.GetPrimAtPath(root.AppendChild(name)), []
        for prim in Usd.PrimRange(body):
            if not prim.IsA(UsdGeom.Mesh) or UsdGeom.Imageable(prim).ComputePurpose() == "guide":
                continue
            mesh = UsdGeom.Mesh(prim)
            if set(mesh.GetFaceVertexCountsAttr().Get() or ()) != {3}:
                raise HandError(
                    f"{hand.path}: {prim.GetPath()}: 'faceVertexCounts' are not all 3; triangulate "
                    f"the mesh"
                )
            # USD transforms row vectors.
            matrix = np.array(cache.ComputeRelativeTransform(prim, body)[0])
            vertices = np.array(mesh.GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]
            parts.append((vertices, np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)))
        if parts:
            vertices, faces = append_faces(*zip(*parts, strict=True))
            found[link] = Surface(vertices.astype(np.float32), faces.astype(np.int32))
    if not found:
        raise HandError(f"{hand.path}: no link has a mesh to draw; give the links meshes")
    return found
