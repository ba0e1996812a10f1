"""Clouds of the hand against homogeneous matrices."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, floats, indices, launch, pose_matrix, transforms

from vd.kernels.sensor.kinematics import link_points_kernel


@st.composite
def scenes(draw):
    """Samples of a hand, the link of each, the base among the links, and the poses that carry them."""
    rows, bodies, hand = draw(st.integers(1, 4)), draw(st.integers(2, 4)), draw(st.integers(1, 6))
    return {
        "points": draw(floats((hand, 3), -0.1, 0.1)),
        "body": draw(indices(hand, bodies)),
        "base": draw(st.integers(0, bodies - 1)),
        "body_q": draw(transforms((rows, bodies))),
    }


def expected_points(scene):
    """Every sample in the base frame by homogeneous matrices, row by row."""
    samples = np.append(scene["points"].astype(float), np.ones((len(scene["points"]), 1)), axis=1)
    clouds = []
    for poses in pose_matrix(scene["body_q"]):
        to_base = np.linalg.inv(poses[scene["base"]])
        clouds.append(
            [(to_base @ poses[b] @ p)[:3] for b, p in zip(scene["body"], samples, strict=True)]
        )
    return np.array(clouds)


@EXAMPLES
@given(scene=scenes())
def test_points_match_homogeneous_matrices(device, scene):
    inputs = [scene["points"], scene["body"], scene["base"], scene["body_q"]]
    shape = len(scene["body_q"]), len(scene["points"])
    (points,) = launch(link_points_kernel, shape, inputs, device, shape)
    np.testing.assert_allclose(points, expected_points(scene), atol=1e-6)
