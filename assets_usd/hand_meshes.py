"""Triangle meshes of the solids a hand is drawn from, and samples of their common surface.

Every solid is convex, so a mesh is the hull of a few points and "inside" is a test against planes.
Lengths are in metres; meshes are in the frame of the link that carries the solid.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_schema import Box, Capsule, Cylinder, Pose, Solid, Sphere, Taper

SEGMENTS = 24
"""Corners of a drawn circle: 1 % of the radius off at most."""

HEMISPHERE_RINGS = 6
"""Rings of a drawn hemisphere, the equator included: as fine as the segments."""

TOUCHING = 1e-6
"""Depth [m] from which a point of one solid counts as hidden in another: above rounding, below any detail."""

_AXIS_ROTATION = {
    "X": Rotation.from_euler("y", 90, degrees=True),
    "Y": Rotation.from_euler("x", -90, degrees=True),
    "Z": Rotation.identity(),
}
"""Rotation that takes +z to each axis."""


@dataclass(frozen=True)
class Mesh:
    """A closed convex triangle mesh: vertices [V, 3] [m] and outward faces [T, 3]."""

    vertices: np.ndarray
    faces: np.ndarray

    @property
    def triangles(self) -> np.ndarray:
        """Corners of each triangle, [T, 3, 3] [m]."""
        return self.vertices[self.faces]

    @property
    def areas(self) -> np.ndarray:
        """Area of each triangle, [T] [m^2]."""
        return np.linalg.norm(self._normals(), axis=1) / 2

    def _normals(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        return np.cross(b - a, c - a)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of ``points`` [N, 3] lie deeper than :data:`TOUCHING` inside, [N] bool."""
        normals = self._normals()
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        depth = np.einsum("td,ntd->nt", normals, self.triangles[None, :, 0] - points[:, None])
        return np.asarray(depth.min(axis=1) > TOUCHING)


def solid_mesh(solid: Solid) -> Mesh:
    """The mesh of one solid in its link's frame.

    Raises:
        TypeError: The solid is of no known kind.
    """
    return _hull(place(_corners(solid), solid.pose))


def place(points: np.ndarray, pose: Pose) -> np.ndarray:
    """``points`` [N, 3] [m] moved by ``pose``."""
    return Rotation.from_quat(pose.quaternion).apply(points) + np.asarray(pose.position)


def surface_points(meshes: Sequence[Mesh], count: int, *, seed: int = 0) -> np.ndarray:
    """Points drawn uniformly by area from the surface of a union of convex meshes.

    Args:
        meshes: Parts of one link; what of a part is inside another is not surface.
        count: Number of points.
        seed: Seed of the draw: the same arguments give the same points.

    Returns:
        Points [count, 3] [m].
    """
    generator = np.random.default_rng(seed)
    triangles = np.concatenate([mesh.triangles for mesh in meshes])
    areas = np.concatenate([mesh.areas for mesh in meshes])
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    kept = np.empty((0, 3))
    while len(kept) < count:
        chosen = generator.choice(len(areas), size=2 * count, p=areas / areas.sum())
        u, v = generator.random((2, 2 * count, 1))
        fold = u + v > 1.0  # the other half of the parallelogram
        u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
        a, b, c = np.moveaxis(triangles[chosen], 1, 0)
        points = a + u * (b - a) + v * (c - a)
        hidden = np.zeros(len(points), dtype=bool)
        for index, mesh in enumerate(meshes):
            hidden |= (owner[chosen] != index) & mesh.contains(points)
        kept = np.concatenate([kept, points[~hidden]])
    return kept[:count]


def _hull(points: np.ndarray) -> Mesh:
    """The convex hull of ``points`` [N, 3], its faces turned outward."""
    hull = ConvexHull(points)
    order = np.sort(hull.vertices)  # in the order of the input, whatever the hull's own
    index = np.full(len(points), -1)
    index[order] = np.arange(len(order))
    vertices, faces = points[order], index[hull.simplices]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("td,td->t", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(vertices, faces)


def _corners(solid: Solid) -> np.ndarray:
    """Points whose hull is ``solid``, in its own frame, [N, 3] [m]."""
    match solid:
        case Box():
            return _box_corners(np.asarray(solid.size) / 2, solid.bevel)
        case Sphere():
            return np.concatenate([_dome(solid.radius, 0.0), -_dome(solid.radius, 0.0)])
        case Capsule():
            dome = _dome(solid.radius, solid.length / 2)
            return _AXIS_ROTATION[solid.axis].apply(np.concatenate([dome, dome * (1.0, 1.0, -1.0)]))
        case Cylinder():
            half, bevel = solid.length / 2, solid.bevel
            rings = (
                [(solid.radius - bevel, half), (solid.radius, half - bevel)]
                if bevel
                else [(solid.radius, half)]
            )
            points = [_ring(radius, sign * height) for radius, height in rings for sign in (1.0, -1.0)]
            return _AXIS_ROTATION[solid.axis].apply(np.concatenate(points))
        case Taper():
            hx, hy = (0.5 * side for side in solid.size)
            rectangle = np.array([(x, y, 0.0) for x in (-hx, hx) for y in (-hy, hy)])
            return np.concatenate([rectangle, _ring(solid.radius, solid.length)])
    raise TypeError(f"cannot draw a {type(solid).__name__}: use Box, Sphere, Capsule, Cylinder or Taper")


def _box_corners(half: np.ndarray, bevel: float) -> np.ndarray:
    """Corners of a box of half extents ``half`` [m]; a bevel makes three points of each corner."""
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    if bevel == 0.0:
        return signs * half
    return np.concatenate([signs * (half - bevel * (1.0 - np.eye(3)[axis])) for axis in range(3)])


def _ring(radius: float, height: float) -> np.ndarray:
    """A circle of :data:`SEGMENTS` points about z, [S, 3] [m]."""
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(SEGMENTS, height)], axis=1)


def _dome(radius: float, height: float) -> np.ndarray:
    """The hemisphere above ``height``: rings from the equator up, and the pole, [N, 3] [m]."""
    elevation = 0.5 * np.pi * np.arange(HEMISPHERE_RINGS) / HEMISPHERE_RINGS
    rings = [_ring(radius * np.cos(e), height + radius * np.sin(e)) for e in elevation]
    return np.concatenate([*rings, [(0.0, 0.0, height + radius)]])
