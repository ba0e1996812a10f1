"""The surface behind the points of a scan: noise taken out, what is missing closed.

Lengths in the unit of the points, in their frame.
"""

import numpy as np
import trimesh
import warp as wp
from scipy.spatial import cKDTree
from warp.geometry import IsoSurfaceMarchingCubes

from vd.assets_usd.objects.geometry import Surface, spread
from vd.kernels.sensor.winding import winding_kernel

NEIGHBOURS = 24
"""Samples that make a piece of the surface: a plane is laid through them, which takes noise out."""
CENTRES = 1000
"""Samples at most that the surface is laid through: 5 mm apart on an object of the paper's size."""
WIDTH_NEIGHBOURS = 12
"""What is nearer to a sample than the mean distance of so many neighbours is not told apart.
8 found as many training objects by their scans, and is coarser where points are many and exact."""
LOOSENESS = 3.0
"""How much the surface may miss single samples, for the square of their noise as a share of that
width. Half and twice of it found as many."""
CELLS = 64
"""Cells of the grid along the longest side."""
MARGIN_CELLS = 12
"""Cells that the grid reaches beyond the samples: where nothing was scanned the surface bulges."""


def smooth(points: np.ndarray) -> np.ndarray:
    """Samples of a surface [N, 3], each moved onto the plane through those near it.

    N is at least NEIGHBOURS.
    """
    rows = cKDTree(points).query(points, NEIGHBOURS)[1]
    middle = points[rows].mean(axis=1)
    apart = points[rows] - middle[:, None]
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]
    off = np.einsum("ni,ni->n", points - middle, normal)
    return points - off[:, None] * normal


def surface_of_scan(points: np.ndarray, device: str = "cpu") -> Surface:
    """The closed surface behind noisy points without normals, of which a side may be missing.

    Points are smoothed. Then normals, as long as the pieces of surface that they stand for, are
    those by which all points have a winding number of a half (Lin, Xiao, Shi, Wang 2022, Surface
    Reconstruction from Point Clouds without Normals by Parametrizing the Gauss Formula), and the
    surface is where it is a half elsewhere too. What hangs together with most of it is kept.

    Args:
        points: The points, shape [N, 3], N at least NEIGHBOURS.
        device: Warp device.

    Raises:
        ValueError: They enclose nothing.
    """
    scanned = np.asarray(points, dtype=np.float64)
    points = smooth(scanned)
    noise = float(np.sqrt(np.square(points - scanned).sum(axis=1).mean()))
    if len(points) > CENTRES:
        points = points[spread(points, CENTRES)]
    width = float(cKDTree(points).query(points, WIDTH_NEIGHBOURS + 1)[0][:, 1:].mean())
    if not width > 0.0:
        raise ValueError("the points enclose nothing")
    away = points[None] - points[:, None]
    distance = np.maximum(np.linalg.norm(away, axis=2), width)
    share = (away / (4.0 * np.pi * distance**3)[..., None]).reshape(len(points), -1)
    # The least areas that do it (an underdetermined system), not quite where there is noise.
    weights = share @ share.T
    weights[np.diag_indices(len(weights))] *= 1.0 + LOOSENESS * (noise / width) ** 2
    areas = share.T @ np.linalg.solve(weights, np.full(len(points), 0.5))
    level = float(np.median(share @ areas))

    low = points.min(axis=0)
    high = points.max(axis=0)
    pitch = float((high - low).max()) / CELLS
    corner = low - MARGIN_CELLS * pitch
    x, y, z = (np.ceil((high - low) / pitch).astype(int) + 1 + 2 * MARGIN_CELLS).tolist()
    # The outermost stay zero, which closes it.
    winding = wp.zeros((x, y, z), dtype=float, device=device)
    inner = winding[1 : x - 1, 1 : y - 1, 1 : z - 1]
    wp.launch(
        winding_kernel,
        dim=inner.shape,
        inputs=[
            wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(areas.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device),
            width,
            wp.vec3(*(corner + pitch).tolist()),
            pitch,
        ],
        outputs=[inner],
        device=device,
    )
    cells, corners = IsoSurfaceMarchingCubes.extract(winding, level)
    mesh = trimesh.Trimesh(
        corner + pitch * cells.numpy(), corners.numpy().reshape(-1, 3), process=False
    )
    piece = max(mesh.split(only_watertight=False), key=lambda part: len(part.faces), default=None)
    volume = 0.0 if piece is None else float(piece.volume)
    if piece is None or abs(volume) < pitch**3:
        raise ValueError("the points enclose nothing")
    faces = np.asarray(piece.faces, dtype=np.int32)
    return Surface(np.asarray(piece.vertices), faces if volume > 0.0 else faces[:, ::-1])
