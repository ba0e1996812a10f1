"""Surfaces behind scanned points: closed, outward, and where the object's is."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from vd.assets_usd.objects.geometry import Surface, mesh_volume, random_surface_points
from vd.assets_usd.objects.scans import surface_of_scan
from vd.assets_usd.objects.sets import load_set
from vd.evaluate.scanned import MISSING, NOISE_M, known_points, scan

RADIUS_M = 0.05


def ball(count, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return RADIUS_M * points / np.linalg.norm(points, axis=1, keepdims=True)


def off(points, surface):
    """Distances of points from a mesh [m], to a millimetre."""
    samples = random_surface_points(surface, 20_000, np.random.default_rng(5))
    return cKDTree(samples).query(points)[0]


@pytest.mark.parametrize(
    "count, noise, within, volume", [(8000, 0.001, 0.0007, 0.04), (600, 0.004, 0.003, 0.15)]
)
def test_a_ball_is_found_behind_noise(device, count, noise, within, volume):
    """Of few samples a round piece as wide as 24 of them is made flat: 2 mm of the radius of 50."""
    points = ball(count) + np.random.default_rng(1).normal(scale=noise, size=(count, 3))
    surface = surface_of_scan(points, device)
    mesh = trimesh.Trimesh(*surface, process=False)
    assert mesh.is_watertight and len(mesh.split()) == 1
    assert abs(np.linalg.norm(surface.vertices, axis=1) - RADIUS_M).mean() < within
    assert mesh_volume(*surface) == pytest.approx(4 / 3 * np.pi * RADIUS_M**3, rel=volume), (
        "faces look out"
    )


def test_what_is_missing_is_closed():
    points = ball(8000)
    surface = surface_of_scan(points[points[:, 2] > -0.6 * RADIUS_M])
    assert trimesh.Trimesh(*surface, process=False).is_watertight
    # No farther in than a lid on the hole, no farther out than the ball goes, by a cell or two.
    lowest = surface.vertices[:, 2].min()
    assert -1.1 * RADIUS_M < lowest < -0.55 * RADIUS_M
    seen = surface.vertices[surface.vertices[:, 2] > -0.5 * RADIUS_M]
    assert abs(np.linalg.norm(seen, axis=1) - RADIUS_M).max() < 0.003


def test_points_that_enclose_nothing_are_refused():
    with pytest.raises(ValueError, match="enclose nothing"):
        surface_of_scan(np.full((300, 3), 0.02))


def test_the_surface_behind_a_scan_is_that_of_the_object(device):
    """Where the scanner has been: nearer than the noise (4 mm along each axis) at most points."""
    for i, item in enumerate(load_set("procedural-24-seed0")[:21:20]):
        surface = surface_of_scan(scan(item.surface_points, np.random.default_rng(i)), device)
        away = off(surface.vertices, Surface(item.vertices, item.faces))
        assert np.median(away) < 0.003


def test_a_scan_is_noisy_and_misses_one_side():
    rng, whole = np.random.default_rng(0), ball(4000)
    scanned = scan(whole, rng)
    assert scanned.shape == whole.shape
    assert scan(whole.astype(np.float32), rng).dtype == np.float32, (
        "of the kind that the search for it takes"
    )
    first = np.abs(scanned[:100].mean(axis=0) - scanned.mean(axis=0))
    assert first.max() < 0.3 * RADIUS_M, (
        "in no order: a network takes the first points for the whole"
    )
    # Across the surface only one axis of the noise shows.
    off = np.linalg.norm(scanned, axis=1) - RADIUS_M
    assert off.std() == pytest.approx(NOISE_M, rel=0.1)
    side = -scanned.mean(axis=0) / np.linalg.norm(scanned.mean(axis=0))
    # A cap with a fifth of a sphere's area begins at 0.6 of its radius.
    assert (scanned @ side > (0.6 * RADIUS_M + 3 * NOISE_M)).mean() < 0.01
    assert (whole @ side > 0.6 * RADIUS_M).mean() == pytest.approx(MISSING, abs=0.03)


def test_what_is_known_of_objects_is_their_points_or_a_scan():
    (cube,) = cubes = load_set("cube")
    np.testing.assert_array_equal(known_points(cubes, "points", seed=0)[0], cube.surface_points)
    scanned = scan(cube.surface_points, np.random.default_rng(0))
    np.testing.assert_array_equal(known_points(cubes, "scan", seed=0)[0], scanned)
