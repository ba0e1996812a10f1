"""Procedural sets: deterministic, valid, different, and without a rotational symmetry."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects import procedural
from vd.assets_usd.objects.geometry import hull_depth, random_surface_points, union_depth
from vd.assets_usd.objects.meshes import LONGEST_SIDE_M, MEAN_WIDTH_M, THINNEST_M, mean_width
from vd.assets_usd.objects.model import ObjectModel
from vd.assets_usd.objects.procedural import HELD_OUT, TRAINING

COUNT = 18
"""Three of each of the six families."""

DENSE = 6000
"""Points of the clouds compared under rotations: 1.5 mm apart."""

LEAST_DISTANCE = 0.004
"""Least mean cloud distance under any rotation, relative to the size, beyond that of two samplings."""


@pytest.fixture(scope="module")
def training() -> list[ObjectModel]:
    return procedural.procedural_set(COUNT, 0)


@pytest.fixture(scope="module")
def held_out() -> list[ObjectModel]:
    return procedural.procedural_set(8, 0, held_out=True)


def cloud(model: ObjectModel, seed: int) -> np.ndarray:
    """Dense points of the outer surface."""
    points = random_surface_points(model.vertices, model.faces, DENSE, np.random.default_rng(seed))
    return points[union_depth(model.hulls, points) > -1e-6]


def rotation_grid(moments: np.ndarray) -> Rotation:
    """Rotations about the axes of inertia that keep the inertia, which any symmetry must, to 15 %."""
    angles = np.radians(np.arange(20, 181, 20.0))
    turns = [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)]
    for axis in range(3):
        a, b = np.delete(moments, axis)
        if abs(a - b) < 0.15 * max(a, b):
            turns += [Rotation.from_rotvec(angle * np.eye(3)[axis]) for angle in angles]
            turns += [Rotation.from_rotvec(2 * np.pi / k * np.eye(3)[axis]) for k in (3, 4, 5)]
    if moments[2] < 1.15 * moments[0]:
        turns += list(Rotation.create_group("O"))[1:]
        turns += list(Rotation.random(300, rng=np.random.default_rng(0)))
    grid = Rotation.concatenate(turns)
    return grid[grid.magnitude() > 0.3]


def cloud_asymmetry(model: ObjectModel) -> float:
    """Least mean distance between the cloud and itself rotated, less that of two samplings."""
    first, second = cloud(model, 1), cloud(model, 2)
    tree = cKDTree(first)
    floor = tree.query(second)[0].mean()
    frame = Rotation.from_quat(model.inertia_quat)
    probes = second[:600]
    least = min(
        tree.query((frame * turn * frame.inv()).apply(probes))[0].mean()
        for turn in rotation_grid(model.inertia)
    )
    return (least - floor) / model.longest_side


def test_no_training_object_is_rotationally_symmetric(training: list[ObjectModel]):
    found = {model.name: cloud_asymmetry(model) for model in training}
    assert min(found.values()) > LEAST_DISTANCE, sorted(found.items(), key=lambda item: item[1])[:5]


def test_the_measure_sees_the_symmetry_of_cube_and_cuboid():
    for model in (procedural.cube(), procedural.cuboid()):
        assert cloud_asymmetry(model) < LEAST_DISTANCE / 4
        assert procedural.asymmetry(model) < procedural.MIN_ASYMMETRY / 10


@pytest.mark.parametrize("model", [procedural.cube(), procedural.cuboid()], ids=lambda m: m.name)
def test_symmetry_groups_map_the_solid_to_itself(model: ObjectModel):
    group = Rotation.from_quat(model.symmetry)
    assert len(model.symmetry) == {"cube": 24, "cuboid": 4}[model.name]
    np.testing.assert_allclose(model.symmetry[0], [0, 0, 0, 1], atol=1e-12)
    points = model.surface_points.astype(float)
    for turn in group:
        assert np.abs(union_depth(model.hulls, turn.apply(points))).max() < 1e-6
    products = {tuple(np.round((a * b).as_matrix().ravel(), 6) + 0.0) for a in group for b in group}
    assert len(products) == len(model.symmetry)


def test_equal_seeds_are_equal_and_others_differ(training: list[ObjectModel]):
    again = procedural.procedural_set(4, 0)
    other = procedural.procedural_set(4, 1)
    for a, b, c in zip(training, again, other, strict=False):
        assert a.name == b.name != c.name
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.surface_points, b.surface_points)
        np.testing.assert_array_equal(a.inertia, b.inertia)
        assert a.inertia.tolist() != c.inertia.tolist()


def test_every_object_is_valid(training: list[ObjectModel], held_out: list[ObjectModel]):
    for model in training + held_out:
        assert 1 < len(model.hulls) <= procedural.MAX_PARTS, model.name
        assert LONGEST_SIDE_M[0] - 1e-6 <= model.longest_side <= LONGEST_SIDE_M[1] + 1e-6, model.name
        # It fits the hand, neither wedged between the fingers nor too flat to get hold of.
        everything = np.concatenate([hull.vertices for hull in model.hulls])
        assert mean_width(everything) <= MEAN_WIDTH_M + 1e-6, model.name
        assert np.ptp(everything, axis=0).min() >= THINNEST_M - 1e-6, model.name
        assert procedural.is_connected(model.hulls), model.name
        for hull in model.hulls:
            assert len(hull.vertices) <= 32
            assert hull_depth(hull, hull.vertices).max() < 1e-6
        # The mesh is the surface of the parts, and the cloud lies on it.
        assert union_depth(model.hulls, model.vertices).max() < 1e-6, model.name
        assert np.abs(union_depth(model.hulls, model.surface_points)).max() < 1e-6, model.name
        # Some point between two surface points is outside: not convex.
        points = model.surface_points[:60]
        middle = (points[:, None] + points[None])[np.triu_indices(60, 1)] / 2
        assert union_depth(model.hulls, middle).max() > 0.01 * model.longest_side, model.name
        # Principal moments of a real solid obey the triangle inequality.
        assert model.inertia[0] > 0 and model.inertia[:2].sum() > model.inertia[2], model.name
        assert np.linalg.norm(model.surface_points.mean(axis=0)) < 0.35 * model.longest_side


def test_training_and_held_out_families_are_disjoint(
    training: list[ObjectModel], held_out: list[ObjectModel]
):
    assert not TRAINING.keys() & HELD_OUT.keys()
    kinds = [kind.__name__ for families in (TRAINING, HELD_OUT) for f in families.values() for kind in f]
    assert len(kinds) == len(set(kinds))
    assert {m.family for m in training} == set(TRAINING)
    assert {m.family for m in held_out} == set(HELD_OUT)
