"""What is inside of a mesh, its mass properties, and how far convex parts are from it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from vd.assets_usd.objects.geometry import (
    Hull,
    Solid,
    Surface,
    distances,
    inside,
    joined,
    solid_of_mesh,
    union_depth,
)
from vd.assets_usd.objects.repair import RepairedMesh

VOXELS = 96
"""Points of a grid along the longest side: about 1 % of volume error on thin shapes."""

GRID_TURN = Rotation.from_euler("xyz", [0.37, 0.61, 0.23])
"""Orientation of the grid: no plane a part is likely to have."""

SHEET = 0.01
"""Thickness of a surface without an inside, as a share of its longest side."""

SAMPLES = 2**16
"""Points by which parts and mesh are compared: of an object that fills 1 % of its box 650 are
inside, which gives an error of 15 % to within 2 %."""

MARGIN = 0.1
"""The points reach this share of the object's sides beyond it: parts of few vertices stick out by
less.
"""

OPEN_SHARE = 0.1
"""A mesh encloses something if its winding number is between ``OPEN_LEVELS`` in less than this
share of what it encloses. Scans with holes have 0.0 %, surfaces without an inside 100 % and
more.
"""

OPEN_LEVELS = 0.2, 0.8
"""Winding numbers that belong neither to an inside nor to an outside."""

Inside = Callable[[np.ndarray], np.ndarray]
"""Whether points [n, 3] are inside, bool [n]."""


@dataclass(frozen=True)
class Body:
    """An object as a solid.

    Attributes:
        inside: Inside of its outer surface.
        volume: Volume within its outer surface, m^3.
        solid: Mass properties at density 1, without its cavities.
        method: How they were computed.
        warnings: What may be wrong with them.
    """

    inside: Inside
    volume: float
    solid: Solid
    method: str
    warnings: tuple[str, ...] = ()


def body_of(mesh: RepairedMesh) -> Body:
    """The solid that a mesh bounds: exact if it is closed, by winding numbers if it has holes.

    A surface that has no inside is a sheet: the solid is what is near to it.
    """
    surface = mesh.surface
    within: Inside = partial(inside, surface)
    method = "winding numbers"
    warnings: tuple[str, ...] = ()
    if mesh.watertight:
        solid = solid_of_mesh(surface)
        method = "exact mesh volume"
    else:
        if not mesh.closed and _open_share(surface) > OPEN_SHARE:
            thickness = SHEET * float(np.ptp(surface.vertices, axis=0).max())
            within = partial(_near, surface, thickness / 2.0)
            method = "sheet"
            warnings = (
                f"open: the surface encloses nothing, and is taken as a sheet "
                f"{1e3 * thickness:.1f} mm thick, empty inside; close it, or give it thickness",
            )
        solid = solid_by_points(surface.vertices, within)
    volume = solid.volume
    if len(mesh.cavities.faces):
        solid = joined([solid, solid_of_mesh(mesh.cavities)])
    return Body(within, volume, solid, method, warnings)


def _near(surface: Surface, distance: float, points: np.ndarray) -> np.ndarray:
    return distances(surface, points) <= distance


def _open_share(surface: Surface) -> float:
    """Volume in which it is unclear what is inside, as a share of what is inside."""
    points, _ = _points_around(surface.vertices)
    low = inside(surface, points, OPEN_LEVELS[0])
    high = inside(surface, points, OPEN_LEVELS[1])
    return float((low & ~high).sum() / max(high.sum(), 1))


def solid_by_points(vertices: np.ndarray, within: Inside, points_along: int = VOXELS) -> Solid:
    """Mass properties of what is inside at density 1, from points on a grid.

    The grid is turned against the object: a plate along a grid plane could gain or lose a whole
    layer.

    Args:
        vertices: Vertices of its surface [V, 3].
        within: Whether points are inside.
        points_along: Points of the grid along the longest side.
    """
    turn = GRID_TURN.as_matrix()
    turned = vertices @ turn.T
    low = turned.min(axis=0)
    side = np.ptp(turned, axis=0)
    pitch = float(side.max()) / points_along
    shape = np.maximum(np.ceil(side / pitch).astype(int), 1)
    grid = low + (np.indices(shape).reshape(3, -1).T + 0.5) * pitch
    centres = grid[within(grid @ turn)]
    if not len(centres):
        return Solid(0.0, vertices.mean(axis=0), np.zeros((3, 3)))
    voxel = pitch**3
    centroid = centres.mean(axis=0)
    away = centres - centroid
    second = voxel * (away.T @ away + len(away) * pitch**2 / 12.0 * np.eye(3))
    inertia = np.trace(second) * np.eye(3) - second
    return Solid(voxel * len(centres), turn.T @ centroid, turn.T @ inertia @ turn)


def _points_around(vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """Points [SAMPLES, 3] that fill a box around vertices, and its volume.

    The box lies along their principal axes.
    """
    axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    along = vertices @ axes.T
    side = (1.0 + 2.0 * MARGIN) * np.ptp(along, axis=0)
    low = along.min(axis=0) - MARGIN * np.ptp(along, axis=0)
    return (low + side * qmc.Sobol(3, rng=0).random(SAMPLES)) @ axes, float(side.prod())


def error_of_parts(body: Body, vertices: np.ndarray) -> Callable[[Sequence[Hull]], float]:
    """A function: the volume in which convex parts and a body differ, as a share of the body's.

    What parts have too much and what they lack are counted apart, at their true volumes.

    Args:
        body: The body.
        vertices: Vertices of its surface [V, 3].
    """
    points, box = _points_around(vertices)
    within = body.inside(points)

    def error(hulls: Sequence[Hull]) -> float:
        covered = union_depth(hulls, points) <= 0.0
        return float((within != covered).mean() * box / body.volume)

    return error
