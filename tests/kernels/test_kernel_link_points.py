import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, floats, indices, launch, pose_matrix, quaternions, transforms

from vd.kernels.sensor.link_points import link_points_kernel

BASE, OBJECT = 0, 1
GOAL_POSITION = np.array([0.1, -0.2, -0.08])


@st.composite
def scenes(draw):
    """Samples of hand and objects, and the poses that carry them."""
    worlds, rows = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    bodies, hand = draw(st.integers(2, 4)), draw(st.integers(1, 6))
    objects, samples = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    return {
        "hand": draw(floats((hand, 3), -0.1, 0.1)),
        "body": draw(indices(hand, bodies)),
        "samples": draw(floats((objects, samples, 3), -0.05, 0.05)),
        "shown": draw(floats((objects, samples, 3), -0.05, 0.05)),
        "world_object": draw(indices(worlds, objects)),
        "world_scale": draw(floats((worlds,), 0.9, 1.1)),
        "world": draw(indices(rows, worlds)),
        "body_q": draw(transforms((rows, bodies))),
        "goal": draw(quaternions((rows,))),
    }


def expected_points(scene):
    """Goal, hand, object in the base frame by homogeneous matrices, row by row."""
    clouds = []
    for row, poses in enumerate(pose_matrix(scene["body_q"])):
        world = scene["world"][row]
        to_base = np.linalg.inv(poses[BASE])

        def carry(matrix, points, to_base=to_base):
            return (to_base @ matrix @ np.append(points, np.ones((len(points), 1)), axis=1).T).T[:, :3]

        hand = [
            carry(poses[b], p[None])[0]
            for b, p in zip(scene["body"], scene["hand"].astype(float), strict=True)
        ]
        item, shown = (
            scene[name][scene["world_object"][world]].astype(float) * scene["world_scale"][world]
            for name in ("samples", "shown")
        )
        turn = pose_matrix(np.append(np.zeros(3), scene["goal"][row]))[:3, :3]
        goal = (to_base[:3, :3] @ turn @ shown.T).T + GOAL_POSITION
        clouds.append(np.concatenate([goal, hand, carry(poses[OBJECT], item)]))
    return np.array(clouds)


@EXAMPLES
@given(scene=scenes(), with_object=st.booleans(), spare=st.sampled_from([0, 3]))
def test_points_match_homogeneous_matrices(device, scene, with_object, spare):
    """A goal is shown by samples of its own; a shorter launch leaves out the object, and room for more."""
    model = {
        "hand_points": scene["hand"],
        "hand_body": scene["body"],
        "object_points": scene["samples"],
        "goal_points": scene["shown"],
        "world_object": scene["world_object"],
        "world_scale": scene["world_scale"],
        "base_body": BASE,
        "object_body": OBJECT,
        "goal_position": wp.vec3(*GOAL_POSITION),
    }
    samples, rows = scene["samples"].shape[1], len(scene["goal"])
    columns = len(scene["hand"]) + samples * (2 if with_object else 1)
    inputs = [model, scene["world"], scene["body_q"], scene["goal"]]
    (points,) = launch(link_points_kernel, (rows, columns), inputs, device, (rows, columns + spare))
    np.testing.assert_allclose(points[:, :columns], expected_points(scene)[:, :columns], atol=1e-6)
    assert np.isnan(points[:, columns:]).all()
