"""Procedural object sets: our own shapes, deterministic from a seed, with exact convex parts."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from trimesh.util import append_faces

from vd.assets_usd.objects import primitives
from vd.assets_usd.objects.bodies import solid_by_points
from vd.assets_usd.objects.geometry import (
    Hull,
    Surface,
    hull_depth,
    inside,
    solid_of_mesh,
    surface_points,
    union_depth,
)
from vd.assets_usd.objects.kinds import KINDS, Kind
from vd.assets_usd.objects.meshes import LONGEST_SIDE_M, mean_width, scales_that_fit
from vd.assets_usd.objects.model import SURFACE_POINTS, ObjectModel, build_model
from vd.assets_usd.objects.primitives import Draw, box

PROCEDURAL_VERSION = 5
"""Part of every content hash: raise it when a kind draws something else."""

SHAPE_ENTROPY = 1
"""First word of every object's seed; apart from the version, so that a fix keeps the shapes."""

LICENCE = "Apache-2.0"

CUBE_SIDE_M = 0.07
"""Side of the cube, the usual in-hand cube. Below ``LONGEST_SIDE_M``, which holds for the complex
objects: a cube of 95 mm would not pass between the fingers."""

CUBOID_SIDES_M = (0.05, 0.07, 0.10)
"""Sides of the cuboid, all different: its group is the four rotations of a brick."""

THINNEST_M = 0.015
"""Least shortest side of an object that would be longer than ``LONGEST_SIDE_M`` where it is as
thick as other objects. What is flatter is out of reach where it lies: straight fingers of dclaw4
end 9 mm above the table under their roots, 17 mm above it in the middle.
"""

MIN_ASYMMETRY = 0.012
"""Least asymmetry (see :func:`asymmetry`) of a training object: 1.5 mm of mean surface distance at
12 cm.
"""

STRETCH = 0.35
SHEAR = 0.25
"""Spread of the random stretch of each axis (log scale) and of the shear of x by z: one kind then
gives short and long, fat and lean objects."""

CANDIDATE_FOLDS = ((1, 2), (1, 3), (1, 4), (1, 5), (2, 5), (1, 6))
"""Rotations tried about each principal axis, in turns: one of two, one of three, ..."""

PROBES = 200
"""Surface points that measure a symmetry."""

GRID = 48
"""Points along the longest side that measure an object's inertia, to 2 % or better."""

ATTEMPTS = 50
"""Draws before a kind is reported as unable to give a valid object."""


def asymmetry(model: ObjectModel) -> float:
    """How far an object whose hulls are its shape is from any rotational symmetry.

    A rotation that maps a solid to itself keeps its inertia, so it turns about a principal axis:
    tried are the folds of ``CANDIDATE_FOLDS`` about each.

    Returns:
        Least mean distance of the rotated surface points to the surface, divided by the longest
        side: 0 for a symmetric solid.
    """
    # Farthest-point samples: any leading part of them is itself evenly spread.
    points = model.surface_points[:PROBES]
    least = np.inf
    for axis in Rotation.from_quat(model.inertia_quat).as_matrix().T:
        for turns, fold in CANDIDATE_FOLDS:
            turn = Rotation.from_rotvec(2.0 * np.pi * turns / fold * axis)
            off = np.abs(union_depth(model.hulls, turn.apply(points))).mean()
            least = min(least, float(off))
    return least / model.longest_side


def union_surface(hulls: Sequence[Hull]) -> Surface:
    """Triangles of all parts, without those wholly inside another part."""
    vertices = []
    faces = []
    for i, hull in enumerate(hulls):
        inside = np.zeros(len(hull.faces), dtype=bool)
        for j, other in enumerate(hulls):
            if j != i:
                inside |= (hull_depth(other, hull.vertices) < 0.0)[hull.faces].all(axis=1)
        used, index = np.unique(hull.faces[~inside], return_inverse=True)
        vertices.append(hull.vertices[used])
        faces.append(index.reshape(-1, 3))
    corners, triangles = append_faces(vertices, faces)
    return Surface(corners, triangles.astype(np.int32))


def model_of_parts(
    name: str, hulls: Sequence[Hull], longest_side: float | None = None, **fields: Any
) -> ObjectModel:
    """A model whose collision parts are its shape: scale, mass properties and surface points.

    Args:
        name: Object name.
        hulls: Convex parts.
        longest_side: Longest side of the bounding box to scale to, m; as it is if None.
        **fields: Further fields of :class:`ObjectModel`.
    """
    everything = np.concatenate([h.vertices for h in hulls])
    scale = 1.0 if longest_side is None else longest_side / float(np.ptp(everything, axis=0).max())
    parts = [hull.times(scale) for hull in hulls]
    surface = union_surface(parts)
    points = surface_points(surface, SURFACE_POINTS, outside=parts)
    whole = Surface(*append_faces(*zip(*parts, strict=True)))
    solid = solid_of_mesh(whole)
    if len(parts) > 1:
        solid = solid_by_points(whole.vertices, partial(inside, whole), GRID)
    return build_model(
        name,
        surface,
        parts,
        solid,
        points,
        licence=LICENCE,
        volume_error=0.0,
        volume_method="the parts are the shape",
        **fields,
    )


def draw_object(name: str, make: Kind, seed: Sequence[int], **fields: Any) -> ObjectModel:
    """One object of a kind: the first draw that fits the hand and has no rotational symmetry.

    Its longest side is uniform in ``LONGEST_SIDE_M``, as far as the object fits the hand at that
    size (:func:`.meshes.scales_that_fit`). What fits at none is drawn again.

    Args:
        name: Object name.
        make: Kind.
        seed: Entropy; equal entropy gives an equal object.
        **fields: Further fields of :class:`ObjectModel`.

    Raises:
        RuntimeError: No valid draw (a mistake in the kind).
    """
    u = Draw(np.random.PCG64(seed))
    for _ in range(ATTEMPTS):
        parts = list(make(u))
        # One random stretch and shear keeps parts convex and y a mirror axis.
        matrix = np.diag(np.exp(u(-STRETCH, STRETCH, 3)))
        matrix[0, 2] = u(-SHEAR, SHEAR)
        hulls = [Hull(part.vertices @ matrix.T, part.faces) for part in parts]
        longest = float(u(*LONGEST_SIDE_M))
        vertices = np.concatenate([hull.vertices for hull in hulls])
        sides = np.ptp(vertices, axis=0)
        smallest, largest = np.multiply(scales_that_fit(sides, mean_width(vertices)), sides.max())
        too_wide = largest < LONGEST_SIDE_M[0]
        too_thin = largest * sides.min() / sides.max() < THINNEST_M
        if too_wide or too_thin:
            continue
        longest = float(min(max(longest, smallest), largest))
        model = model_of_parts(name, hulls, longest, **fields)
        if asymmetry(model) >= MIN_ASYMMETRY:
            return model
    raise RuntimeError(f"{name}: no valid object in {ATTEMPTS} draws")


def procedural_set(count: int, seed: int, *, families: str = "training") -> list[ObjectModel]:
    """Objects of every kind in turn, deterministic from the seed.

    Args:
        count: Number of objects.
        seed: Seed of the set. Object i depends on the families, the seed and i alone.
        families: ``training``, ``tools`` or ``heldout`` (``KINDS``).
    """
    kinds = KINDS[families]
    word = list(KINDS).index(families)
    models = []
    for i in range(count):
        make = kinds[i % len(kinds)]
        kind = make.__name__
        name = f"{kind}_s{seed}_{i:03d}"
        model = draw_object(
            name,
            make,
            (SHAPE_ENTROPY, word, seed, i),
            family=kind,
            split="test" if families == "heldout" else "train",
            source=f"procedural {kind}, seed {seed}, index {i}",
            content_hash=f"procedural-{PROCEDURAL_VERSION}-{word}-{seed}-{i}",
        )
        models.append(model)
    return models


def _symmetric(name: str, part: Hull, group: str, version: str) -> ObjectModel:
    """A convex part [m] with its rotation group, the identity first."""
    turns = Rotation.create_group(group)
    return model_of_parts(
        name,
        [part],
        family="symmetric",
        source=f"procedural {name}",
        symmetry=turns[np.argsort(turns.magnitude(), kind="stable")].as_quat(canonical=True),
        content_hash=f"{name}-{PROCEDURAL_VERSION}-{version}",
    )


def cube() -> ObjectModel:
    """The cube, with its group of 24 rotations."""
    return _symmetric("cube", box((0, 0, 0), [CUBE_SIDE_M] * 3), "O", f"{CUBE_SIDE_M}")


def cuboid() -> ObjectModel:
    """The cuboid, with its group of four rotations."""
    return _symmetric("cuboid", box((0, 0, 0), CUBOID_SIDES_M), "D2", f"{list(CUBOID_SIDES_M)}")


def cylinder() -> ObjectModel:
    """The cylinder, as wide and as long as the cube, of as many sides as has its group."""
    half = CUBE_SIDE_M / 2
    part = primitives.cylinder((0, 0, -half), (0, 0, half), half)
    return _symmetric("cylinder", part, f"D{primitives.SIDES}", f"{CUBE_SIDE_M}")
