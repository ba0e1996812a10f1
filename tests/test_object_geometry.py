"""Hulls, volumes, mass properties and surface samples against closed forms."""

import tracemalloc
from functools import partial

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from trimesh.util import append_faces

from vd.assets_usd.objects import geometry as g
from vd.assets_usd.objects.bodies import solid_by_points
from vd.assets_usd.objects.primitives import box


def box_inertia(sides: np.ndarray, mass: float = 1.0) -> np.ndarray:
    """Inertia of a box about its centre."""
    square = np.asarray(sides) ** 2
    return np.diag(square.sum() - square) * mass / 12.0


def test_solid_of_a_turned_box_is_exact():
    sides, rotation = np.array([0.03, 0.05, 0.11]), Rotation.from_euler("xyz", [0.3, -0.7, 1.1])
    centre = np.array([0.2, -0.1, 0.4])
    hull = box(centre, sides, euler=[0.3, -0.7, 1.1])
    solid = g.solid_of_mesh(hull)
    turn = rotation.as_matrix()
    assert solid.volume == pytest.approx(sides.prod(), rel=1e-12)
    np.testing.assert_allclose(solid.centroid, centre, atol=1e-12)
    np.testing.assert_allclose(
        solid.inertia, turn @ box_inertia(sides, sides.prod()) @ turn.T, rtol=1e-9, atol=1e-15
    )


def test_union_of_overlapping_boxes_counts_the_overlap_once():
    parts = [box((0, 0, 0), (0.1, 0.04, 0.04)), box((0.03, 0, 0), (0.04, 0.04, 0.1))]
    exact = 0.1 * 0.04 * 0.04 + 0.04 * 0.04 * 0.06
    surface = g.Surface(*append_faces(*zip(*parts, strict=True)))
    solid = solid_by_points(surface.vertices, partial(g.inside, surface))
    assert solid.volume == pytest.approx(exact, rel=0.02)
    x = (0.0 * 0.1 * 0.04 * 0.04 + 0.03 * 0.04 * 0.04 * 0.06) / exact
    np.testing.assert_allclose(solid.centroid, [x, 0, 0], atol=5e-4)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(10, 200), st.integers(6, 32))
def test_simplified_hull_is_convex_small_and_keeps_its_volume(seed: int, count: int, limit: int):
    points = np.random.default_rng(seed).normal(size=(count, 3)) * [1.0, 0.5, 0.2]
    full = g.convex_hull(points)
    simple = g.simplify_hull(full, limit)
    assert len(simple.vertices) <= limit
    assert (
        g.hull_depth(simple, simple.vertices).max() < 1e-6 * np.ptp(simple.vertices, axis=0).max()
    )
    assert g.mesh_volume(*simple) == pytest.approx(g.mesh_volume(*full), rel=1e-9)


def test_surface_points_lie_on_the_outer_surface_and_cover_it():
    parts = [box((0, 0, 0), (0.1, 0.04, 0.04)), box((0.03, 0, 0.02), (0.04, 0.02, 0.1))]
    vertices = np.concatenate([p.vertices for p in parts])
    faces = np.concatenate([parts[0].faces, parts[1].faces + len(parts[0].vertices)])
    surface = g.Surface(vertices, faces)
    points = g.surface_points(surface, 500, outside=parts)
    assert points.shape == (500, 3)
    assert np.abs(g.union_depth(parts, points)).max() < 1e-6
    probes = g.random_surface_points(surface, 4000, np.random.default_rng(1))
    probes = probes[g.union_depth(parts, probes) > -1e-9]
    gap = np.linalg.norm(probes[:, None] - points[None], axis=2).min(axis=1).max()
    assert gap < 0.01
    np.testing.assert_array_equal(points, g.surface_points(surface, 500, outside=parts))


def test_coarsened_mesh_keeps_its_box_and_shape():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    vertices, faces = g.cluster_vertices(ball, 3000)
    assert 1500 < len(faces) <= 3000
    np.testing.assert_allclose(np.ptp(vertices, axis=0), np.ptp(ball.vertices, axis=0), rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.05, rtol=0.02)
    same = g.cluster_vertices(ball, len(ball.faces))
    assert same.faces is ball.faces


def test_depths_in_a_hull_of_many_faces_take_little_memory():
    ball = trimesh.creation.icosphere(subdivisions=5)
    hull = g.Hull(ball.vertices, ball.faces)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (4000, 3))
    tracemalloc.start()
    depth = g.hull_depth(hull, points)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 200e6, "4000 points by 20 480 faces are 655 MB"
    np.testing.assert_allclose(depth, np.linalg.norm(points, axis=1) - 1.0, atol=2e-3)


def test_a_closed_surface_is_closed_when_it_is_coarser():
    ring = trimesh.creation.torus(0.05, 0.02, major_sections=160, minor_sections=80)
    noise = np.random.default_rng(0).normal(0.0, 3e-4, ring.vertices.shape)
    noisy = g.Surface(ring.vertices + noise, ring.faces)
    vertices, faces = g.cluster_vertices(noisy, 8000, closed=True)
    assert 6000 < len(faces) <= 8000
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = np.unique(edges, axis=0, return_counts=True)
    back = np.unique(edges[:, ::-1], axis=0, return_counts=True)
    np.testing.assert_array_equal(there[0], back[0])
    np.testing.assert_array_equal(there[1], back[1])
    assert g.mesh_volume(vertices, faces) == pytest.approx(ring.volume, rel=0.03)


def test_distances_from_a_mesh_are_those_from_its_faces():
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    points = np.array([[0.0, 0.0, 0.08], [0.08, 0.09, 0.0], [0.01, 0.0, 0.0]])
    off = g.distances(cube, points)
    np.testing.assert_allclose(off, [0.03, 0.05, 0.04], atol=1e-6)
