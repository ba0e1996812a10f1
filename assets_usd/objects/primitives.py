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
    points = [np.roll([0.0, i, j * GOLDEN], k) for i, j, k in product((-1, 1), (-1, 1), range(3))]
    points += [np.array(corner, dtype=float) for corner in product((-1, 1), repeat=3)]
    points += [
        np.roll([0.0, i * GOLDEN, j / GOLDEN], k) for i, j, k in product((-1, 1), (-1, 1), range(3))
    ]
    sphere = np.array(points)
    return sphere / np.linalg.norm(sphere, axis=1, keepdims=True)


_SPHERE = _unit_sphere()


def _placed(points: np.ndarray, centre: Vector, euler: Vector) -> Hull:
    rotation = Rotation.from_euler("xyz", np.asarray(euler, dtype=float))
    return convex_hull(rotation.apply(points) + np.asarray(centre, dtype=float))


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
    corners[corners[:, 2] > 0.0, :2] *= np.asarray(top, dtype=float)
    return _placed(corners * np.asarray(size, dtype=float), centre, euler)


def ellipsoid(centre: Vector, radii: Vector, *, euler: Vector = (0, 0, 0)) -> Hull:
    """Ellipsoid with 32 vertices on its surface."""
    return _placed(_SPHERE * np.asarray(radii, dtype=float), centre, euler)


def rod(start: Vector, end: Vector, radius: float, end_radius: float | None = None) -> Hull:
    """Capsule between two points, tapered if ``end_radius`` is given; 30 vertices."""
    a = np.asarray(start, dtype=float)
    b = np.asarray(end, dtype=float)
    axis, u, v = _frame(a, b)
    points = []
    for centre, out, r in (
        (a, -axis, radius),
        (b, axis, radius if end_radius is None else end_radius),
    ):
        ring = _ring(u, v, 8)
        cap = (_ring(u, v, 6, 0.3) + out) / 2.0**0.5
        points += [centre + r * ring, centre + r * cap, (centre + r * out)[None]]
    return convex_hull(np.concatenate(points))


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
    """Flat stroke between two points of the x-z plane, ``width`` wide in it and ``depth`` thick along y."""
    a = np.asarray(start, dtype=float)
    b = np.asarray(end, dtype=float)
    along = (b - a) / np.linalg.norm(b - a)
    across = np.array([-along[1], along[0]]) * width / 2.0
    a = a - along * width / 2.0
    b = b + along * width / 2.0
    return prism([a + across, a - across, b - across, b + across], -depth / 2.0, depth / 2.0)
