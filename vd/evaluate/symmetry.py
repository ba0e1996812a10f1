"""The rotations that map a shape onto itself, as far as a depth camera could tell.

Many rotations are turned until the shape's own samples lie on it. The whole surface decides, and
that they form a group. A shape's own file may declare them, as those of our solids do. Object
frame; quaternions xyzw.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.geometry import Surface, random_surface_points
from vd.assets_usd.objects.model import ObjectModel
from vd.geometry.quaternions import product
from vd.kernels.launch import launch
from vd.kernels.sensor.shape_grids import (
    off_mesh_kernel,
    shape_distance_kernel,
    turn_onto_itself_kernel,
)

OFF_M = 0.003
"""A turned shape looks the same where it is no farther than this from where its surface was [m]: a
depth camera's points are off by 2 to 3 mm. Of 159 imported training meshes 72 have a symmetry then,
with half of the distance 28, with twice 83.
"""
OFF_SHARE = 0.01
"""Share of the surface that may be farther: a hundredth is the edge of a lid."""
DENSE = 2000
"""Points of the surface that this is measured on: the share is then known to 0.4 % (two standard
errors).
"""
STICKS_OUT = 0.05
"""Nothing thin that is off by more than this share of the shape's length may be left over."""
ROTATIONS = 2048
"""Rotations that are tried, about 0.25 rad apart."""
STEPS = 12
"""Steps of each at most."""
POINTS = 256
"""Samples of which every so many-th is to lie on the shape."""
EVERY = 2
"""Which these are."""
FAR_M = 0.012
"""Length at which their distances are cut off [m]."""
GRID = 32
"""Grid points along a side of a shape's distances: some 5 mm apart."""
BEYOND_M = 0.02
"""How far that grid reaches beyond the shape [m]."""
APART_RAD = 0.12
"""Least angle between two symmetries: a solid of revolution has some fifty."""
BESIDE_RAD = 0.4
"""Rotations nearer to each other than this are neighbours; those tried are some 0.25 rad apart."""
AROUND_RAD = 2.0
"""Rotations that neighbour the identity, one after the other, as far as this go around."""
CLOSED_RAD = 0.2
"""A product of two symmetries is one that was found if it is no farther than this from it."""
MOST = 128
"""Symmetries of a shape at most: a ball has more."""


_found: dict[bytes, np.ndarray] = {}
"""Symmetries of the shapes that were asked for before: looking for those of one takes a processor
0.3 s.
"""


def symmetries(objects: Sequence[ObjectModel], device: str) -> list[np.ndarray]:
    """Symmetries of shapes, the identity first: quaternions [S, 4] for each."""
    keys = list(map(_key, objects))
    unknown = {}
    for key, item in zip(keys, objects, strict=True):
        if len(item.symmetry) > 1:
            _found[key] = np.asarray(item.symmetry, dtype=np.float32)
        elif key not in _found:
            unknown[key] = item
    if unknown:
        _found.update(zip(unknown, _search(list(unknown.values()), device), strict=True))
    return [_found[key] for key in keys]


def with_symmetries(objects: Sequence[ObjectModel], device: str) -> list[ObjectModel]:
    """Objects that declare their symmetries."""
    found = symmetries(objects, device)
    return [replace(item, symmetry=turns) for item, turns in zip(objects, found, strict=True)]


def _key(item: ObjectModel) -> bytes:
    """What tells one shape from another."""
    parts = (item.vertices, item.faces, item.surface_points)
    return hashlib.sha1(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).digest()


def _even_rotations() -> np.ndarray:
    """Rotations that lie evenly [ROTATIONS, 4] (super-Fibonacci spiral, Alexa 2022)."""
    # Its two constants: the root of 2, and the positive root of x^4 = x + 4.
    first = np.sqrt(2.0)
    second = 1.533751168755204288118041
    along = np.arange(ROTATIONS) + 0.5
    share = along / ROTATIONS
    turn = 2.0 * np.pi * along
    inner = np.sqrt(share)
    outer = np.sqrt(1.0 - share)
    parts = [
        inner * np.sin(turn / first),
        inner * np.cos(turn / first),
        outer * np.sin(turn / second),
        outer * np.cos(turn / second),
    ]
    return np.stack(parts, axis=1)


def _search(items: Sequence[ObjectModel], device: str) -> list[np.ndarray]:
    """Symmetries of shapes: rotations by which samples lie on them, measured on the whole surface."""
    surfaces = [_Surface(item, device) for item in items]
    turned, misfits = _turned(items, surfaces, device)
    found = []
    for surface, turns, misfit in zip(surfaces, turned, misfits, strict=True):
        # Where no more than a hundredth is off by more, the mean square is less, but for a few
        # outliers.
        likely = _apart(turns[misfit.argsort()[: int((misfit < OFF_M**2).sum())]])
        off = surface.share_off(likely)
        same = likely[np.argsort(off, kind="stable")][: int((off <= OFF_SHARE).sum())]
        found.append(_closed(_distinct(same), surface))
    return found


def _turned(
    items: Sequence[ObjectModel], surfaces: "Sequence[_Surface]", device: str
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [O, R, 4], each turned until samples lie on the shape, and misfits [m^2] [O, R]."""

    def array(values: Any, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    # In an order in which any leading part of them is evenly spread.
    samples = np.stack([item.surface_points for item in items])
    points = array(samples[:, :POINTS:EVERY], wp.vec3)
    mean = array(samples[:, ::EVERY].mean(axis=1), wp.vec3)
    place = array(samples[:, :POINTS].mean(axis=1), wp.vec3)
    half = array(np.abs(samples).max(axis=(1, 2)) + BEYOND_M, float)
    mesh = array([surface.mesh.id for surface in surfaces], wp.uint64)
    distances = wp.empty((len(items), GRID, GRID, GRID), dtype=float, device=device)
    launch(shape_distance_kernel, distances.shape, [mesh, half], [distances])
    begun = array(_even_rotations(), wp.quat)
    turns = wp.empty((len(items), ROTATIONS), dtype=wp.quat, device=device)
    misfits = wp.empty(turns.shape, dtype=float, device=device)
    inputs = [distances, half, points, FAR_M, STEPS, mean, place, begun]
    launch(turn_onto_itself_kernel, turns.shape, inputs, [turns, misfits])
    return turns.numpy(), misfits.numpy()


class _Surface:
    """The surface of a shape, and how much of it a turn takes off itself."""

    def __init__(self, item: ObjectModel, device: str):
        self._device = device
        rng = np.random.default_rng(0)
        self.mesh = wp.Mesh(
            wp.array(item.vertices, dtype=wp.vec3, device=device),
            wp.array(item.faces.ravel(), dtype=wp.int32, device=device),
            support_winding_number=True,
        )
        samples = random_surface_points(Surface(item.vertices, item.faces), DENSE, rng)
        self._points = np.concatenate([samples, item.vertices])
        self._most_m = STICKS_OUT * item.longest_side

    def share_off(self, turns: np.ndarray) -> np.ndarray:
        """Share of the surface that is more than OFF_M from it when turned by turns [R, 4], [R].

        All of it where something sticks out, however thin.
        """
        if not len(turns):
            return np.zeros(0)
        turned = np.einsum("rij,pj->rpi", Rotation.from_quat(turns).as_matrix(), self._points)
        points = wp.array(turned, dtype=wp.vec3, device=self._device)
        mesh = wp.full(len(turns), self.mesh.id, dtype=wp.uint64, device=self._device)
        off = wp.empty(points.shape, dtype=float, device=self._device)
        launch(off_mesh_kernel, off.shape, [points, mesh], [off])
        found = off.numpy()
        share = (found[:, :DENSE] > OFF_M).mean(axis=1)
        return np.where(found.max(axis=1) > self._most_m, 1.0, share)


def _distinct(turns: np.ndarray) -> np.ndarray:
    """Symmetries among the rotations that fit, best first [R, 4]: the identity, then others [S, 4].

    A small turn of any shape fits too, and so do turns that differ little from a symmetry. Of
    rotations that neighbour each other only the best counts, unless those that neighbour the
    identity go around: then the shape is one of revolution, and all count.
    """
    chosen = _apart(np.concatenate([np.array([[0.0, 0.0, 0.0, 1.0]], dtype=np.float32), turns]))
    angle = _angles(chosen[:, None], chosen[None])
    _, family = connected_components(angle < BESIDE_RAD)
    if angle[0, family == family[0]].max() > AROUND_RAD:
        return chosen
    return chosen[np.sort(np.unique(family, return_index=True)[1])]


def _apart(turns: np.ndarray) -> np.ndarray:
    """Of rotations [R, 4] those that differ from all before them, :data:`MOST` at most."""
    chosen = turns[:1]
    for turn in turns[1:]:
        if len(chosen) < MOST and _angles(chosen, turn).min() > APART_RAD:
            chosen = np.concatenate([chosen, turn[None]])
    return chosen


def _closed(turns: np.ndarray, surface: _Surface) -> np.ndarray:
    """A group of rotations [S, 4].

    Products that were missed are added, what has others is left out.

    Symmetries form a group: where the product of two is none, one of them only nearly is. Those of
    a ball are too many to be one; then all stay.
    """
    growing = True
    while True:
        products = product(turns[:, None], turns[None])
        missed = _angles(products[:, :, None], turns).min(axis=2) > CLOSED_RAD
        if not missed.any() or len(turns) == MOST:
            return turns
        if growing:
            new = _apart(products[missed])
            new = new[surface.share_off(new) <= OFF_SHARE][: MOST - len(turns)]
            growing = len(new) > 0
            turns = np.concatenate([turns, new])
            continue
        wrong = missed.sum(axis=0) + missed.sum(axis=1)
        worst = len(turns) - 1 - int(np.argmax(wrong[::-1]))  # the last of equals fits least
        turns = np.delete(turns, worst, axis=0)


def _angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles between quaternions [.., 4] [rad]."""
    return 2.0 * np.arccos(np.minimum(np.abs((first * second).sum(axis=-1)), 1.0))
