"""Winding numbers of sampled surfaces, against NumPy sums and what Gauss says of closed ones."""

import numpy as np
import trimesh
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, launch

from vd.kernels.sensor.winding import inside_kernel, winding_kernel

SHAPE = (5, 4, 3)


def winding_numbers(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Generalised winding numbers [n] of a mesh at points [n, 3].

    1 inside, 0 outside of a closed one.

    The solid angles of all triangles over 4 pi (van Oosterom and Strackee 1983).
    """
    total = np.zeros(len(points))
    for i, point in enumerate(np.asarray(points, dtype=np.float64)):
        a, b, c = (np.asarray(vertices, dtype=np.float64)[faces[:, k]] - point for k in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        dots = [np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a))]
        spread = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
        total[i] = np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), spread).sum() / (
            2.0 * np.pi
        )
    return total


def run(device, samples, areas, *, width, corner, pitch, shape=SHAPE):
    """Winding numbers of the kernel, [X, Y, Z]."""
    return launch(
        winding_kernel, shape, [samples, areas, width, wp.vec3(*corner), pitch], device, shape
    )[0]


def grid(corner, pitch, shape=SHAPE):
    """Its points [X, Y, Z, 3]."""
    axes = [c + pitch * np.arange(n) for c, n in zip(corner, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


@EXAMPLES
@given(seed=st.integers(0, 2**31), width=st.floats(0.01, 1.0), pitch=st.floats(0.05, 1.0))
def test_pieces_count_by_their_solid_angles(device, seed, width, pitch):
    rng = np.random.default_rng(seed)
    samples, areas = rng.normal(size=(2, 7, 3))
    corner = rng.normal(size=3)
    found = run(device, samples, areas, width=width, corner=corner, pitch=pitch)
    away = samples - grid(corner, pitch)[..., None, :]
    distance = np.maximum(np.linalg.norm(away, axis=-1), width)
    expected = ((away * areas).sum(axis=-1) / distance**3).sum(axis=-1) / (4 * np.pi)
    largest = (np.linalg.norm(areas, axis=-1) / distance**2).sum(axis=-1)  # before they cancel
    assert (np.abs(found - expected) < 1e-4 * largest).all()


@EXAMPLES
@given(seed=st.integers(0, 2**31), kept=st.floats(0.3, 1.0), level=st.sampled_from([0.2, 0.5, 0.8]))
def test_inside_is_where_the_winding_number_exceeds_the_level(device, seed, kept, level):
    """Of a sphere with holes, at points that are not next to the level."""
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    faces = ball.faces[rng.uniform(size=len(ball.faces)) < kept]
    points = rng.uniform(-0.7, 0.7, (50, 3))
    expected = winding_numbers(ball.vertices, faces, points)
    mesh = wp.Mesh(
        device_array(ball.vertices, wp.vec3, device),
        wp.array(faces.ravel(), dtype=wp.int32, device=device),
        support_winding_number=True,
    )
    out = wp.array(rng.uniform(size=50) < 0.5, dtype=wp.bool, device=device)
    launch(inside_kernel, 50, [mesh.id, level, points, out], device)
    clear = np.abs(expected - level) > 0.03  # far triangles count by clusters
    np.testing.assert_array_equal(out.numpy()[clear], (expected > level)[clear])
