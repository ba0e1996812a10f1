import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    ALPHA,
    EXAMPLES,
    angle_between,
    ball_cdf,
    device_array,
    goals,
    launch,
    quaternions,
    relative_quaternion,
    rotation_angles,
    streams,
    unwritten,
)
from scipy import stats

from vd.kernels.rng import next_stream
from vd.kernels.transforms import (
    random_rotation,
    random_rotation_within,
    rotation_angle,
    rotation_difference,
)

DRAWS = 100_000


@wp.kernel(enable_backward=False)
def difference_kernel(
    q_in: wp.array[wp.quat],
    goal_in: wp.array[wp.quat],
    difference_out: wp.array[wp.quat],
    angle_out: wp.array[float],
):
    i = wp.tid()
    difference = rotation_difference(q_in[i], goal_in[i])
    difference_out[i] = difference
    angle_out[i] = rotation_angle(difference)


@wp.kernel(enable_backward=False)
def random_rotation_kernel(max_angle: float, rng: wp.array[wp.uint32], out: wp.array[wp.quat]):
    """Uniform on SO(3) for a negative ``max_angle``, else within it."""
    world = wp.tid()
    state = rng[world]
    if max_angle < 0.0:
        state, q = random_rotation(state)
        out[world] = q
    else:
        state, q = random_rotation_within(state, max_angle)
        out[world] = q
    rng[world] = next_stream(state, world)


def draw_rotations(max_angle: float, seed: int, device: str, count: int = DRAWS) -> np.ndarray:
    out = unwritten(count, wp.quat, device)
    rng = streams(count, seed, device)
    launch(random_rotation_kernel, count, [max_angle, rng, out], device)
    return out.numpy().astype(np.float64)


@EXAMPLES
@given(data=st.data(), count=st.integers(1, 6))
def test_difference_and_angle_match_scipy(device, data, count):
    q = data.draw(quaternions((count,)))
    goal = data.draw(goals(q))
    difference, angle = unwritten(count, wp.quat, device), unwritten(count, float, device)
    inputs = [device_array(q, wp.quat, device), device_array(goal, wp.quat, device)]
    launch(difference_kernel, count, [*inputs, difference, angle], device)
    np.testing.assert_allclose(difference.numpy(), relative_quaternion(q, goal), atol=1e-6)
    # asin has an infinite slope at 1, so a float32 rounding of the norm costs up to 1e-3 rad at pi
    np.testing.assert_allclose(angle.numpy(), angle_between(q, goal), atol=2e-3)


def test_angle_at_the_ends_and_for_both_signs(device):
    s = np.sqrt(0.5)
    q = [
        [0, 0, 0, 1],
        [0, 0, 0, -1],
        [1, 0, 0, 0],
        [0, -1, 0, 0],
        [s, 0, 0, s],
        [-s, 0, 0, -s],
        [1.0001, 0, 0, 0],
    ]
    difference, angle = unwritten(len(q), wp.quat, device), unwritten(len(q), float, device)
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (len(q), 1))
    inputs = [device_array(q, wp.quat, device), device_array(identity, wp.quat, device)]
    launch(difference_kernel, len(q), [*inputs, difference, angle], device)
    expected = [0.0, 0.0, np.pi, np.pi, np.pi / 2, np.pi / 2, np.pi]
    np.testing.assert_allclose(angle.numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("max_angle", [-1.0, 4.0], ids=["plain", "ball-of-more-than-pi"])
def test_random_rotations_are_uniform_on_so3(device, max_angle):
    q = draw_rotations(max_angle, 1, device)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-6)
    angle = rotation_angles(q)
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.01)
    assert np.mean(angle < 0.4) == pytest.approx(0.0034, abs=0.0008)
    assert stats.kstest(angle, lambda a: ball_cdf(a, np.pi)).pvalue > ALPHA
    # uniform on the 3-sphere up to sign: the projectors q q^T average to a quarter of the identity
    np.testing.assert_allclose(q.T @ q / len(q), np.eye(4) / 4, atol=0.006)


@pytest.mark.parametrize("max_angle", [0.01, 0.4, 1.0, 2.5, np.pi])
def test_rotations_within_an_angle_are_uniform_in_that_ball(device, max_angle):
    q = draw_rotations(max_angle, 2, device)
    angle = rotation_angles(q)
    assert angle.max() <= max_angle * (1 + 1e-5)
    assert stats.kstest(angle, lambda a: ball_cdf(a, max_angle)).pvalue > ALPHA
    axis = q[:, :3] / np.linalg.norm(q[:, :3], axis=1, keepdims=True)
    np.testing.assert_allclose(axis.mean(axis=0), 0.0, atol=0.01)
    np.testing.assert_allclose(axis.T @ axis / len(q), np.eye(3) / 3, atol=0.01)
