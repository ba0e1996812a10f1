import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    EXAMPLES,
    floats,
    goals,
    indices,
    launch,
    pose_matrix,
    quaternions,
    transforms,
    unwritten,
)
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vd.kernels.task.shapes import (
    EXTENT_CENTRE_M,
    ORIENTATIONS,
    SHAPE_UNIT_M,
    clearance_kernel,
    extent_directions,
    extent_kernel,
    shape_observation_size,
    shape_observation_slices,
    surface_kernel,
)


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, np.ndarray]:
    """N worlds with one of K clouds each, scaled, and a hand of 3 or 4 fingers."""
    fingers, worlds = draw(st.sampled_from([3, 4])), draw(st.integers(1, 3))
    shapes, count = draw(st.integers(1, 3)), draw(st.integers(1, 12))
    joints, bodies = 3 * fingers, 3 * fingers + 2
    orientation = draw(quaternions((worlds,)))
    return {
        "points": draw(floats((shapes, count, 3), -0.1, 0.1)),
        "object": draw(indices(worlds, shapes)),
        "scale": draw(floats((worlds,), 0.5, 2.0)),
        "tip_body": np.array(draw(st.permutations(range(bodies)))[:fingers]),
        "tip_offset": draw(transforms((fingers,))),
        "q": np.concatenate(
            [draw(floats((worlds, joints))), draw(floats((worlds, 3))), orientation], axis=1
        ),
        "body_q": draw(transforms((worlds, bodies))),
        "goal": draw(goals(orientation)),
    }


def observe(device, scene, *, first=2):
    """Launch both kernels behind ``first`` columns and before one more; returns all columns."""
    worlds, fingers = len(scene["q"]), len(scene["tip_body"])
    out = unwritten((worlds, first + shape_observation_size(fingers) + 1), float, device)
    common = [scene[name] for name in ("points", "object", "scale")]
    column = {name: first + part.start for name, part in shape_observation_slices(fingers).items()}
    inputs = [*common, scene["tip_body"], scene["tip_offset"], 3 * fingers, column["surface"]]
    launch(surface_kernel, (worlds, fingers), [*inputs, scene["q"], scene["body_q"], out], device)
    directions = extent_directions(fingers)
    inputs = [*common, directions, 3 * fingers, column["extent"], scene["q"], scene["goal"], out]
    launch(extent_kernel, (worlds, ORIENTATIONS, len(directions)), inputs, device)
    return out.numpy()


def placed(scene, world, quat):
    """The world's surface points turned by ``quat``, about the object's origin [m], float64."""
    points = scene["points"][scene["object"][world]].astype(np.float64) * float(
        scene["scale"][world]
    )
    return Rotation.from_quat(quat).apply(points)


@EXAMPLES
@given(scene=scenes())
def test_fingertips_are_told_the_nearest_point_of_the_surface(device, scene):
    fingers, first = len(scene["tip_body"]), 2
    out = observe(device, scene, first=first)
    values = out[:, first:][:, shape_observation_slices(fingers)["surface"]].reshape(-1, fingers, 3)
    tips = pose_matrix(scene["body_q"])[:, scene["tip_body"]] @ pose_matrix(scene["tip_offset"])
    for world, vectors in enumerate(values):
        pose = scene["q"][world, 3 * fingers :].astype(np.float64)
        cloud = pose[:3] + placed(scene, world, pose[3:])
        tip = tips[world, :, :3, 3]
        ends = tip + SHAPE_UNIT_M * vectors
        distance, _ = cKDTree(cloud).query(tip)
        # Two points may be equally near: the length is the nearest, and the end is a point of the
        # cloud.
        np.testing.assert_allclose(
            SHAPE_UNIT_M * np.linalg.norm(vectors, axis=1), distance, atol=2e-6
        )
        np.testing.assert_allclose(cKDTree(cloud).query(ends)[0], 0.0, atol=2e-6)


@EXAMPLES
@given(scene=scenes())
def test_extents_are_the_support_function_now_and_at_the_goal(device, scene):
    fingers, first = len(scene["tip_body"]), 2
    out = observe(device, scene, first=first)
    slices = shape_observation_slices(fingers)
    for world in range(len(out)):
        for name, quat in (
            ("extent", scene["q"][world, 3 * fingers + 3 :]),
            ("goal_extent", scene["goal"][world]),
        ):
            support = (placed(scene, world, quat) @ np.array(extent_directions(fingers)).T).max(
                axis=0
            )
            values = EXTENT_CENTRE_M + SHAPE_UNIT_M * out[world, first:][slices[name]]
            np.testing.assert_allclose(values, support, atol=2e-6)


@EXAMPLES
@given(scene=scenes(), table_top=st.sampled_from([0.0, -0.3]))
def test_clearance_is_the_lowest_point_above_the_table(device, scene, table_top):
    worlds, joints = len(scene["q"]), 3 * len(scene["tip_body"])
    inputs = [scene["points"], scene["object"], scene["scale"], joints, table_top, scene["q"]]
    (out,) = launch(clearance_kernel, worlds, inputs, device, worlds)
    for world, q in enumerate(np.asarray(scene["q"], np.float64)):
        cloud = scene["scale"][world] * np.asarray(
            scene["points"][scene["object"][world]], np.float64
        )
        heights = q[joints + 2] + Rotation.from_quat(q[joints + 3 :]).apply(cloud)[:, 2]
        assert out[world] == pytest.approx(heights.min() - table_top, abs=1e-5)
