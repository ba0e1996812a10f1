import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import ALPHA, EXAMPLES, device_array, floats, launch, streams
from scipy import stats

from vd.kernels.task.actions import (
    apply_action_kernel,
    joint_effort_kernel,
    limit_joint_velocity_kernel,
)
from vd.paper import PAPER

EXTRA = 7
"""Columns of Newton's arrays beyond the hand's: the object's."""

STEP_RAD = PAPER.action.scale_rad_s / PAPER.scene.control_hz


def apply_action(
    device, action, offset, q, smoothed, lower, upper, *, noise_std=0.0, seed=0, alpha=0.8
):
    """One launch: smoothed action, targets (with the EXTRA columns), streams, refused actions."""
    worlds = len(action)
    average, rng = device_array(smoothed, float, device), streams(worlds, seed, device)
    refused = device_array(np.zeros(worlds), int, device)
    params = {"alpha": alpha, "step_rad": STEP_RAD, "noise_std": noise_std}
    wide = np.pad(q, ((0, 0), (0, EXTRA)), constant_values=np.nan)
    inputs = [lower, upper, params, action, offset, wide, average, rng, refused]
    (target,) = launch(apply_action_kernel, worlds, inputs, device, wide.shape)
    return average.numpy(), target, rng.numpy(), refused.numpy()


@EXAMPLES
@given(
    data=st.data(),
    fingers=st.sampled_from([3, 4]),
    worlds=st.integers(1, 3),
    alpha=st.sampled_from([0.8, 1.0, 0.25]),
)
def test_targets_match_the_paper(device, data, fingers, worlds, alpha):
    shape = (worlds, 3 * fingers)
    action, offset = data.draw(floats(shape)), data.draw(floats(shape, -0.1, 0.1))
    q, smoothed = data.draw(floats(shape)), data.draw(floats(shape, -1.0, 1.0))
    lower, upper = data.draw(floats(shape[1:], -2.0, -0.4)), data.draw(floats(shape[1:], 0.4, 2.0))
    average, target, _, refused = apply_action(
        device, action, offset, q, smoothed, lower, upper, alpha=alpha
    )
    expected = alpha * np.clip(action + offset, -1, 1) + (1 - alpha) * smoothed
    np.testing.assert_allclose(average, expected, atol=1e-6)
    joints = shape[1]
    np.testing.assert_allclose(
        target[:, :joints], np.clip(q + expected * STEP_RAD, lower, upper), atol=1e-6
    )
    assert not refused.any()
    assert np.isnan(target[:, joints:]).all(), "the object's columns are not the kernel's to write"


def test_action_noise_has_the_moments_of_table_s3(device):
    std = PAPER.randomisation.action_noise_std
    zero = np.zeros((20_000, 9))
    limits = np.full(9, 2.0)
    noise, _, rng, _ = apply_action(
        device, zero, zero, zero, zero, -limits, limits, noise_std=std, seed=3, alpha=1.0
    )
    assert noise.mean() == pytest.approx(0.0, abs=5 * std / np.sqrt(noise.size))
    assert noise.std() == pytest.approx(std, rel=0.01)
    assert stats.kstest(np.ravel(noise) / std, stats.norm.cdf).pvalue > ALPHA
    correlation = np.corrcoef(noise.T)
    assert np.abs(correlation - np.eye(9)).max() < 0.05, "joints share noise"
    assert np.abs(np.corrcoef(noise[:-1, 0], noise[1:, 0])[0, 1]) < 0.05, (
        "neighbouring worlds share noise"
    )
    again = apply_action(
        device, zero, zero, zero, zero, -limits, limits, noise_std=std, seed=3, alpha=1.0
    )
    np.testing.assert_array_equal(noise, again[0])
    assert not np.any(rng == streams(len(zero), 3, device).numpy()), "the streams did not advance"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_refused_whole(device, value):
    """A clip would make a limit of it; the other worlds go on."""
    action, q, smoothed = np.full((3, 9), 0.5), np.full((3, 9), 0.1), np.full((3, 9), 0.2)
    action[1, 4] = value
    limits = np.full(9, 2.0)
    average, target, _, refused = apply_action(
        device, action, np.zeros((3, 9)), q, smoothed, -limits, limits, noise_std=0.1
    )
    assert refused.tolist() == [0, 1, 0]
    np.testing.assert_allclose(target[1, :9], 0.1, atol=1e-6)
    np.testing.assert_allclose(average[1], 0.2, atol=1e-6)
    assert (target[[0, 2], :9] > 0.1).all() and (average[[0, 2]] != 0.2).all()


@EXAMPLES
@given(data=st.data(), fingers=st.sampled_from([3, 4]), worlds=st.integers(1, 3))
def test_velocity_limit_shortens_the_step(device, data, fingers, worlds):
    joints, dt = 3 * fingers, 1 / PAPER.scene.physics_hz
    q_prev = data.draw(floats((worlds, joints + EXTRA)))
    qd = data.draw(floats((worlds, joints + EXTRA), -12, 12))
    limit = data.draw(floats((joints,), 1.0, 8.0))
    q = (q_prev + dt * qd).astype(np.float32)
    q_array, qd_array = device_array(q, float, device), device_array(qd, float, device)
    launch(
        limit_joint_velocity_kernel,
        (worlds, joints),
        [limit, dt, q_prev, q_array, qd_array],
        device,
    )
    over = np.zeros(q.shape, bool)
    over[:, :joints] = np.abs(qd[:, :joints]) > limit
    expected_qd = qd.copy()
    expected_qd[:, :joints] = np.clip(qd[:, :joints], -limit, limit)
    np.testing.assert_array_equal(qd_array.numpy(), expected_qd)
    np.testing.assert_array_equal(q_array.numpy()[~over], q[~over])
    np.testing.assert_allclose(q_array.numpy(), q_prev + dt * expected_qd, atol=1e-6)


@EXAMPLES
@given(data=st.data(), fingers=st.sampled_from([3, 4]), worlds=st.integers(1, 3))
def test_effort_is_that_of_a_saturated_pd_servo(device, data, fingers, worlds):
    shape = (worlds, 3 * fingers)
    wide = (worlds, 3 * fingers + EXTRA)
    kp, kd = data.draw(floats(shape, 0, 5)), data.draw(floats(shape, 0, 0.5))
    effort = data.draw(floats(shape[1:], 0.1, 3))
    target, q, qd = (data.draw(floats(wide)) for _ in range(3))
    (out,) = launch(joint_effort_kernel, shape, [effort, kp, kd, target, q, qd], device, shape)
    hand = slice(0, shape[1])
    torque = kp * (target[:, hand].astype(np.float64) - q[:, hand]) - kd * qd[:, hand]
    np.testing.assert_allclose(out, np.clip(torque, -effort, effort), atol=1e-5)
