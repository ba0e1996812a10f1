import numpy as np
import trimesh
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, launch, pose_matrix
from scipy.spatial.transform import Rotation

from vd.kernels.sensor.registration import (
    DAMPING,
    LARGEST_TURN,
    LEVER_M,
    NEVER,
    fit_poses_kernel,
    keep_poses_kernel,
    nearness_kernel,
    place_poses_kernel,
)
from vd.kernels.sensor.shape_grids import off_mesh_kernel, shape_distance_kernel

GRID, SAMPLES, SEEN = 5, 9, 7
FAR, CELL, MARGIN = 0.02, 8.0, 0.004
CELLS = (6, 9)
seeds = st.integers(0, 2**31 - 1)
"""Scenes come from generators: numbers that hypothesis likes lie on borders, where rounding
decides.
"""


class Scene:
    """Random shapes, points and poses of some worlds, as NumPy arrays."""

    def __init__(self, seed: int):
        rng = self.rng = np.random.default_rng(seed)
        self.worlds, self.shapes, self.poses = (
            rng.integers(1, 4),
            rng.integers(1, 3),
            rng.integers(1, 5),
        )
        self.samples = rng.uniform(-0.05, 0.05, (self.shapes, SAMPLES, 3))
        self.half = rng.uniform(0.05, 0.08, self.shapes)
        self.world_shape = rng.integers(0, self.shapes, self.worlds)
        self.world_scale = rng.uniform(0.8, 1.2, self.worlds)
        axis = np.linspace(-1.0, 1.0, GRID)
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        places = self.half[:, None, None, None, None] * grid
        apart = places[..., None, :] - self.samples[:, None, None, None]
        self.from_samples = np.linalg.norm(apart, axis=-1).min(axis=-1)
        # Negative inside, as of a mesh.
        self.places, self.distance = (
            places,
            self.from_samples - 0.02,
        )
        self.seen = rng.uniform(-0.1, 0.1, (self.worlds, SEEN, 3))
        self.count = rng.integers(0, SEEN + 1, self.worlds)
        self.row_world = rng.permutation(self.worlds)[: rng.integers(1, self.worlds + 1)]
        self.pose = self.random_poses(len(self.row_world), self.poses)
        self.eye = np.concatenate([[0.0, 0.0, -0.6], Rotation.random(rng=rng).as_quat() * 0.02])
        self.eye[6] += 1.0
        self.eye[3:] /= np.linalg.norm(self.eye[3:])
        depth, shown = (
            rng.uniform(0.55, 0.65, (self.worlds, *CELLS)),
            rng.random((self.worlds, *CELLS)) < 0.7,
        )
        self.nearness = shown / depth

    def random_poses(self, *shape: int) -> np.ndarray:
        """Poses of that shape."""
        turns = Rotation.random(int(np.prod(shape)), rng=self.rng).as_quat().reshape(*shape, 4)
        return np.concatenate([self.rng.uniform(-0.03, 0.03, (*shape, 3)), turns], axis=-1)

    def model(self) -> dict[str, np.ndarray]:
        """The shapes as the kernels take them."""
        names = ("samples", "distance", "half", "world_shape", "world_scale")
        return {name: getattr(self, name) for name in names}

    def camera(self) -> dict[str, object]:
        """The camera likewise."""
        lens = {"focal": wp.vec2(250.0, 250.0), "centre": wp.vec2(36.0, 24.0), "cell": CELL}
        return lens | {"pose": wp.transform(*self.eye.tolist()), "margin": MARGIN}

    def surface_distance(self, shape: int, place: np.ndarray) -> tuple[float, np.ndarray]:
        """Interpolated distance and its gradient, from the eight corners' weights."""
        half = self.half[shape]
        spacing = 2.0 * half / (GRID - 1)
        inside = np.clip((place + half) / spacing, 0.0, GRID - 1 - 1e-3)
        beyond = place - (inside * spacing - half)
        low = np.floor(inside).astype(int)
        share = inside - low
        value, gradient = 0.0, np.zeros(3)
        for corner in np.ndindex(2, 2, 2):
            factors = np.where(corner, share, 1.0 - share)
            at = self.distance[(shape, *(low + corner))]
            value += at * factors.prod()
            for axis in range(3):
                slope = (1.0 if corner[axis] else -1.0) / spacing
                gradient[axis] += at * slope * np.delete(factors, axis).prod()
        far = np.linalg.norm(beyond)
        if far > 2e-3 * spacing:
            return value + far, beyond / far
        return value, gradient

    def pixel(self, place: np.ndarray) -> tuple[int, int, float]:
        """Row and column of the cell that shows a point, and its depth."""
        x, y, z = Rotation.from_quat(self.eye[3:]).inv().apply(place - self.eye[:3])
        return (
            int(np.floor((250.0 * y / z + 24.0) / CELL)),
            int(np.floor((250.0 * x / z + 36.0) / CELL)),
            z,
        )

    def placed(self, world: int, turn: Rotation, every: int, *, rendered: bool) -> np.ndarray:
        """Where the near side of the shape in this rotation comes to the points."""
        points = self.seen[world, : self.count[world]]
        middle = points.mean(axis=0) if len(points) else np.zeros(3)
        near = self.samples[self.world_shape[world], ::every]
        if rendered:
            depth = turn.apply(near) @ (middle - self.eye[:3])
            near = near[depth <= depth.mean()]
        return middle - self.world_scale[world] * turn.apply(near.mean(axis=0))

    def improved(self, world: int, pose: np.ndarray, every: int) -> np.ndarray:
        """One step by the whole system of six equations."""
        shape, scale = self.world_shape[world], self.world_scale[world]
        turn = Rotation.from_quat(pose[3:])
        rows, rest, weights = [], [], []
        for point in self.seen[world, : self.count[world] : every]:
            arm = point - pose[:3]
            distance, gradient = self.surface_distance(shape, turn.inv().apply(arm) / scale)
            normal = turn.apply(gradient)
            rows.append(np.concatenate([normal, np.cross(arm, normal) / LEVER_M]))
            rest.append(scale * distance)
            weights.append(FAR**2 / (FAR**2 + rest[-1] ** 2))
        if not rows:
            return pose
        jacobian, weight = np.array(rows), np.array(weights)
        curvature = (weight[:, None] * jacobian).T @ jacobian + DAMPING * len(rows) * np.eye(6)
        step = np.linalg.solve(curvature, (weight[:, None] * jacobian).T @ np.array(rest))
        vector = step[3:] / LEVER_M
        vector *= min(1.0, LARGEST_TURN / max(np.linalg.norm(vector), 1e-12))
        return np.concatenate(
            [pose[:3] + step[:3], (Rotation.from_rotvec(vector) * turn).as_quat()]
        )

    def misfit(
        self, world: int, pose: np.ndarray, every: int, every_sample: int, *, rendered: bool
    ) -> float:
        """Mean squares of distances and of what stands out."""
        shape, scale = self.world_shape[world], self.world_scale[world]
        turn = Rotation.from_quat(pose[3:])
        points = self.seen[world, : self.count[world] : every]
        places = [turn.inv().apply(point - pose[:3]) / scale for point in points]
        off = [
            min(abs(scale * self.surface_distance(shape, place)[0]), FAR) ** 2 for place in places
        ]
        total = float(np.mean(off)) if off else 0.0
        if rendered:
            out = []
            for sample in self.samples[shape, ::every_sample]:
                row, column, depth = self.pixel(turn.apply(scale * sample) + pose[:3])
                length = 0.0
                if 0 <= row < CELLS[0] and 0 <= column < CELLS[1]:
                    near = self.nearness[world, row, column]
                    length = np.clip(1.0 / near - MARGIN - depth, 0.0, FAR) if near else FAR
                out.append(length**2)
            total += float(np.mean(out))
        return total


def box_distance(extent: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Signed distance from the surface of a box about the origin, of half these sides."""
    beyond = np.abs(place) - extent
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)


@given(seed=seeds)
@EXAMPLES
def test_distances_are_those_to_the_mesh_or_to_the_nearest_sample(device, seed):
    scene = Scene(seed)
    extents, meshed = (
        scene.rng.uniform(0.01, 0.06, (scene.shapes, 3)),
        scene.rng.integers(0, 2, scene.shapes),
    )
    boxes = [trimesh.creation.box(2.0 * extent) for extent in extents]
    meshes = [
        wp.Mesh(
            device_array(box.vertices, wp.vec3, device),
            device_array(box.faces.ravel(), wp.int32, device),
            support_winding_number=True,
        )
        for box in boxes
    ]
    mesh, shape = np.array([each.id for each in meshes]), scene.samples.shape[:2]
    (off,) = launch(off_mesh_kernel, shape, [scene.samples, mesh], device, shape)
    inputs, shape = [scene.samples, mesh, scene.half, meshed], scene.distance.shape
    (out,) = launch(shape_distance_kernel, shape, inputs, device, shape)
    for shape, extent in enumerate(extents):
        wanted = np.abs(box_distance(extent, scene.samples[shape]))
        np.testing.assert_allclose(off[shape], wanted, atol=1e-6)
        signed = box_distance(extent, scene.places[shape])
        expected = signed if meshed[shape] else scene.from_samples[shape]
        np.testing.assert_allclose(out[shape], expected, atol=1e-6)


@given(seed=seeds)
@EXAMPLES
def test_the_nearest_of_each_cell_is_kept(device, seed):
    scene = Scene(seed)
    points = scene.rng.uniform(-0.15, 0.15, (scene.worlds, 40, 3))
    points[:, ::5] = np.nan
    points[:, 3] = [0.0, 0.0, -2.0]  # behind the camera
    expected = np.zeros((scene.worlds, *CELLS))
    for world, cloud in enumerate(points):
        for point in cloud[np.isfinite(cloud[:, 0])]:
            row, column, depth = scene.pixel(point)
            if depth > 0.0 and 0 <= row < CELLS[0] and 0 <= column < CELLS[1]:
                expected[world, row, column] = max(expected[world, row, column], 1.0 / depth)
    nearness = wp.zeros((scene.worlds, *CELLS), dtype=float, device=device)
    launch(nearness_kernel, points.shape[:2], [scene.camera(), points, nearness], device)
    np.testing.assert_allclose(nearness.numpy(), expected, rtol=1e-5)


@given(seed=seeds, rendered=st.booleans(), every=st.integers(1, 3))
@EXAMPLES
def test_the_near_side_is_put_where_the_points_are(device, seed, rendered, every):
    scene = Scene(seed)
    shape = (len(scene.row_world), scene.poses)
    misfit = np.where(scene.rng.random(shape) < 0.3, NEVER, 0.0)
    inputs = [scene.model(), scene.camera(), int(rendered), every, scene.row_world]
    inputs += [scene.pose[..., 3:], misfit, scene.seen, scene.count]
    (out,) = launch(place_poses_kernel, shape, inputs, device, shape)
    assert np.isnan(out[misfit > 0.0]).all()
    for row, c in np.argwhere(misfit == 0.0):
        turn = Rotation.from_quat(scene.pose[row, c, 3:])
        place = scene.placed(scene.row_world[row], turn, every, rendered=rendered)
        np.testing.assert_allclose(out[row, c, :3], place, atol=1e-5)
        np.testing.assert_allclose(out[row, c, 3:], scene.pose[row, c, 3:], atol=1e-6)


@given(
    seed=seeds,
    rendered=st.booleans(),
    steps=st.integers(0, 1),
    every=st.integers(1, 2),
    every_sample=st.integers(1, 3),
)
@EXAMPLES
def test_a_step_solves_the_normal_equations(device, seed, rendered, steps, every, every_sample):
    scene = Scene(seed)
    pose = device_array(scene.pose, wp.transform, device)
    inputs = [scene.model(), scene.camera(), FAR, steps, every, every_sample]
    inputs += [scene.row_world, scene.seen, scene.count]
    inputs += [scene.nearness if rendered else np.zeros((scene.worlds, 0, 0)), pose]
    (misfit,) = launch(fit_poses_kernel, pose.shape, inputs, device, pose.shape)
    found = pose.numpy().astype(float)
    for row, world in enumerate(scene.row_world):
        for c in range(scene.poses):
            expected = scene.pose[row, c]
            for _ in range(steps):
                expected = scene.improved(world, expected, every)
            matrices = pose_matrix(np.stack([found[row, c], expected]))
            np.testing.assert_allclose(matrices[0], matrices[1], atol=2e-3)
            # At the kernel's own pose: rounding of a step must not choose another cell.
            wanted = scene.misfit(world, found[row, c], every, every_sample, rendered=rendered)
            np.testing.assert_allclose(misfit[row, c], wanted, atol=2e-6)


@given(seed=seeds, known=st.booleans())
@EXAMPLES
def test_the_best_poses_that_differ_are_kept(device, seed, known):
    scene = Scene(seed)
    apart, stay, share, kept = 0.8, 0.7, 0.25, 3
    rows, candidates = len(scene.row_world), 8
    found = scene.random_poses(rows, candidates)
    found[:, 5] = found[:, 1]  # one twice
    misfit = scene.rng.uniform(0.1, 1.0, (rows, candidates))
    pose, average = (
        scene.random_poses(scene.worlds, kept),
        scene.rng.uniform(0.1, 1.0, (scene.worlds, kept)),
    )
    average[:, 2] = NEVER
    expected_pose, expected = pose.copy(), average.copy()
    for row, world in enumerate(scene.row_world):
        cost = misfit[row].copy()
        if known:
            cost[:kept] = average[world] + share * (cost[:kept] - average[world])
            cost[2] = NEVER
        left = list(range(candidates))
        turns = Rotation.from_quat(found[row, :, 3:])
        for k in range(kept):
            if not left:
                expected[world, k:] = NEVER
                expected_pose[world, k:] = np.nan
                break
            best = min(left, key=lambda c, cost=cost: cost[c] * (stay if known and c == 0 else 1.0))
            expected_pose[world, k], expected[world, k] = found[row, best], cost[best]
            angle = (turns * turns[best].inv()).magnitude()
            left = [c for c in left if c != best and angle[c] >= apart and cost[c] < NEVER]
    arrays = [device_array(pose, wp.transform, device), device_array(average, float, device)]
    inputs = [apart, stay, share, kept if known else 0, scene.row_world, found, misfit]
    launch(keep_poses_kernel, rows, [*inputs, *arrays], device)
    np.testing.assert_allclose(arrays[1].numpy(), np.minimum(expected, NEVER), rtol=1e-5)
    there = np.isfinite(expected_pose)
    np.testing.assert_allclose(arrays[0].numpy()[there], expected_pose[there], atol=1e-6)
