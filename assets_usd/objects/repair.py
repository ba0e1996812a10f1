"""What of a mesh is the object.

Strays and other bodies taken off, seams and holes closed, cavities found.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import trimesh

from vd.assets_usd.objects.geometry import (
    SLIVER_THICKNESS,
    Hull,
    Surface,
    convex_hull,
    hull_volume,
    inside,
    sides_along_axes,
    triangle_areas,
)
from vd.assets_usd.objects.settings import MeshError

CONVEX = 0.99
"""A closed piece that fills this share of its convex hull is taken as convex."""

STRAY_AREA = 0.01
STRAY_VOLUME = 1e-3
"""A piece with less of the surface, which encloses nothing or less of the volume, is a stray: scans
have single triangles inside and beside them."""

LONG = 0.05
"""What is longer than this share of the object is a part of it where it touches, and is never left
out without a warning."""

STRAYS_AREA = 0.05
"""Strays with more of the surface together are the surface itself, in pieces that do not join."""

APART = 0.02
"""Pieces whose boxes are farther from each other than this share of the longest side are apart: 2
mm of 10 cm. Models put together from pieces touch or overlap."""

MOST_PIECES = 5000
"""A surface of more pieces is torn, and no collection of bodies."""

OTHER_BODIES = 0.05
"""Bodies apart that hold less than this share of the volume are debris and are left out. With more
there are several objects: which of them is meant cannot be known, and one rigid body cannot stand
for them.
"""

FILLED_AREA = 0.1
"""Holes are filled up to this share of the surface. A larger opening may be meant: a cup has one of
14 %.
"""

INSIDE_SAMPLES = 64
"""Corners of a piece, about, by which it is told that it lies in another."""

CAVITY = 0.01
"""Cavities with less than this share of the volume are not spoken of."""


@dataclass(frozen=True)
class RepairedMesh:
    """The outer surface of an object in its own units, and what is hollow in it.

    Attributes:
        surface: The outer surface, float64 and int32.
        closed: It has no edge, and encloses a volume.
        watertight: Closed, consistently wound and of one piece.
        pieces: Convex hulls of the closed pieces if all are convex, else empty: such a mesh is
            decomposed as it stands.
        cavities: Closed surfaces within, wound as those of the solid: inward around a cavity.
        notes: What was done.
        warnings: What may be wrong with the object.
    """

    surface: Surface
    closed: bool
    watertight: bool
    pieces: tuple[Hull, ...]
    cavities: Surface
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    def scaled(self, factor: float) -> "RepairedMesh":
        """The mesh times a factor."""
        return replace(
            self,
            surface=self.surface.times(factor),
            pieces=tuple(hull.times(factor) for hull in self.pieces),
            cavities=self.cavities.times(factor),
        )


def repair_mesh(mesh: Any) -> RepairedMesh:
    """Find the object in a mesh and close it.

    Merges vertices, drops degenerate and duplicate faces, opens seams at which surfaces only touch,
    drops strays and debris, fills small holes, turns the pieces outward and tells cavities from
    solids.

    Args:
        mesh: A ``trimesh.Trimesh`` in any unit.

    Raises:
        MeshError: Nothing but degenerate faces, several bodies, or too thin.
    """
    notes: list[str] = []
    warnings: list[str] = []
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    before = len(mesh.faces)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if not len(mesh.faces):
        raise MeshError(
            f"degenerate: all {before} faces have no area; a GLB is to be exported without "
            f"compression"
        )
    if dropped := before - len(mesh.faces):
        notes.append(f"removed {dropped} degenerate or duplicate faces")
    mesh = _largest_body(_without_strays(_opened_seams(mesh), notes, warnings), warnings)
    sides = sides_along_axes(mesh.vertices)
    if sides.min() < SLIVER_THICKNESS * sides.max():
        raise MeshError(
            f"degenerate: flat ({sides.min():.3g} thick for {sides.max():.3g} long); contacts need "
            f"at least {100 * SLIVER_THICKNESS:g} % of the length: give it thickness"
        )
    if not mesh.is_winding_consistent:
        notes.append("fixed winding")
        trimesh.repair.fix_winding(mesh)
    mesh = _filled_holes(mesh, notes)
    mesh, pieces, cavities = _turned_outward(mesh, notes, warnings)
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0)
    return RepairedMesh(
        Surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32)),
        closed,
        closed and mesh.body_count == 1,
        pieces,
        cavities,
        tuple(notes),
        tuple(warnings),
    )


def _opened_seams(mesh: Any) -> Any:
    """The mesh with edges of more than two faces opened.

    Each sheet of faces gets vertices of its own.

    Surfaces that only touch along an edge are closed, yet no manifold; apart from each other they
    are.
    """
    if np.bincount(mesh.edges_unique_inverse).max() <= 2:
        return mesh
    # Corners of faces that meet in an edge of two faces share a vertex, others do not.
    faces = mesh.faces
    links = []
    for vertex in mesh.face_adjacency_edges.T:
        place = np.argmax(faces[mesh.face_adjacency] == vertex[:, None, None], axis=2)
        links.append(3 * mesh.face_adjacency + place)
    corner = trimesh.graph.connected_component_labels(np.concatenate(links), node_count=faces.size)
    vertices = np.zeros((corner.max() + 1, 3))
    vertices[corner] = mesh.vertices[faces.ravel()]
    return trimesh.Trimesh(vertices, corner.reshape(-1, 3), process=False)


class _Pieces(NamedTuple):
    """The P connected pieces of a mesh."""

    of_face: np.ndarray
    """Piece of each face [T]."""
    meshes: list[Any]
    volume: np.ndarray
    """Signed, 0 of open ones [P]."""
    low: np.ndarray
    high: np.ndarray
    """Corners of their boxes [P, 3]."""


def _pieces(mesh: Any) -> _Pieces:
    """The connected pieces of a mesh; a torn surface counts as one."""
    of_face = trimesh.graph.connected_component_labels(
        mesh.face_adjacency, node_count=len(mesh.faces)
    )
    if of_face.max() >= MOST_PIECES:
        of_face = np.zeros_like(of_face)
        meshes = [mesh]
    else:
        meshes = mesh.split(only_watertight=False, repair=False)
    volume = np.zeros(len(meshes))
    bounds = np.zeros((2, len(meshes), 3))
    for number, piece in enumerate(meshes):
        bounds[:, number] = piece.bounds
        if piece.is_watertight:
            volume[number] = piece.volume
    return _Pieces(of_face, meshes, volume, *bounds)


def _kept(mesh: Any, keep: np.ndarray) -> Any:
    """The mesh with some of its faces [T]."""
    mesh = mesh.copy()
    mesh.update_faces(keep)
    mesh.remove_unreferenced_vertices()
    return mesh


def _touching(pieces: _Pieces, gap: float) -> np.ndarray:
    """Which of the pieces' boxes have at most a gap between them, bool [P, P]."""
    low = pieces.low
    high = pieces.high + gap
    return np.asarray(((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2))


def _without_strays(mesh: Any, notes: list[str], warnings: list[str]) -> Any:
    """The mesh without its strays; there is a warning of long ones, or if they made it longer.

    A long one that touches, as by their boxes, is a thin part: an antenna, a ring of wire.
    """
    pieces = _pieces(mesh)
    of_face = pieces.of_face
    area = np.bincount(of_face, mesh.area_faces)
    volume = np.abs(pieces.volume)
    stray = (area < STRAY_AREA * area.sum()) & (volume <= STRAY_VOLUME * volume.sum())
    if stray.all():
        return mesh
    length = (pieces.high - pieces.low).max(axis=1)
    whole = np.ptp(mesh.triangles[~stray[of_face]].reshape(-1, 3), axis=0).max()
    touches = _touching(pieces, APART * whole)[:, ~stray].any(axis=1)
    stray &= (length <= LONG * whole) | ~touches
    if not stray.any() or area[stray].sum() > STRAYS_AREA * area.sum():
        return mesh
    kept = _kept(mesh, ~stray[of_face])
    words = f"removed {stray.sum()} stray piece{'s' if stray.sum() > 1 else ''} of surface"
    longer = mesh.extents.max() / kept.extents.max()
    if longer > 1.0 + APART:
        warnings.append(f"{words}, which made it {longer:.3g} times as long")
    elif (most := length[stray].max() / whole) > LONG:
        warnings.append(f"{words}, up to {100 * most:.0f} % as long as it is")
    else:
        notes.append(words)
    return kept


def _largest_body(mesh: Any, warnings: list[str]) -> Any:
    """The mesh without bodies that are apart from its largest, by the volume of their convex hulls.

    Pieces belong to one body if their boxes touch, or nearly so.

    Raises:
        MeshError: They are too large to be debris.
    """
    pieces = _pieces(mesh)
    near = np.argwhere(_touching(pieces, APART * mesh.extents.max()))
    body = trimesh.graph.connected_component_labels(near, node_count=len(pieces.meshes))
    of_face = body[pieces.of_face]
    number = of_face.max() + 1
    if number == 1:
        return mesh
    volume = np.zeros(number)
    for k in range(number):
        volume[k] = hull_volume(mesh.triangles[of_face == k].reshape(-1, 3))
    share = 1.0 - volume.max() / max(volume.sum(), 1e-300)
    if share > OTHER_BODIES:
        raise MeshError(
            f"{number} bodies apart from each other, of which the largest has "
            f"{100 * (1 - share):.0f} % of "
            "the volume: an object is one rigid body; import each alone, or join them"
        )
    warnings.append(
        f"left out {number - 1} piece{'s' if number > 2 else ''} apart from the largest body, "
        f"{100 * share:.1f} % of the volume"
    )
    # Debris far away makes all else look near: look again without it.
    return _largest_body(_kept(mesh, of_face == np.argmax(volume)), warnings)


def _containers(pieces: _Pieces) -> tuple[np.ndarray, np.ndarray]:
    """The largest and the smallest closed piece in which each lies wholly, [P] each.

    Itself if in none.
    """
    _, meshes, volume, low, high = pieces
    largest = np.arange(len(meshes))
    smallest = np.arange(len(meshes))
    for outer in np.argsort(np.abs(volume))[::-1]:
        if not volume[outer]:
            break
        faces = meshes[outer].faces
        outward = faces if volume[outer] > 0.0 else faces[:, ::-1]
        surface = Surface(meshes[outer].vertices, outward)
        for inner in np.flatnonzero(
            (low > low[outer]).all(axis=1) & (high < high[outer]).all(axis=1)
        ):
            corners = meshes[inner].vertices
            some = corners[:: max(1, len(corners) // INSIDE_SAMPLES)]
            if inside(surface, some).all():
                smallest[inner] = outer
                largest[inner] = outer if largest[inner] == inner else largest[inner]
    return largest, smallest


def _filled_holes(mesh: Any, notes: list[str]) -> Any:
    """The mesh with its holes closed by fans, if they are small together."""
    count = np.bincount(mesh.edges_unique_inverse)
    rim = mesh.edges[count[mesh.edges_unique_inverse] == 1]  # directed as in their faces
    if not len(rim):
        return mesh
    after = dict(rim.tolist())
    centres: list[np.ndarray] = []
    fans: list[tuple[int, int, int]] = []
    while after:
        start, corner = after.popitem()
        loop = [start]
        while corner != start and corner in after:
            loop.append(corner)
            corner = after.pop(corner)
        if corner != start:
            return mesh  # not a loop: the faces are not wound alike
        middle = len(mesh.vertices) + len(centres)
        centres.append(mesh.vertices[loop].mean(axis=0))
        fans += [(middle, b, a) for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    vertices = np.concatenate([mesh.vertices, centres])
    filled = float(triangle_areas(Surface(vertices, np.array(fans))).sum())
    if filled > FILLED_AREA * (mesh.area + filled):
        return mesh
    notes.append(f"filled {len(centres)} hole{'s' if len(centres) > 1 else ''}")
    return trimesh.Trimesh(vertices, np.concatenate([mesh.faces, fans]), process=False)


def _turned_outward(
    mesh: Any, notes: list[str], warnings: list[str]
) -> tuple[Any, tuple[Hull, ...], Surface]:
    """The outer surface with its closed pieces wound outward, its convex pieces, and the cavities.

    A closed piece in another is a cavity if it is wound the other way round, and else inside of the
    solid. What is in a cavity is solid again.
    """
    pieces = _pieces(mesh)
    of_face = pieces.of_face
    volume = pieces.volume
    largest, smallest = _containers(pieces)
    faces = mesh.faces.copy()
    turned = (volume[largest] < 0.0)[of_face]  # as if the outermost piece were wound outward
    faces[turned] = faces[turned][:, ::-1]
    within = smallest != np.arange(len(volume))
    border = within & (volume * volume[smallest] < 0.0)
    whole = np.abs(volume[~within]).sum()
    hollow = -(volume * np.sign(volume[largest]))[border].sum()
    if hollow > CAVITY * whole:
        warnings.append(
            f"has a closed cavity of {100 * hollow / whole:.0f} % of its volume: mass and inertia "
            "are those of the hollow body, its convex parts are full"
        )
    if np.abs(volume[within & ~border]).sum() > CAVITY * whole:
        warnings.append(
            "a closed surface inside of another is wound like it, and taken as solid: if it is a "
            "cavity, turn its faces round"
        )
    kept = trimesh.Trimesh(mesh.vertices, faces[~within[of_face]], process=False)
    kept.remove_unreferenced_vertices()
    hulls = _convex_hulls(pieces.meshes, ~within)
    if hulls:
        notes.append(
            f"{len(hulls)} convex piece{'s' if len(hulls) > 1 else ''}: nothing to decompose"
        )
    return kept, hulls, Surface(mesh.vertices, faces[border[of_face]])


def _convex_hulls(pieces: list[Any], outer: np.ndarray) -> tuple[Hull, ...]:
    """Convex hulls of the outer ones of pieces [P]; none unless all are closed and convex."""
    hulls = []
    for number in np.flatnonzero(outer):
        piece = pieces[number]
        if not piece.is_watertight or abs(piece.volume) <= CONVEX * hull_volume(piece.vertices):
            return ()
        hulls.append(convex_hull(piece.vertices))
    return tuple(hulls)
