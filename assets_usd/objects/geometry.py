"""Geometry of objects: convex hulls, mass properties, surface samples, coarser meshes.

Plain NumPy and SciPy on small meshes. Lengths in metres, masses in kilograms; arrays of points are
``[n, 3]``, triangles ``[t, 3]`` with outward (counter-clockwise) winding.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

MOST_DISTANCES = 2**22
"""Distances of points from planes that are computed at once: 32 MB."""

CANDIDATES_PER_POINT = 8
"""Random candidates per surface point kept by farthest-point sampling: even cover at little
cost.
"""

SIMPLIFY_TOLERANCE = 1e-3
"""Simplifying a hull stops once every vertex left out is this close to it, relative to its size."""

FINEST_GRID = 65536.0
COARSEST_GRID = 8.0
GRID_BISECTIONS = 8
"""Grids tried when a mesh is coarsened: cells along its longest side, and bisection steps.
The finest has room for debris that makes the object itself small."""


SLIVER_THICKNESS = 2e-3
"""A part thinner than this share of the longest side (0.25 mm of 12 cm) is no solid to collide
with.
"""


class MeshError(ValueError):
    """A mesh is refused; the message is the reason."""


class Surface(NamedTuple):
    """Triangles: ``vertices`` [V, 3], and ``faces`` [T, 3], outward where they are closed."""

    vertices: np.ndarray
    faces: np.ndarray

    def times(self, factor: "float | np.floating") -> "Surface":
        """The surface, larger by a factor."""
        return self._replace(vertices=self.vertices * factor)


Hull = Surface
"""A convex polyhedron."""


class Solid(NamedTuple):
    """Volume, centroid [3] and inertia about it [3, 3] of a solid of uniform density 1.

    Of a link of a hand the volume is its mass.
    """

    volume: float
    centroid: np.ndarray
    inertia: np.ndarray


def _corners(surface: Surface) -> np.ndarray:
    """First, second and third corners of triangles, [3, T, 3] float64."""
    return np.asarray(surface.vertices, dtype=np.float64)[surface.faces.T]


def _normals(surface: Surface) -> np.ndarray:
    """Normals of triangles [T, 3], as long as twice their areas."""
    a, b, c = _corners(surface)
    return np.cross(b - a, c - a)


def convex_hull(points: np.ndarray) -> Hull:
    """Convex hull of points.

    Args:
        points: [n, 3], at least four of them not in one plane.

    Raises:
        ValueError: There is no such four of them.
    """
    points = np.asarray(points, dtype=np.float64)
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise ValueError("the points lie in one plane") from error
    simplices = hull.simplices
    normal = _normals(Surface(points, simplices))
    inward = (normal * hull.equations[:, :3]).sum(axis=1) < 0.0
    simplices[inward] = simplices[inward, ::-1]
    used, faces = np.unique(simplices, return_inverse=True)
    return Hull(points[used], faces.reshape(-1, 3).astype(np.int32))


def hull_volume(points: np.ndarray) -> float:
    """Volume of the convex hull of points [n, 3], m^3; 0 if they are flat."""
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return 0.0


def hull_depth(hull: Hull, points: np.ndarray) -> np.ndarray:
    """Largest signed plane distance [n] of points [n, 3]: negative inside, 0 on the surface, m."""
    planes = ConvexHull(hull.vertices).equations
    depth = np.zeros(len(points))
    rows = 1 + MOST_DISTANCES // len(planes)
    for first in range(0, len(points), rows):
        chunk = slice(first, first + rows)
        depth[chunk] = (points[chunk] @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    return depth


def union_depth(hulls: Sequence[Hull], points: np.ndarray) -> np.ndarray:
    """As :func:`hull_depth` for the union of hulls: the least value over them, [n]."""
    depth = np.full(len(points), np.inf)
    for hull in hulls:
        np.minimum(depth, hull_depth(hull, points), out=depth)
    return depth


def mesh_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume enclosed by a closed mesh, m^3 (divergence theorem)."""
    a, b, c = _corners(Surface(vertices, faces))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def _queried(surface: Surface, points: np.ndarray, *, winding: bool = False) -> Any:
    """A mesh of unit length on the processor, and points [.., 3] in its frame, for kernels."""
    import warp as wp

    low = surface.vertices.min(axis=0)
    size = np.ptp(surface.vertices, axis=0).max()
    corners = wp.array((surface.vertices - low) / size, dtype=wp.vec3, device="cpu")
    indices = wp.array(surface.faces.ravel(), dtype=wp.int32, device="cpu")
    mesh = wp.Mesh(corners, indices, support_winding_number=winding)
    return mesh, wp.array((points - low) / size, dtype=wp.vec3, device="cpu")


def inside(surface: Surface, points: np.ndarray, level: float = 0.5) -> np.ndarray:
    """Whether the winding number of a mesh exceeds ``level`` at points [n, 3], bool [n]."""
    import warp as wp

    from vd.kernels.sensor.winding import inside_kernel

    mesh, places = _queried(surface, points, winding=True)
    result = wp.zeros(len(points), dtype=wp.bool, device="cpu")
    wp.launch(inside_kernel, result.shape, [mesh.id, level, places], [result], device="cpu")
    return np.asarray(result.numpy(), dtype=bool)


def distances(surface: Surface, points: np.ndarray) -> np.ndarray:
    """Distances of points [n, 3] from a mesh at most its length away, [n]."""
    import warp as wp

    from vd.kernels.sensor.shape_grids import off_mesh_kernel

    mesh, places = _queried(surface, points[None])
    result = wp.zeros((1, len(points)), dtype=float, device="cpu")
    number = wp.array([mesh.id], dtype=wp.uint64, device="cpu")
    wp.launch(off_mesh_kernel, result.shape, [places, number], [result], device="cpu")
    return np.asarray(np.ptp(surface.vertices, axis=0).max() * result.numpy()[0])


def sides_along_axes(points: np.ndarray) -> np.ndarray:
    """Extents of points [n, 3] along their principal axes, [3]."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    return np.ptp(points @ axes.T, axis=0)


def simplify_hull(hull: Hull, max_vertices: int) -> Hull:
    """A hull of at most ``max_vertices`` of the given one's vertices, of equal volume.

    The vertex farthest outside is added until the limit or the tolerance is met; then the result is
    scaled about its centroid to the original volume, so that round parts shrink nowhere on average.
    """
    points = hull.vertices
    tolerance = SIMPLIFY_TOLERANCE * float(np.ptp(points, axis=0).max())
    chosen = _tetrahedron(points)
    kept = convex_hull(points[chosen])
    while len(chosen) < min(max_vertices, len(points)):
        depth = hull_depth(kept, points)
        farthest = int(np.argmax(depth))
        if depth[farthest] < tolerance:
            break
        chosen.append(farthest)
        kept = convex_hull(points[chosen])
    growth = np.cbrt(mesh_volume(*hull) / mesh_volume(*kept))
    centroid = solid_of_mesh(kept).centroid
    return Hull(centroid + (kept.vertices - centroid) * growth, kept.faces)


def _tetrahedron(points: np.ndarray) -> list[int]:
    """Four of points [n, 3].

    Each is the farthest from their mean, or the point, line or plane before.
    """
    away = points - points.mean(axis=0)
    chosen = [int(np.argmax(np.linalg.norm(away, axis=1)))]
    away = points - points[chosen[0]]
    for _ in range(3):
        distance = np.linalg.norm(away, axis=1)
        chosen.append(int(np.argmax(distance)))
        axis = away[chosen[-1]] / distance[chosen[-1]]
        away = away - np.outer(away @ axis, axis)
    return chosen


def solid_of_mesh(surface: Surface) -> Solid:
    """Exact mass properties of the solid bounded by a closed, outward mesh (density 1)."""
    from trimesh.triangles import mass_properties

    vertices = np.asarray(surface.vertices, dtype=np.float64)
    reference = vertices.mean(axis=0)
    mass = mass_properties((vertices - reference)[surface.faces])
    return Solid(float(mass.volume), reference + mass.center_mass, mass.inertia)


def joined(solids: Sequence[Solid]) -> Solid:
    """Mass properties of solids together; the volume of one that is taken away is negative."""
    volume = 0.0
    moment = np.zeros(3)
    for solid in solids:
        volume += solid.volume
        moment = moment + solid.volume * solid.centroid
    centroid = moment / volume
    inertia = np.zeros((3, 3))
    for solid in solids:
        arm = solid.centroid - centroid
        inertia = inertia + solid.inertia
        inertia = inertia + solid.volume * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Solid(volume, centroid, inertia)


def principal_axes(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Diagonalise an inertia tensor [3, 3].

    Returns:
        Principal moments [3], ascending, and the quaternion xyzw of the principal frame in the
        body.
    """
    moments, axes = np.linalg.eigh((inertia + inertia.T) / 2.0)
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] = -axes[:, 2]
    return moments, Rotation.from_matrix(axes).as_quat(canonical=True)


def triangle_areas(surface: Surface) -> np.ndarray:
    """Area of each triangle [T], m^2."""
    return np.linalg.norm(_normals(surface), axis=1) / 2.0


def random_surface_points(surface: Surface, count: int, rng: np.random.Generator) -> np.ndarray:
    """Uniform random points on a surface, [count, 3]."""
    area = np.cumsum(triangle_areas(surface))
    index = np.searchsorted(area, rng.uniform(0.0, area[-1], count))
    share = rng.uniform(size=(2, count, 1))
    u, v = np.where(share.sum(axis=0) > 1.0, 1.0 - share, share)
    a, b, c = _corners(surface)[:, index]
    return a + u * (b - a) + v * (c - a)


def surface_points(surface: Surface, count: int, *, outside: Sequence[Hull] = ()) -> np.ndarray:
    """Evenly spread points on a surface, by farthest-point sampling of random candidates.

    Equal input gives equal points.

    Args:
        surface: The surface.
        count: Number of points.
        outside: Points inside any of these hulls are left out (parts that overlap).

    Returns:
        [count, 3] float64.
    """
    rng = np.random.default_rng(0)
    tolerance = 1e-6 * float(np.ptp(surface.vertices, axis=0).max())
    candidates = np.zeros((0, 3))
    while len(candidates) < count:
        points = random_surface_points(surface, CANDIDATES_PER_POINT * count, rng)
        outer = points[union_depth(outside, points) > -tolerance]
        candidates = np.concatenate([candidates, outer])
    return candidates[spread(candidates, count)]


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """Rows of ``count`` points [N, 3] far from each other.

    Farthest-point sampling from the first one.
    """
    chosen = np.zeros(count, dtype=int)
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        np.minimum(distance, ((points - points[chosen[i - 1]]) ** 2).sum(axis=1), out=distance)
        chosen[i] = int(np.argmax(distance))
    return chosen


def cluster_vertices(surface: Surface, max_faces: int, *, closed: bool = False) -> Surface:
    """Coarsen a mesh to at most ``max_faces`` triangles by merging the vertices of a grid cell.

    The finest grid that meets the limit is found by bisection. A cell's vertex minimises the
    squared distance to the planes of the triangles around it (quadric error), which keeps edges
    sharp; the bounding box is kept. A thin wall becomes a sheet, or is gone where what is
    ``closed`` has to stay so.
    """
    vertices = surface.vertices
    faces = surface.faces
    if len(faces) <= max_faces:
        return Surface(vertices, faces)
    surface = Surface(vertices, faces)
    fine = FINEST_GRID
    coarse = COARSEST_GRID
    cell, merged = _clustered(surface, coarse, closed=closed)
    for _ in range(GRID_BISECTIONS):
        cells = float(np.sqrt(fine * coarse))
        finer = _clustered(surface, cells, closed=closed)
        if len(finer[1]) > max_faces:
            fine = cells
        else:
            coarse = cells
            cell, merged = finer
    side = np.ptp(vertices, axis=0)
    used, index = np.unique(merged, return_inverse=True)
    moved = _quadric_vertices(surface, cell, float(side.max()) / coarse)[used]
    extent = np.ptp(moved, axis=0)
    scale = np.where(extent > 0.0, side / np.maximum(extent, 1e-30), 1.0)
    moved = vertices.min(axis=0) + (moved - moved.min(axis=0)) * scale
    return Surface(moved, index.reshape(-1, 3).astype(np.int32))


def _clustered(surface: Surface, cells: float, *, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Cell of each vertex [V] on a grid, and the triangles left.

    The grid has ``cells`` along the longest side. Each triangle is there once: a thin wall becomes
    a sheet. What is ``closed`` stays so.
    """
    from trimesh.grouping import unique_rows

    away = surface.vertices - surface.vertices.min(axis=0)
    x, y, z = np.floor(away / float(away.max()) * cells).astype(np.int64).T
    most = int(cells) + 1
    cell = np.unique((x * most + y) * most + z, return_inverse=True)[1].reshape(-1)
    merged = cell[surface.faces]
    a, b, c = merged.T
    merged = merged[(a != b) & (b != c) & (c != a)]
    first, group = unique_rows(np.sort(merged, axis=1))
    if closed:  # of triangles with equal corners an even number goes
        first = first[np.bincount(group) % 2 == 1]
    return cell, merged[np.sort(first)]


def _quadric_vertices(surface: Surface, cluster: np.ndarray, cell: float) -> np.ndarray:
    """Vertex of each cluster.

    Near its mean, on the planes of its triangles, at most a cell away.
    """
    count = int(cluster.max()) + 1
    sizes = np.bincount(cluster, minlength=count)
    mean = _sums(cluster, surface.vertices, count) / sizes[:, None]
    normal = _normals(surface)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(length, 1e-30)
    weighted = length * normal
    planes = (weighted[:, :, None] * normal[:, None, :]).reshape(-1, 9)
    first = surface.vertices[surface.faces[:, 0]]
    sums = np.zeros((count, 9))
    right = np.zeros((count, 3))
    for corners in cluster[surface.faces].T:
        offset = np.einsum("ij,ij->i", normal, first - mean[corners])
        right += _sums(corners, weighted * offset[:, None], count)
        sums += _sums(corners, planes, count)
    matrix = sums.reshape(-1, 3, 3)
    # The mean pulls weakly where the planes leave a direction free.
    matrix += (1e-2 * np.trace(matrix, axis1=1, axis2=2) + 1e-30)[:, None, None] * np.eye(3)
    return mean + np.clip(np.linalg.solve(matrix, right[:, :, None])[:, :, 0], -cell, cell)


def _sums(groups: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Sums of rows [N, K] over each of ``count`` groups, of which each row has one [N]."""
    numbers = np.arange(len(groups))
    members = csr_matrix((np.ones(len(groups)), (groups, numbers)), (count, len(groups)))
    return np.asarray(members @ rows)
