"""Convex primitives of the procedural objects; each is a hull of at most 32 vertices.

Units are arbitrary: a finished object is scaled as a whole.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.geometry import Hull, convex_hull

Vector = Sequence[float] | np.ndarray

GOLDEN = (1.0 + 5.0**0.5) / 2.0

SIDES = 12
"""Sides of a cylinder: 24 vertices."""


class Draw(np.random.Generator):
    """A random generator whose call draws a uniform number: ``u(0.2, 0.4)``."""

    __call__ = np.random.Generator.uniform


def vec(*components: float) -> np.ndarray:
    """The components as an array."""
    return np.array(components, dtype=np.float64)


def _unit_sphere() -> np.ndarray:
    """The 12 vertices of an icosahedron and the 20 of its dual, on the unit sphere, [32, 3]."""
    points = []
    for i, j, k in product((-1, 1), (-1, 1), range(3)):
        points.append(np.roll([0.0, i, j * GOLDEN], k))
    points += map(np.array, product((-1.0, 1.0), repeat=3))
    for i, j, k in product((-1, 1), (-1, 1), range(3)):
        points.append(np.roll([0.0, i * GOLDEN, j / GOLDEN], k))
    sphere = np.array(points)
    return sphere / np.linalg.norm(sphere, axis=1, keepdims=True)


_SPHERE = _unit_sphere()


def _placed(points: np.ndarray, centre: Vector, euler: Vector) -> Hull:
    return convex_hull(Rotation.from_euler("xyz", euler).apply(points) + centre)


def _frame(start: Vector, end: Vector) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two points as they are [2, 3], a unit vector from one to the other, and two across [2, 3]."""
    ends = np.array([start, end], dtype=float)
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    return ends, axis, np.stack([u, np.cross(axis, u)])


def _ring(across: np.ndarray, sides: int, phase: float = 0.0) -> np.ndarray:
    """Points on a unit circle in the plane of two vectors [sides, 3]."""
    u, v = across
    angle = 2.0 * np.pi * np.arange(sides) / sides + phase
    return np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v


def box(
    centre: Vector, size: Vector, *, euler: Vector = (0, 0, 0), top: tuple[float, float] = (1, 1)
) -> Hull:
    """Box of full side lengths ``size``; its upper face (z) is scaled by ``top``."""
    corners = np.array(list(product((-0.5, 0.5), repeat=3)))
    corners[corners[:, 2] > 0.0, :2] *= top
    return _placed(corners * size, centre, euler)


def ellipsoid(centre: Vector, radii: Vector, *, euler: Vector = (0, 0, 0)) -> Hull:
    """Ellipsoid with 32 vertices on its surface."""
    return _placed(_SPHERE * radii, centre, euler)


def rod(start: Vector, end: Vector, radius: float, end_radius: float | None = None) -> Hull:
    """Capsule between two points, tapered if ``end_radius`` is given; 30 vertices."""
    ends, axis, across = _frame(start, end)
    radii = [radius, radius if end_radius is None else end_radius]
    points = []
    for centre, out, size in zip(ends, (-axis, axis), radii, strict=True):
        # A ring, a smaller one and the pole of a half ball that looks out.
        cap = (_ring(across, 6, 0.3) + out) / 2.0**0.5
        points.append(centre + size * np.concatenate([_ring(across, 8), cap, out[None]]))
    return convex_hull(np.concatenate(points))


def cylinder(
    start: Vector, end: Vector, radius: float, end_radius: float | None = None, sides: int = SIDES
) -> Hull:
    """Cylinder or truncated cone between two points."""
    ends, _, across = _frame(start, end)
    ring = _ring(across, sides)
    last = radius if end_radius is None else end_radius
    return convex_hull(np.concatenate([ends[0] + radius * ring, ends[1] + last * ring]))


def prism(outline: npt.ArrayLike, low: float, high: float, *, axis: str = "y") -> Hull:
    """Convex outline [n, 2] extruded from ``low`` to ``high`` along an axis.

    The outline lies in the plane of the two other axes in their alphabetical order (x-z for ``y``).
    """
    flat = np.asarray(outline, dtype=float)
    index = "xyz".index(axis)
    return convex_hull(np.concatenate([np.insert(flat, index, h, axis=1) for h in (low, high)]))


def beam(start: npt.ArrayLike, end: npt.ArrayLike, width: float, depth: float) -> Hull:
    """Flat stroke between two points of the x-z plane, ``width`` wide, ``depth`` thick along y."""
    a = np.asarray(start, dtype=float)
    b = np.asarray(end, dtype=float)
    along = (b - a) / np.linalg.norm(b - a)
    across = np.array([-along[1], along[0]]) * width / 2.0
    a = a - along * width / 2.0
    b = b + along * width / 2.0
    return prism([a + across, a - across, b - across, b + across], -depth / 2.0, depth / 2.0)
