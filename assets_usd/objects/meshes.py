"""Reading foreign meshes: load, refuse what is none, choose the scale."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb")

LONGEST_SIDE_M = (0.095, 0.165)
"""Range of an object's longest side: the objects of the paper."""

MEAN_WIDTH_M = 0.13
"""Most of the mean width, the side of the bounding box averaged over all its orientations (our choice).

What is wider starts wedged between the fingers and stays there: of seven such objects (14.5 cm and more)
a policy brought 22 % to their goals, of the others 92 % (docs/results/runs.md).
"""

THINNEST_M = 0.025
"""Least of the shortest side, as far as the other bounds let it be (our choice).

What is thinner lies flat on the table, where no finger gets under it: of eight such objects the same policy
brought 49 % to their goals (docs/results/runs.md).
"""

UNITS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
"""Units a mesh may be in; the first that needs the least rescaling is taken."""


class MeshError(ValueError):
    """A mesh is refused; the message is the reason."""


def check_file(path: Path) -> None:
    """Refuse what needs no parser to be refused.

    Raises:
        MeshError: Unsupported type, missing or empty file.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError(f"unsupported type {path.suffix or '(no suffix)'}; use {', '.join(MESH_SUFFIXES)}")
    if not path.is_file():
        raise MeshError("no such file")
    if path.stat().st_size == 0:
        raise MeshError("empty file")


def load_mesh(path: Path) -> Any:
    """Load a mesh file as one ``trimesh.Trimesh``, unprocessed.

    Raises:
        MeshError: Unsupported type, unreadable, empty, without faces, or with non-finite vertices.
    """
    import trimesh

    path = Path(path)
    check_file(path)
    try:
        # Textures and materials are not needed, and missing ones must not stop the import.
        loaded = trimesh.load(path, process=False, skip_materials=True)
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
    except Exception as error:  # parsers raise anything on a broken file
        raise MeshError(f"not a mesh: {type(error).__name__}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        points = len(getattr(mesh, "vertices", ()))
        raise MeshError(f"not a mesh: {points} points and no faces" if points else "empty: no faces")
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise MeshError(f"{bad} of {len(mesh.vertices)} vertices are NaN or infinite")
    return mesh


def mean_width(vertices: np.ndarray) -> float:
    """Mean distance of two parallel planes that enclose points, over all directions.

    It is the integral of the mean curvature of their convex hull over 2 pi: 2 r of a sphere, half of the
    sum of its sides for a box.

    Args:
        vertices: Points in any unit and frame, not all in a plane [V, 3].

    Returns:
        The mean width in the points' unit.
    """
    import trimesh

    return float(trimesh.convex.convex_hull(vertices).integral_mean_curvature / (2.0 * np.pi))


def scales_that_fit(sides: Sequence[float], width: float) -> tuple[float, float]:
    """Least and largest factor to metres by which a shape fits the hand.

    Its longest side is then in ``LONGEST_SIDE_M``, its mean width at most ``MEAN_WIDTH_M`` and its shortest
    side at least ``THINNEST_M``. A shape that fits at no size has a least factor above the largest.

    Args:
        sides: Sides of the bounding box in the shape's units, in any order, none of them 0 [3].
        width: :func:`mean_width` in the shape's units.
    """
    low, high = LONGEST_SIDE_M
    longest, shortest = float(max(sides)), float(min(sides))
    return max(low / longest, THINNEST_M / shortest), min(high / longest, MEAN_WIDTH_M / width)


def choose_scale(sides: Sequence[float], width: float) -> tuple[float, str]:
    """Factor from a mesh's units to metres, so that it fits the hand.

    The paper scales each mesh by hand, "to a proper size compared to the robot hand size", with its longest
    side in ``LONGEST_SIDE_M`` (supplementary text on objects). Here a mesh stays as it is where that holds,
    its mean width is at most ``MEAN_WIDTH_M`` and its shortest side at least ``THINNEST_M``; otherwise it is
    scaled as little as possible. The range of the longest side is kept first, thickness gives way first. The
    unit (m, mm, cm) is the one that needs the least rescaling.

    Args:
        sides: Sides of the bounding box in the mesh's units, in any order, none of them 0 [3].
        width: :func:`mean_width` in the mesh's units.

    Returns:
        The factor and a note, empty if the mesh is taken as it is.
    """
    least, most = scales_that_fit(sides, width)
    longest = float(max(sides))
    most = max(most, LONGEST_SIDE_M[0] / longest)
    least = min(least, most)

    def fitting(unit: float) -> float:
        return float(np.clip(unit, least, most))

    name, unit = min(UNITS_M.items(), key=lambda item: abs(np.log(fitting(item[1]) / item[1])))
    factor = fitting(unit)
    words = [] if name == "m" else [f"taken as {name}"]
    if factor != unit:
        words.append(f"scaled by {factor / unit:.3g} to {longest * factor:.3f} m")
    return factor, ", ".join(words)
