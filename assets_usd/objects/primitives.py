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


def _frame(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors: from a to b, and two across."""
    axis = (b - a) / np.linalg.norm(b - a)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    return axis, u, np.cross(axis, u)


def _ring(u: np.ndarray, v: np.ndarray, sides: int, phase: float = 0.0) -> np.ndarray:
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
    a = np.asarray(start, dtype=float)
    b = np.asarray(end, dtype=float)
    axis, u, v = _frame(a, b)
    return convex_hull(
        np.concatenate(
            [
                _rounded_end(a, -axis, u, v, radius),
                _rounded_end(b, axis, u, v, radius if end_radius is None else end_radius),
            ]
        )
    )


def _rounded_end(
    centre: np.ndarray, out: np.ndarray, u: np.ndarray, v: np.ndarray, radius: float
) -> np.ndarray:
    """A ring, a smaller one and the pole of a half ball that looks out, [15, 3]."""
    cap = (_ring(u, v, 6, 0.3) + out) / 2.0**0.5
    return centre + radius * np.concatenate([_ring(u, v, 8), cap, out[None]])


def cylinder(
    start: Vector, end: Vector, radius: float, end_radius: float | None = None, sides: int = SIDES
) -> Hull:
    """Cylinder or truncated cone between two points."""
    a = np.asarray(start, dtype=float)
    b = np.asarray(end, dtype=float)
    _, u, v = _frame(a, b)
    ring = _ring(u, v, sides)
    return convex_hull(
        np.concatenate(
            [a + radius * ring, b + (radius if end_radius is None else end_radius) * ring]
        )
    )


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
