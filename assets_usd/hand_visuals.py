"""The drawn surface of a hand, read from its USD: what a depth camera sees.

Metres; each surface is in the frame of its link.
"""

import re
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from vd.assets_usd.hand_data import HandError, HandModel
from vd.assets_usd.hand_model import open_stage

MOTOR_NAME = re.compile(r"(f\d+_motor)_")
"""Names of the drawings of a finger's first motor, which is fixed to the base."""


@dataclass(frozen=True, eq=False)
class LinkSurface:
    """Triangles of a link, or of a part of it that lies apart from the rest.

    Attributes:
        name: Link, or the part (``f0_motor``), as in ``HandModel.point_names``.
        link: Index of the link.
        vertices: [V, 3] float32 [m], in the frame of the link.
        faces: [T, 3] int32, outward.
    """

    name: str
    link: int
    vertices: np.ndarray
    faces: np.ndarray


def read_surfaces(hand: HandModel) -> tuple[LinkSurface, ...]:
    """The drawn surface of every link: the palm, the fingers' first motors and their links.

    The motors come apart from the palm, so that each has bounds of its own.

    Raises:
        HandError: A mesh is not of triangles, or nothing is drawn at all.
    """
    stage = open_stage(hand.path, hand.fingertip, hand.layer)
    cache = UsdGeom.XformCache()
    root = stage.GetDefaultPrim().GetPath()
    parts: dict[tuple[int, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for link, name in enumerate(hand.link_names):
        body = stage.GetPrimAtPath(root.AppendChild(name))
        for prim in Usd.PrimRange(body):
            if not prim.IsA(UsdGeom.Mesh) or UsdGeom.Imageable(prim).ComputePurpose() == "guide":
                continue
            mesh = UsdGeom.Mesh(prim)
            if set(mesh.GetFaceVertexCountsAttr().Get() or ()) != {3}:
                raise HandError(
                    f"{hand.path}: {prim.GetPath()}: 'faceVertexCounts' are not all 3; triangulate the mesh"
                )
            # USD transforms row vectors.
            matrix = np.array(cache.ComputeRelativeTransform(prim, body)[0])
            vertices = np.array(mesh.GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]
            faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
            motor = MOTOR_NAME.match(prim.GetName())
            parts.setdefault((link, motor[1] if motor else name), []).append((vertices, faces))
    if not parts:
        raise HandError(f"{hand.path}: no link has a mesh to draw; give the links meshes")
    return tuple(_joined(name, link, meshes) for (link, name), meshes in parts.items())


def _joined(name: str, link: int, meshes: list[tuple[np.ndarray, np.ndarray]]) -> LinkSurface:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    joined = np.concatenate([faces + start for (_, faces), start in zip(meshes, starts, strict=True)])
    return LinkSurface(
        name=name,
        link=link,
        vertices=np.concatenate([vertices for vertices, _ in meshes]).astype(np.float32),
        faces=joined.astype(np.int32),
    )
