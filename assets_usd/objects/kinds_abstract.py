"""Letters and composites of random primitives.

Conventions as in :mod:`.procedural`.
"""

from itertools import pairwise

import numpy as np

from vd.assets_usd.objects.geometry import Hull, hull_planes
from vd.assets_usd.objects.primitives import beam, box, cylinder, ellipsoid, rod

STROKES: dict[str, list[tuple[float, float, float, float]]] = {
    "F": [(0, 0, 0, 2), (0, 2, 1.2, 2), (0, 1.1, 0.8, 1.1)],
    "G": [
        (1.2, 1.7, 0.5, 2),
        (0.5, 2, 0, 1.4),
        (0, 1.4, 0, 0.5),
        (0, 0.5, 0.5, 0),
        (0.5, 0, 1.2, 0.2),
        (1.2, 0.2, 1.2, 0.9),
        (1.2, 0.9, 0.7, 0.9),
    ],
    "J": [(1, 2, 1, 0.5), (1, 0.5, 0.6, 0), (0.6, 0, 0.2, 0), (0.2, 0, 0, 0.4), (0.5, 2, 1.4, 2)],
    "L": [(0, 0, 0, 2), (0, 0, 1.1, 0)],
    "P": [(0, 0, 0, 2), (0, 2, 0.8, 2), (0.8, 2, 1.1, 1.5), (1.1, 1.5, 0.8, 1), (0.8, 1, 0, 1)],
    "Q": [
        (0.3, 2, 1, 2),
        (1, 2, 1.3, 1),
        (1.3, 1, 1, 0),
        (1, 0, 0.3, 0),
        (0.3, 0, 0, 1),
        (0, 1, 0.3, 2),
        (0.8, 0.6, 1.5, -0.3),
    ],
    "R": [
        (0, 0, 0, 2),
        (0, 2, 0.8, 2),
        (0.8, 2, 1.1, 1.5),
        (1.1, 1.5, 0.8, 1),
        (0.8, 1, 0, 1),
        (0.5, 1, 1.2, 0),
    ],
    "a": [(0, 0, 0.6, 2), (0.6, 2, 1.3, 0), (0.25, 0.7, 1.1, 0.7), (1.3, 0, 1.7, 0)],
    "h": [(0, 0, 0, 2), (0, 1, 0.8, 1.1), (0.8, 1.1, 1, 0.8), (1, 0.8, 1, 0)],
    "k": [(0, 0, 0, 2), (0, 0.7, 0.9, 1.5), (0.3, 0.95, 1, 0)],
    "y": [(0, 2, 0.6, 1), (1.2, 2, 0.2, 0), (0.2, 0, -0.2, 0)],
    "2": [(0, 1.6, 0.4, 2), (0.4, 2, 0.9, 2), (0.9, 2, 1.2, 1.5), (1.2, 1.5, 0, 0), (0, 0, 1.3, 0)],
    "4": [(0.9, 0, 0.9, 2), (0.9, 2, 0, 0.7), (0, 0.7, 1.3, 0.7)],
    "5": [
        (1.1, 2, 0.1, 2),
        (0.1, 2, 0, 1.1),
        (0, 1.1, 0.8, 1.2),
        (0.8, 1.2, 1.1, 0.7),
        (1.1, 0.7, 0.8, 0),
        (0.8, 0, 0, 0.1),
    ],
    "7": [(0, 2, 1.2, 2), (1.2, 2, 0.5, 0), (0.5, 1.1, 1.2, 1.1)],
}
"""Strokes (x0, z0, x1, z1) of characters without a symmetry in their plane."""


def letter(rng: np.random.Generator) -> list[Hull]:
    """A character of straight strokes, slanted and stretched."""
    strokes = STROKES[str(rng.choice(sorted(STROKES)))]
    stretch, slant = rng.uniform(0.85, 1.25), rng.uniform(-0.2, 0.3)
    width, depth = rng.uniform(0.28, 0.42), rng.uniform(0.35, 0.8)

    def at(x: float, z: float) -> tuple[float, float]:
        return stretch * x + slant * z, z

    return [beam(at(x0, z0), at(x1, z1), width, depth) for x0, z0, x1, z1 in strokes]


def monogram(rng: np.random.Generator) -> list[Hull]:
    """An L or a hook of thick strokes with a rod or a ball on one face: no mirror plane left."""
    width, depth = rng.uniform(0.4, 0.55), rng.uniform(0.4, 0.7)
    arm = rng.uniform(0.8, 1.5)
    side = rng.choice([-1.0, 1.0])
    return [
        beam((0, 0), (0, rng.uniform(1.6, 2.2)), width, depth),
        beam((0, 0), (arm, rng.uniform(-0.2, 0.3)), width, depth),
        rod((0, 0, 1.2), (rng.uniform(-0.3, 0.3), side * rng.uniform(0.8, 1.2), 1.3), 0.3, 0.24),
        ellipsoid((arm, -side * 0.2, 0.1), (0.4, 0.5, 0.4)),
    ]


def _attach(rng: np.random.Generator, parts: list[Hull], scale: float) -> Hull:
    """A random primitive rooted inside a random part and sticking out of it."""
    host = parts[int(rng.integers(len(parts)))]
    normals, offsets = hull_planes(host)
    centre = host.vertices.mean(axis=0)
    plane = int(rng.integers(len(normals)))
    normal = normals[plane]
    surface = centre + (offsets[plane] - normal @ centre) * normal
    out = normal + rng.normal(0.0, 0.25, 3)
    out /= np.linalg.norm(out)
    length = scale * rng.uniform(0.6, 1.5)
    middle = surface + out * length * 0.35
    turn = rng.uniform(-np.pi, np.pi, 3)
    kind = int(rng.integers(4))
    thick = scale * rng.uniform(0.25, 0.5)
    if kind == 0:
        return rod(surface - 0.3 * length * out, surface + length * out, thick, thick * rng.uniform(0.5, 1.0))
    if kind == 1:
        return cylinder(
            surface - 0.3 * length * out,
            surface + 0.8 * length * out,
            thick,
            thick * rng.uniform(0.4, 1.3),
            sides=10,
        )
    if kind == 2:
        return box(middle, scale * rng.uniform(0.5, 1.3, 3), euler=turn)
    return ellipsoid(middle, scale * rng.uniform(0.35, 0.8, 3), euler=turn)


def cluster(rng: np.random.Generator) -> list[Hull]:
    """Random primitives grown on one another."""
    parts = [box((0, 0, 0), rng.uniform(0.8, 1.6, 3))]
    for _ in range(int(rng.integers(3, 7))):
        parts.append(_attach(rng, parts, 1.0))
    return parts


def branch(rng: np.random.Generator) -> list[Hull]:
    """A bent trunk of rods with side arms that end in blobs."""
    points = [np.zeros(3)]
    direction = np.array([0.0, 0.0, 1.0])
    for _ in range(3):
        direction = direction + rng.normal(0.0, 0.45, 3)
        direction /= np.linalg.norm(direction)
        points.append(points[-1] + direction * rng.uniform(0.6, 1.0))
    thick = rng.uniform(0.22, 0.34)
    parts = [rod(a, b, thick, 0.9 * thick) for a, b in pairwise(points)]
    for joint in points[1:3]:
        out = np.cross(direction, rng.normal(size=3))
        out /= np.linalg.norm(out)
        end = joint + out * rng.uniform(0.6, 1.2)
        parts += [rod(joint, end, 0.8 * thick, 0.6 * thick), ellipsoid(end, rng.uniform(0.25, 0.5, 3))]
    return parts
