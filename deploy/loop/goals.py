"""What to reach: an object's shape, from its USD or any scan, and orientations for it.

A scan is a mesh or a cloud of points, with noise, holes and what floats about it. A closed surface
is laid through it, by whose points policies find the object; it need not be closed before, as for a
simulation (vd-assets import).

Orientations are quaternions ``x,y,z,w`` or turns ``x,y,z@degrees`` about an axis, from how the
object is in its file, in the world frame.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.geometry import (
    Surface,
    convex_hull,
    random_surface_points,
    sides_along_axes,
    solid_of_mesh,
    surface_points,
)
from vd.assets_usd.objects.meshes import GUESSED_UNITS, LONGEST_SIDE_M, UNITS_M, MeshError
from vd.assets_usd.objects.model import (
    SURFACE_POINTS,
    ObjectError,
    ObjectModel,
    build_model,
    read_object,
)
from vd.assets_usd.objects.reading import load_points
from vd.assets_usd.objects.repair import repair_mesh
from vd.assets_usd.objects.scans import surface_of_scan
from vd.assets_usd.objects.sets import set_files
from vd.evaluate.rollout import draw_goals
from vd.evaluate.statistics import symmetric_error

SCAN_SUFFIXES = (".ply", ".obj", ".glb")
"""Files that are taken as scans."""
CANDIDATES = 20_000
"""Samples of a scan at most that are smoothed: 1 mm apart on an object of the paper's size."""
LEAST_POINTS = 200
"""Points of a scan below which its shape is a guess."""
NEIGHBOURS = 12
"""Samples by whose distance one is told that floats about by itself. With 24 and twice FAR samples
20 mm off the surface stay, and it bulges to them."""
FAR = 3.0
"""Distance to the neighbours, of the usual, from which a sample floats about by itself: there it is
nine times as lonely as others."""
THINNEST = 1e-3
"""Thickness below which points are of one side only, as a share of the longest side."""
LARGER = 1.5
"""How much larger or smaller than the objects of the paper an object may be."""


DRAWS = 16
"""Draws of each goal, of which the farthest from the one before is taken."""


class GoalError(ValueError):
    """A shape or an orientation that cannot be used; names it and the remedy."""


def one_object(name: str) -> ObjectModel:
    """The object of a name: that of a set, a USD, or a scan.

    Raises:
        GoalError: Several are, or the scan is of no use.
        ObjectError: There is none.
    """
    if Path(name).suffix.lower() in SCAN_SUFFIXES:
        return scan_object(Path(name))
    files = set_files([name])
    if len(files) > 1:
        raise GoalError(
            f"--object {name} holds {len(files)} objects; name the file of one: {files[0]}"
        )
    return read_object(files[0])


def scan_object(path: Path) -> ObjectModel:
    """An object from a scan, for its surface; its collision shape is its convex hull.

    Args:
        path: PLY, OBJ or GLB; a mesh or points, in the unit in which it is as large as objects are.

    Raises:
        GoalError: The file is of no use; names it, what is wrong, and the remedy.
    """
    path = Path(path)
    try:
        surface = _surface(path, np.random.default_rng(0))
    except MeshError as error:
        raise GoalError(f"{path}: {error}; scan it again, or export it as PLY") from error
    factor = _unit(path, float(np.ptp(surface.vertices, axis=0).max()))
    surface = surface.times(factor)
    try:
        return build_model(
            "scan",
            surface,
            [convex_hull(surface.vertices)],
            solid_of_mesh(surface),
            surface_points(surface, SURFACE_POINTS),
            source=str(path),
            family="scan",
            scale=factor,
        )
    except ObjectError as error:
        raise GoalError(f"{path}: {error}; scan it from more sides") from error


def make_goals(texts: Sequence[str]) -> list[np.ndarray]:
    """Goals as they were typed, ``x,y,z,w`` or ``x,y,z@degrees``, in their order.

    Returns:
        Unit quaternions xyzw, the same whichever of its two signs was typed.

    Raises:
        GoalError: One is none.
    """
    return list(map(_goal, texts))


def drawn_goals(symmetry: np.ndarray, count: int, *, seed: int = 0) -> list[np.ndarray]:
    """Goals in a row that show something: of several draws the farthest from the one before.

    Args:
        symmetry: Rotations that map the object to itself, up to which two goals are apart [K, 4].
        count: How many.
        seed: Of the draws.

    Returns:
        Quaternions xyzw.
    """
    rng = np.random.default_rng(seed)
    goals = [np.array([0.0, 0.0, 0.0, 1.0])]
    for _ in range(count):
        before = np.tile(goals[-1], (DRAWS, 1))
        draws = draw_goals(before, rng, np.pi)
        goals.append(draws[symmetric_error(before, draws, symmetry).argmax()])
    return goals[1:]


def _goal(text: str) -> np.ndarray:
    turn, _, degrees = text.partition("@")
    try:
        numbers = np.array(list(map(float, turn.split(","))))
        angle = np.radians(float(degrees)) if "@" in text else 0.0
    except ValueError:
        numbers = np.zeros(0)
        angle = 0.0
    wanted = 4 if "@" not in text else 3
    length = float(np.linalg.norm(numbers))
    if len(numbers) != wanted or not (np.isfinite(length + angle) and length > 0.0):
        raise GoalError(
            f"--goal {text}: give a quaternion x,y,z,w or a turn x,y,z@degrees, such as 0,0,1@90"
        )
    if wanted == 4:
        return np.asarray(Rotation.from_quat(numbers).as_quat(canonical=True))
    return np.asarray(Rotation.from_rotvec(angle * numbers / length).as_quat(canonical=True))


def _surface(path: Path, generator: np.random.Generator) -> Surface:
    """Closed surface of a scan, in its own unit.

    A closed mesh as it is, else one through its samples.
    """
    loaded = load_points(path)
    vertices = np.asarray(loaded.vertices)
    if not len(vertices):
        raise MeshError("no points")
    if len(loaded.faces):
        mesh = repair_mesh(loaded)
        if mesh.watertight:
            return mesh.surface
        points = random_surface_points(mesh.surface, CANDIDATES, generator)
    else:
        points = vertices[generator.permutation(len(vertices))[:CANDIDATES]]
    if len(points) < LEAST_POINTS:
        raise MeshError(f"{len(points)} points; {LEAST_POINTS} at least make a shape")
    away = cKDTree(points).query(points, NEIGHBOURS)[0][:, -1]
    points = points[away < FAR * np.median(away)]
    if sides_along_axes(points).min() < THINNEST * np.ptp(points, axis=0).max():
        raise MeshError("flat: the scan shows one side only")
    try:
        return surface_of_scan(points)
    except ValueError as error:
        raise MeshError(str(error)) from error


def _unit(path: Path, longest: float) -> float:
    """Factor from the scan's unit to metres."""
    low = LONGEST_SIDE_M[0] / LARGER
    high = LONGEST_SIDE_M[1] * LARGER
    fitting = [UNITS_M[name] for name in GUESSED_UNITS if low <= longest * UNITS_M[name] <= high]
    if not fitting:
        raise GoalError(
            f"{path}: its longest side is {longest:.4g} units, which in "
            f"{' or '.join(GUESSED_UNITS)} is not within {100 * low:.0f} to {100 * high:.0f} cm; "
            "cut away what is not the object, or scale the file to metres"
        )
    return fitting[0]
