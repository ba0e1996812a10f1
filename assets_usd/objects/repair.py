"""What of a mesh is the object: strays and other bodies taken off, seams and holes closed, cavities found."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vd.assets_usd.objects.geometry import (
    SLIVER_THICKNESS,
    Hull,
    convex_hull,
    hull_volume,
    inside,
    mesh_volume,
    sides_along_axes,
    triangle_areas,
)
from vd.assets_usd.objects.settings import MeshError

CONVEX = 0.99
"""A closed piece that fills this share of its convex hull is taken as convex."""

STRAY_AREA, STRAY_VOLUME = 0.01, 1e-3
"""A piece with less of the surface, which encloses nothing or less of the volume, is a stray: scans have
single triangles inside and beside them."""

STRAYS_AREA = 0.05
"""Strays with more of the surface together are the surface itself, in pieces that do not join."""

APART = 0.02
"""Pieces whose boxes are farther from each other than this share of the longest side are apart: 2 mm of
10 cm. Models put together from pieces touch or overlap."""

MOST_PIECES = 2000
"""A surface of more pieces is torn, and no collection of bodies."""

OTHER_BODIES = 0.05
"""Bodies apart that hold less than this share of the volume are debris and are left out. With more there are
several objects: which of them is meant cannot be known, and one rigid body cannot stand for them."""

FILLED_AREA = 0.1
"""Holes are filled up to this share of the surface. A larger opening may be meant: a cup has one of 14 %."""

INSIDE_SAMPLES = 64
"""Corners of a piece, about, by which it is told that it lies in another."""

CAVITY = 0.01
"""Cavities with less than this share of the volume are not spoken of."""


@dataclass(frozen=True)
class RepairedMesh:
    """The outer surface of an object in its own units, and what is hollow in it.

    Attributes:
        vertices: [V, 3] float64.
        faces: [T, 3] int32.
        closed: It has no edge, and encloses a volume.
        watertight: Closed, consistently wound and of one piece.
        pieces: Convex hulls of the closed pieces if all are convex, else empty: such a mesh is
            decomposed as it stands.
        cavity_vertices: Vertices of closed surfaces within [W, 3].
        cavity_faces: Their faces [H, 3], wound as those of the solid: inward around a cavity.
        notes: What was done.
        warnings: What may be wrong with the object.
    """

    vertices: np.ndarray
    faces: np.ndarray
    closed: bool
    watertight: bool
    pieces: tuple[Hull, ...]
    cavity_vertices: np.ndarray
    cavity_faces: np.ndarray
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    def scaled(self, factor: float) -> "RepairedMesh":
        """The mesh times a factor."""
        return replace(
            self,
            vertices=self.vertices * factor,
            pieces=tuple(Hull(p.vertices * factor, p.faces) for p in self.pieces),
            cavity_vertices=self.cavity_vertices * factor,
        )


def repair_mesh(mesh: Any) -> RepairedMesh:
    """Find the object in a mesh and close it.

    Merges vertices, drops degenerate and duplicate faces, opens seams at which surfaces only touch, drops
    strays and debris, fills small holes, turns the pieces outward and tells cavities from solids.

    Args:
        mesh: A ``trimesh.Trimesh`` in any unit.

    Raises:
        MeshError: Nothing but degenerate faces, several bodies, or too thin.
    """
    import trimesh

    notes: list[str] = []
    warnings: list[str] = []
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    before = len(mesh.faces)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if not len(mesh.faces):
        raise MeshError(f"degenerate: all {before} faces have no area")
    if len(mesh.faces) < before:
        notes.append(f"removed {before - len(mesh.faces)} degenerate or duplicate faces")
    mesh = _largest_body(_without_strays(_opened_seams(mesh), notes, warnings), warnings)
    sides = sides_along_axes(mesh.vertices)
    if sides.min() < SLIVER_THICKNESS * sides.max():
        raise MeshError(
            f"degenerate: flat ({sides.min():.3g} thick for {sides.max():.3g} long); contacts need at "
            f"least {100 * SLIVER_THICKNESS:g} % of the length: give it thickness"
        )
    if not mesh.is_winding_consistent:
        notes.append("fixed winding")
        trimesh.repair.fix_winding(mesh)
    mesh = _filled_holes(mesh, notes)
    mesh, cavity_vertices, cavity_faces = _turned_outward(mesh, warnings)
    pieces = convex_pieces(mesh)
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0)
    if pieces:
        notes.append(f"{len(pieces)} convex piece{'s' if len(pieces) > 1 else ''}: nothing to decompose")
    return RepairedMesh(
        np.asarray(mesh.vertices, dtype=np.float64),
        np.asarray(mesh.faces, dtype=np.int32),
        closed,
        closed and mesh.body_count == 1,
        pieces,
        cavity_vertices,
        cavity_faces,
        tuple(notes),
        tuple(warnings),
    )


def _opened_seams(mesh: Any) -> Any:
    """The mesh with edges of more than two faces opened: each sheet of faces gets vertices of its own.

    Surfaces that only touch along an edge are closed, yet no manifold; apart from each other they are.
    """
    import trimesh

    count = np.bincount(mesh.edges_unique_inverse)
    if count.max() <= 2:
        return mesh
    # Corners of faces that meet in a plain edge share a vertex, others do not.
    faces = mesh.faces
    edges = mesh.edges_unique_inverse.reshape(-1, 3)  # (a, b), (b, c), (c, a) of every face
    order = np.argsort(edges.ravel(), kind="stable")
    plain = order[count[edges.ravel()[order]] == 2].reshape(-1, 2)
    face, start = np.divmod(plain, 3)
    links = []
    for first in (start, (start + 1) % 3):  # the edge's ends on one face, and the same on the other
        vertex = faces[face[:, 0], first[:, 0]]
        other = np.argmax(faces[face[:, 1]] == vertex[:, None], axis=1)
        links.append(np.stack([3 * face[:, 0] + first[:, 0], 3 * face[:, 1] + other]))
    corner = trimesh.graph.connected_component_labels(np.concatenate(links, axis=1).T, node_count=faces.size)
    vertices = np.zeros((corner.max() + 1, 3))
    vertices[corner] = mesh.vertices[faces.ravel()]
    return trimesh.Trimesh(vertices, corner.reshape(-1, 3), process=False)


@dataclass(frozen=True)
class _Pieces:
    """The connected pieces of a mesh.

    Attributes:
        of_face: Piece of each face [T].
        faces: Faces of each piece.
        low: Lower corner of the box of each [P, 3].
        high: Upper corner [P, 3].
        area: Area of each [P].
        closed: Which are closed [P].
        volume: Signed volume of each, 0 of open ones [P].
    """

    of_face: np.ndarray
    faces: list[np.ndarray]
    low: np.ndarray
    high: np.ndarray
    area: np.ndarray
    closed: np.ndarray
    volume: np.ndarray


def _pieces(mesh: Any) -> _Pieces:
    """The connected pieces of a ``trimesh.Trimesh``."""
    import trimesh

    of_face = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    number = of_face.max() + 1
    area = np.bincount(of_face, triangle_areas(mesh.vertices, mesh.faces), number)
    open_edges = np.bincount(mesh.edges_unique_inverse)[mesh.edges_unique_inverse] != 2
    closed = np.bincount(of_face[mesh.edges_face], open_edges, number) == 0
    corner = mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0)
    six_volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
    order = np.argsort(of_face, kind="stable")
    faces = np.split(mesh.faces[order], np.cumsum(np.bincount(of_face))[:-1])
    low, high = (np.array([b(mesh.vertices[f.ravel()], axis=0) for f in faces]) for b in (np.min, np.max))
    volume = np.where(closed, np.bincount(of_face, six_volume, number) / 6.0, 0.0)
    return _Pieces(of_face, faces, low, high, area, closed, volume)


def _kept(mesh: Any, keep: np.ndarray) -> Any:
    """The mesh with some of its faces [T]."""
    mesh = mesh.copy()
    mesh.update_faces(keep)
    mesh.remove_unreferenced_vertices()
    return mesh


def _without_strays(mesh: Any, notes: list[str], warnings: list[str]) -> Any:
    """The mesh without its strays; there is a warning if these made it longer."""
    pieces = _pieces(mesh)
    stray = (pieces.area < STRAY_AREA * pieces.area.sum()) & (
        np.abs(pieces.volume) <= STRAY_VOLUME * np.abs(pieces.volume).sum()
    )
    if not stray.any() or pieces.area[stray].sum() > STRAYS_AREA * pieces.area.sum():
        return mesh
    kept = _kept(mesh, ~stray[pieces.of_face])
    words = f"removed {stray.sum()} stray piece{'s' if stray.sum() > 1 else ''} of surface"
    longest = [float(np.ptp(each.vertices, axis=0).max()) for each in (mesh, kept)]
    if longest[0] > (1.0 + APART) * longest[1]:
        warnings.append(f"{words}, which made it {longest[0] / longest[1]:.3g} times as long")
    else:
        notes.append(words)
    return kept


def _largest_body(mesh: Any, warnings: list[str]) -> Any:
    """The mesh without bodies that are apart from its largest.

    Raises:
        MeshError: They are too large to be debris.
    """
    while True:
        body, volume = _bodies(mesh)
        if len(volume) == 1:
            return mesh
        largest = int(np.argmax(volume))
        share = 1.0 - volume[largest] / max(volume.sum(), 1e-300)
        if share > OTHER_BODIES:
            raise MeshError(
                f"{len(volume)} bodies apart from each other, of which the largest has "
                f"{100 * (1 - share):.0f} % of the volume: an object is one rigid body; import each alone, "
                "or join them"
            )
        warnings.append(
            f"left out {len(volume) - 1} piece{'s' if len(volume) > 2 else ''} apart from the largest body, "
            f"{100 * share:.1f} % of the volume"
        )
        # Debris far away makes all else look near: look again without it.
        mesh = _kept(mesh, body == largest)


def _bodies(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Body of each face [T], and of each body the volume of its convex hull, which open ones have too.

    Pieces belong to one body if their boxes touch, or nearly so.
    """
    import trimesh

    pieces = _pieces(mesh)
    number = len(pieces.area)
    if number > MOST_PIECES:
        return np.zeros(len(mesh.faces), dtype=int), np.ones(1)
    low, high = pieces.low, pieces.high + APART * float(np.ptp(mesh.vertices, axis=0).max())
    near = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    body = trimesh.graph.connected_component_labels(np.argwhere(near), node_count=number)
    of_face = body[pieces.of_face]
    corners = [mesh.vertices[mesh.faces[of_face == b].ravel()] for b in range(body.max() + 1)]
    return of_face, np.array([hull_volume(points) for points in corners])


def _containers(mesh: Any, pieces: _Pieces) -> dict[int, int]:
    """Of each piece that lies wholly in a closed one: the smallest such one."""
    groups, low, high = pieces.faces, pieces.low, pieces.high
    found: dict[int, int] = {}
    for outer in np.argsort(np.abs(pieces.volume))[::-1]:  # smaller ones last: they overrule
        if not pieces.closed[outer]:
            continue
        for inner in np.flatnonzero((low > low[outer]).all(axis=1) & (high < high[outer]).all(axis=1)):
            corners = np.unique(groups[inner])
            some = mesh.vertices[corners[:: max(1, len(corners) // INSIDE_SAMPLES)]]
            surface = groups[outer] if pieces.volume[outer] > 0.0 else groups[outer][:, ::-1]
            if inside(mesh.vertices, surface, some).all():
                found[int(inner)] = int(outer)
    return found


def _filled_holes(mesh: Any, notes: list[str]) -> Any:
    """The mesh with its holes closed by fans, if they are small together."""
    import trimesh

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
    filled = float(triangle_areas(vertices, np.array(fans)).sum())
    if filled > FILLED_AREA * (mesh.area + filled):
        return mesh
    notes.append(f"filled {len(centres)} hole{'s' if len(centres) > 1 else ''}")
    return trimesh.Trimesh(vertices, np.concatenate([mesh.faces, fans]), process=False)


def _turned_outward(mesh: Any, warnings: list[str]) -> tuple[Any, np.ndarray, np.ndarray]:
    """The outer surface with its closed pieces wound outward, and vertices and faces of the cavities in it.

    A closed piece in another is a cavity if it is wound the other way round, and else inside of the solid.
    What is in a cavity is solid again.
    """
    import trimesh

    pieces = _pieces(mesh)
    inner = _containers(mesh, pieces)
    side = np.sign(pieces.volume)
    for piece in inner:  # as if the outermost piece were wound outward
        side[piece] *= np.sign(pieces.volume[_outermost(piece, inner)])
    side[np.setdiff1d(np.arange(len(side)), list(inner))] = 1.0
    borders = [piece for piece, outer in inner.items() if side[piece] * side[outer] < 0.0]
    faces = mesh.faces.copy()
    turned = (side * pieces.volume < 0.0)[pieces.of_face]
    faces[turned] = faces[turned][:, ::-1]
    outer = ~np.isin(pieces.of_face, list(inner))
    whole = np.abs(pieces.volume[~np.isin(np.arange(len(side)), list(inner))]).sum()
    hollow = -(side * np.abs(pieces.volume))[borders].sum()
    if hollow > CAVITY * whole:
        warnings.append(
            f"has a closed cavity of {100 * hollow / whole:.0f} % of its volume: mass and inertia are "
            "those of the hollow body, its convex parts are full"
        )
    if np.abs(pieces.volume[[k for k in inner if k not in borders]]).sum() > CAVITY * whole:
        warnings.append(
            "a closed surface inside of another is wound like it, and taken as solid: if it is a cavity, "
            "turn its faces round"
        )
    kept = trimesh.Trimesh(mesh.vertices, faces[outer], process=False)
    kept.remove_unreferenced_vertices()
    return kept, mesh.vertices, faces[np.isin(pieces.of_face, borders)]


def _outermost(piece: int, inner: dict[int, int]) -> int:
    while piece in inner:
        piece = inner[piece]
    return piece


def convex_pieces(mesh: Any) -> tuple[Hull, ...]:
    """Convex hulls of a ``trimesh.Trimesh``'s connected pieces; none unless all are closed and convex."""
    hulls = []
    for piece in mesh.split(only_watertight=False):
        if not piece.is_watertight:
            return ()
        try:
            hull = convex_hull(piece.vertices)
        except ValueError:
            return ()
        if abs(mesh_volume(piece.vertices, piece.faces)) < CONVEX * mesh_volume(*hull):
            return ()
        hulls.append(hull)
    return tuple(hulls)
