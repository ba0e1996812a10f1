import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, floats, indices, launch, quaternions, transforms
from scipy.spatial.transform import Rotation

from vd.kernels.task.starts import (
    APART_M,
    CHUNKS,
    IN_TABLE_M,
    move_start_kernel,
    start_depth_kernel,
)

TABLE = 0.01


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, np.ndarray]:
    """N worlds with one of K clouds each near a hand of S rounded boxes, and C places."""
    worlds, shapes, count = (
        draw(st.integers(1, 3)),
        draw(st.integers(1, 4)),
        draw(st.integers(1, 20)),
    )
    joints, orientation = 9, draw(quaternions((worlds,)))
    position = draw(floats((worlds, 3), -0.05, 0.15))
    return {
        "pose": draw(transforms((shapes,))) * np.array([0.3] * 3 + [1.0] * 4, np.float32),
        "half": draw(floats((shapes, 3), 0.0, 0.06)),
        "radius": draw(floats((shapes,), 0.0, 0.03)),
        "points": draw(floats((2, count, 3), -0.08, 0.08)),
        "object": draw(indices(worlds, 2)),
        "scale": draw(floats((worlds,), 0.5, 1.5)),
        "places": draw(floats((draw(st.integers(1, 5)), 3), -0.1, 0.1)),
        "q": np.concatenate([draw(floats((worlds, joints))), position, orientation], axis=1),
        "mask": draw(indices(worlds, 2)),
    }


def oracle_depth(scene, world, place):
    """Depth of the deepest sample in the hand grown by APART_M, or in the table, by definition."""
    q = scene["q"][world].astype(float)
    cloud = scene["scale"][world] * scene["points"][scene["object"][world]].astype(float)
    points = q[9:12] + scene["places"][place] + Rotation.from_quat(q[12:]).apply(cloud)
    depths = [0.0, *(TABLE - IN_TABLE_M - points[:, 2])]
    for pose, half, radius in zip(scene["pose"], scene["half"], scene["radius"], strict=True):
        local = np.abs(Rotation.from_quat(pose[3:]).inv().apply(points - pose[:3]))
        outside = np.linalg.norm(local - np.minimum(local, half), axis=1)
        to_face = np.min(half - local, axis=1)
        depths += [*(radius + APART_M + np.where(outside > 0.0, -outside, to_face))]
    return max(depths)


@EXAMPLES
@given(scene=scenes())
def test_an_object_starts_where_it_is_the_least_deep_and_others_stay(device, scene):
    hand = {name: scene[name] for name in ("pose", "half", "radius")}
    hand["reach"] = np.linalg.norm(scene["half"], axis=1) + scene["radius"] + APART_M
    worlds, count = len(scene["q"]), len(scene["places"])
    depth = device_array(np.zeros((worlds, count)), float, device)
    q = device_array(scene["q"], float, device)
    objects = [scene[n] for n in ("points", "object", "scale", "places")]
    inputs = [hand, *objects, TABLE, 9, scene["mask"], q, depth]
    launch(start_depth_kernel, (worlds, count, CHUNKS), inputs, device)
    expected = np.array(
        [
            [m * oracle_depth(scene, w, c) if m else 0.0 for c in range(count)]
            for w, m in enumerate(scene["mask"])
        ]
    )
    found = depth.numpy().copy()
    np.testing.assert_allclose(found, expected, atol=2e-6)
    launch(move_start_kernel, worlds, [scene["places"], 9, scene["mask"], depth, q], device)
    moved = scene["q"].copy()
    for world in np.flatnonzero(scene["mask"]):
        moved[world, 9:12] += scene["places"][found[world].argmin()]
    np.testing.assert_array_equal(q.numpy(), moved)
    assert not depth.numpy().any(), "the next reset begins with none"
