"""Shapes to learn from: points of meshes, and a bank of shapes that are made or deformed."""

from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from torch import Tensor

from vd.assets_usd.objects.model import ObjectModel
from vd.train.student.shapes import made_shapes, mesh_shapes

MESH_POINTS = 6000
"""Points kept of a mesh: of them each deformed copy draws its own."""
SHAPES_AT_ONCE = 128
"""Shapes made at a time: their bodies' points take 0.5 GB."""


def mesh_points(objects: Sequence[ObjectModel], count: int, device: torch.device) -> Tensor:
    """Points [m] and normals of objects' surfaces, even in area [O, count, 6]."""
    rows = []
    for item in objects:
        mesh = trimesh.Trimesh(item.vertices, item.faces, process=False)
        points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
        rows.append(np.concatenate([points, mesh.face_normals[faces]], axis=1))
    return torch.tensor(np.stack(rows), dtype=torch.float32, device=device)


def centred_points(objects: Sequence[ObjectModel], count: int, device: torch.device) -> Tensor:
    """As :func:`mesh_points`, about the means of the points."""
    shapes = mesh_points(objects, count, device)
    shapes[..., :3] -= shapes[..., :3].mean(dim=1, keepdim=True)
    return shapes


class ShapeBank:
    """Shapes in memory, half of them made, half of them meshes deformed.

    Some are replaced every so often.

    Args:
        objects: The meshes.
        count: K.
        points: P, points of each.
        sides: Shortest and longest longest side of a shape [m].
        device: Torch device.
    """

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        count: int,
        points: int,
        sides: tuple[float, float],
        device: torch.device,
    ) -> None:
        self._meshes = centred_points(objects, max(MESH_POINTS, points), device)
        self._sides = sides
        self._oldest = 0
        self.shapes = torch.empty((count, points, 6), dtype=torch.half, device=device)
        """Points [m] and normals [count, P, 6]."""
        self.renew(count)

    def renew(self, count: int) -> None:
        """Replace the oldest ``count`` shapes."""
        size, points = self.shapes.shape[:2]
        while count > 0:
            some = min(SHAPES_AT_ONCE, count)
            half = (some + 1) // 2
            made = made_shapes(half, points, self._sides, self._meshes.device)
            deformed = mesh_shapes(self._meshes, some - half, points, self._sides)
            shapes = torch.cat([made, deformed])
            rows = (self._oldest + torch.arange(some, device=shapes.device)) % size
            self.shapes[rows] = shapes.half()
            self._oldest = (self._oldest + some) % size
            count -= some

    def draw(self, count: int) -> Tensor:
        """Points [m] and normals of shapes drawn at random [count, P, 6]."""
        rows = torch.randint(len(self.shapes), (count,), device=self.shapes.device)
        return self.shapes[rows]
