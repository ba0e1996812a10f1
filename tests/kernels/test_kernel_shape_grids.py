"""Distances of points and grids from meshes, and turns of shapes onto themselves."""

import numpy as np
import trimesh
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, launch
from scipy.spatial.transform import Rotation

from vd.kernels.sensor.shape_grids import (
    DAMPING,
    LARGEST_TURN,
    LEVER_M,
    off_mesh_kernel,
    shape_distance_kernel,
    turn_onto_itself_kernel,
)

GRID, POINTS, ROTATIONS = 5, 7, 4
FAR = 0.02
seeds = st.integers(0, 2**31 - 1)
"""Scenes come from generators: numbers that hypothesis likes lie on borders, where rounding
decides.
"""


def box_distance(extent: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Signed distance from the surface of a box about the origin, of half these sides."""
    beyond = np.abs(place) - extent
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)


def grid_places(half: np.ndarray) -> np.ndarray:
    """Points of the grids of so large shapes [O, E, E, E, 3]."""
    axis = np.linspace(-1.0, 1.0, GRID)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return half[:, None, None, None, None] * grid


@given(seed=seeds)
@EXAMPLES
def test_distances_are_those_to_the_mesh(device, seed):
    rng = np.random.default_rng(seed)
    shapes = rng.integers(1, 3)
    extents = rng.uniform(0.01, 0.06, (shapes, 3))
    boxes = [trimesh.creation.box(2.0 * extent) for extent in extents]
    meshes = [
        wp.Mesh(
            device_array(box.vertices, wp.vec3, device),
            device_array(box.faces.ravel(), wp.int32, device),
            support_winding_number=True,
        )
        for box in boxes
    ]
    mesh = np.array([each.id for each in meshes])
    samples = rng.uniform(-0.05, 0.05, (shapes, POINTS, 3))
    (off,) = launch(off_mesh_kernel, (shapes, POINTS), [samples, mesh], device, (shapes, POINTS))
    half = rng.uniform(0.05, 0.08, shapes)
    dim = (shapes, GRID, GRID, GRID)
    (out,) = launch(shape_distance_kernel, dim, [mesh, half], device, dim)
    for shape, extent in enumerate(extents):
        wanted = np.abs(box_distance(extent, samples[shape]))
        np.testing.assert_allclose(off[shape], wanted, atol=1e-6)
        signed = box_distance(extent, grid_places(half)[shape])
        np.testing.assert_allclose(out[shape], signed, atol=1e-6)


def surface_distance(
    distances: np.ndarray, half: float, place: np.ndarray
) -> tuple[float, np.ndarray]:
    """Interpolated distance and its gradient, from the eight corners' weights."""
    spacing = 2.0 * half / (GRID - 1)
    inside = np.clip((place + half) / spacing, 0.0, GRID - 1 - 1e-3)
    beyond = place - (inside * spacing - half)
    low = np.floor(inside).astype(int)
    share = inside - low
    value, gradient = 0.0, np.zeros(3)
    for corner in np.ndindex(2, 2, 2):
        factors = np.where(corner, share, 1.0 - share)
        at = distances[tuple(low + corner)]
        value += at * factors.prod()
        for axis in range(3):
            slope = (1.0 if corner[axis] else -1.0) / spacing
            gradient[axis] += at * slope * np.delete(factors, axis).prod()
    far = np.linalg.norm(beyond)
    if far > 2e-3 * spacing:
        return value + far, beyond / far
    return value, gradient


def improved(
    distances: np.ndarray, half: float, points: np.ndarray, place: np.ndarray, turn: Rotation
) -> tuple[np.ndarray, Rotation]:
    """One step by the whole system of six equations."""
    rows, rest, weights = [], [], []
    for point in points:
        arm = point - place
        distance, gradient = surface_distance(distances, half, turn.inv().apply(arm))
        normal = turn.apply(gradient)
        rows.append(np.concatenate([normal, np.cross(arm, normal) / LEVER_M]))
        rest.append(distance)
        weights.append(FAR**2 / (FAR**2 + distance**2))
    jacobian, weight = np.array(rows), np.array(weights)
    curvature = (weight[:, None] * jacobian).T @ jacobian + DAMPING * len(rows) * np.eye(6)
    step = np.linalg.solve(curvature, (weight[:, None] * jacobian).T @ np.array(rest))
    vector = step[3:] / LEVER_M
    vector *= min(1.0, LARGEST_TURN / max(np.linalg.norm(vector), 1e-12))
    return place + step[:3], Rotation.from_rotvec(vector) * turn


@given(seed=seeds, steps=st.integers(0, 1))
@EXAMPLES
def test_a_step_solves_the_normal_equations(device, seed, steps):
    rng = np.random.default_rng(seed)
    shapes = rng.integers(1, 3)
    half = rng.uniform(0.05, 0.08, shapes)
    samples = rng.uniform(-0.05, 0.05, (shapes, 9, 3))
    apart = grid_places(half)[..., None, :] - samples[:, None, None, None]
    distances = np.linalg.norm(apart, axis=-1).min(axis=-1) - 0.02
    points = rng.uniform(-0.1, 0.1, (shapes, POINTS, 3))
    mean, place = rng.uniform(-0.03, 0.03, (2, shapes, 3))
    begun = Rotation.random(ROTATIONS, rng=rng)
    inputs = [distances, half, points, FAR, steps, mean, place, begun.as_quat()]
    dim = (shapes, ROTATIONS)
    turns, misfits = launch(turn_onto_itself_kernel, dim, inputs, device, dim, dim)
    for shape, row in np.ndindex(*dim):
        turn = begun[row]
        at = place[shape] - turn.apply(mean[shape])
        for _ in range(steps):
            at, turn = improved(distances[shape], half[shape], points[shape], at, turn)
        assert (Rotation.from_quat(turns[shape, row]) * turn.inv()).magnitude() < 4e-3
        places = turn.inv().apply(points[shape] - at)
        off = [surface_distance(distances[shape], half[shape], each)[0] for each in places]
        wanted = np.mean(np.minimum(np.abs(off), FAR) ** 2)
        np.testing.assert_allclose(misfits[shape, row], wanted, atol=4e-6)
