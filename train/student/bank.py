"""Shapes to learn from: points of meshes, and a bank of shapes that are made or deformed."""

from collections.abc import Sequence

import torch
import trimesh

from vd.assets_usd.objects.model import ObjectModel
from vd.train.student.shapes import made_shapes, mesh_shapes

SHAPES_AT_ONCE = 128
"""Shapes made at a time: their bodies' points take 0.5 GB."""


def mesh_points(objects: Sequence[ObjectModel], count: int, device: torch.device) -> torch.Tensor:
    """Points [m] and normals of objects' surfaces, even in area [O, count, 6]."""
    rows = []
    for item in objects:
        mesh = trimesh.Trimesh(item.vertices, item.faces, process=False)
        points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
        both = [torch.as_tensor(x, dtype=torch.float32) for x in (points, mesh.face_normals[faces])]
        rows.append(torch.cat(both, dim=1))
    return torch.stack(rows).to(device)


def centred(shapes: torch.Tensor) -> torch.Tensor:
    """Shapes [O, P, 6] about the means of their points."""
    mean = shapes[..., :3].mean(dim=1, keepdim=True)
    return torch.cat([shapes[..., :3] - mean, shapes[..., 3:]], dim=-1)


class ShapeBank:
    """Shapes in memory, half of them made, half of them meshes deformed.

    Some are replaced every so often.

    Args:
        meshes: Points and normals of objects [O, P', 6].
        count: K.
        points: P, points of each.
    """

    def __init__(self, meshes: torch.Tensor, count: int, points: int) -> None:
        self._meshes, self._oldest = meshes, 0
        self._shapes = torch.empty((count, points, 6), dtype=torch.half, device=meshes.device)
        self.renew(count)

    def renew(self, count: int) -> None:
        """Replace the oldest ``count`` shapes."""
        size, points = self._shapes.shape[:2]
        while count > 0:
            some = min(SHAPES_AT_ONCE, count)
            half = (some + 1) // 2
            made = made_shapes(half, points, self._meshes.device)
            shapes = torch.cat([made, mesh_shapes(self._meshes, some - half, points)])
            rows = (self._oldest + torch.arange(some, device=shapes.device)) % size
            self._shapes[rows] = shapes.half()
            self._oldest, count = (self._oldest + some) % size, count - some

    def draw(self, count: int) -> torch.Tensor:
        """Points [m] and normals of shapes drawn at random [count, P, 6]."""
        return self._shapes[torch.randint(len(self._shapes), (count,), device=self._shapes.device)]
