"""Procedural sets: deterministic, valid, different, and without a rotational symmetry."""

from collections.abc import Sequence

import networkx as nx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from vd.assets_usd.objects import procedural
from vd.assets_usd.objects.geometry import Hull, hull_depth, union_depth
from vd.assets_usd.objects.meshes import LONGEST_SIDE_M, MEAN_WIDTH_M, mean_width
from vd.assets_usd.objects.model import ObjectModel

COUNT = 24
"""Four of each of the six kinds."""

MAX_PARTS = 8


@pytest.fixture(scope="module")
def training() -> list[ObjectModel]:
    return procedural.procedural_set(COUNT, 0)


@pytest.fixture(scope="module")
def held_out() -> list[ObjectModel]:
    return procedural.procedural_set(8, 0, families="heldout")


@pytest.fixture(scope="module")
def tools() -> list[ObjectModel]:
    return procedural.procedural_set(18, 0, families="tools")


def test_only_what_has_no_rotational_symmetry_is_for_training(training: list[ObjectModel]):
    """A symmetric solid is told by turning it, and none is drawn.

    A turned copy makes one of any.
    """
    for model in (procedural.cube(), procedural.cuboid()):
        assert procedural.asymmetry(model) < procedural.MIN_ASYMMETRY / 10
    for model in training:
        assert procedural.asymmetry(model) >= procedural.MIN_ASYMMETRY, model.name
    half_turn = np.array([-1.0, -1.0, 1.0])
    parts = [
        Hull(h.vertices * s, h.faces) for h in training[0].hulls for s in (np.ones(3), half_turn)
    ]
    assert (
        procedural.asymmetry(procedural.model_of_parts("twice", parts))
        < procedural.MIN_ASYMMETRY / 4
    )


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


def aspects(models: Sequence[ObjectModel]) -> np.ndarray:
    """Longest by shortest side of each."""
    sides = np.array([np.ptp(model.vertices, axis=0) for model in models])
    return sides.max(axis=1) / sides.min(axis=1)


def test_training_objects_are_round_and_slender_and_tools_more_so(
    training: list[ObjectModel], tools: list[ObjectModel]
):
    assert aspects(training).min() < 2.0
    assert aspects(training).max() > 5.0
    assert aspects(tools).max() > 6.0
    assert np.median(aspects(tools)) > 1.2 * np.median(aspects(training))


def is_connected(hulls: Sequence[Hull]) -> bool:
    """Whether convex parts are one piece: some point of one lies in another."""
    links = nx.Graph()
    links.add_nodes_from(range(len(hulls)))
    for i, part in enumerate(hulls):
        low = part.vertices.min(axis=0)
        grid = low + np.ptp(part.vertices, axis=0) * qmc.Sobol(3, rng=0).random(2**13)
        points = np.concatenate([part.vertices, grid[hull_depth(part, grid) <= 0.0]])
        for j, other in enumerate(hulls):
            if hull_depth(other, points).min() <= 1e-6:
                links.add_edge(i, j)
    return nx.is_connected(links)


def test_every_object_is_valid(
    training: list[ObjectModel], held_out: list[ObjectModel], tools: list[ObjectModel]
):
    for model in training + held_out + tools:
        assert 1 < len(model.hulls) <= MAX_PARTS, model.name
        assert LONGEST_SIDE_M[0] - 1e-6 <= model.longest_side <= LONGEST_SIDE_M[1] + 1e-6, (
            model.name
        )
        # It fits the hand, neither wedged between the fingers nor too flat to get hold of.
        everything = np.concatenate([hull.vertices for hull in model.hulls])
        assert mean_width(everything) <= MEAN_WIDTH_M + 1e-6, model.name
        assert np.ptp(everything, axis=0).min() >= procedural.THINNEST_M - 1e-6, model.name
        assert is_connected(model.hulls), model.name
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
