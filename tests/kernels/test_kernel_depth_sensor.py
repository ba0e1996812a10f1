"""The stereo sensor's errors.

Exact where they are exact, by their statistics where they are random.
"""

import numpy as np
import pytest
import warp as wp
from hypothesis import assume, given
from hypothesis import strategies as st
from kernel_oracle import (
    ALPHA,
    EXAMPLES,
    floats,
    launch,
    quaternions,
    streams,
    unwritten,
)
from scipy import stats
from scipy.spatial.transform import Rotation, Slerp

from vd.kernels.sensor.depth_sensor import delay_poses_kernel, measure_depth_kernel
from vd.sensors.cfg import BASELINE_M, FOCAL_PX

FB = FOCAL_PX * BASELINE_M
MAX_RANGE = 1.5
OFF = {
    "depth_disparity": FB,
    "disparity_std": 0.0,
    "disparity_step": 0.0,
    "shadow": 0.0,
    "edge_jump": 0.0,
    "edge_dropout": 0.0,
    "flying": 0.0,
    "dropout": 0.0,
    "min_range": 0.0,
    "max_range": MAX_RANGE,
}


def measure(device, depth, *, seed=0, **effects):
    """Measured images of true images [N, H, W], the same sensor in every world."""
    depth = np.asarray(depth, np.float32)
    worlds = len(depth)
    inputs = [[OFF | effects] * worlds, depth, streams(worlds, seed, device)]
    return launch(measure_depth_kernel, depth.shape, inputs, device, depth.shape)[0]


@st.composite
def images(draw):
    """Images of one or two worlds, some pixels without depth."""
    shape = (draw(st.integers(1, 2)), draw(st.integers(1, 6)), draw(st.integers(1, 9)))
    depth = draw(floats(shape, 0.2, MAX_RANGE))
    return np.where(draw(floats(shape, 0.0, 1.0)) < 0.2, np.float32(0.0), depth)


@EXAMPLES
@given(depth=images(), step=st.floats(1 / 64, 1.0))
def test_disparity_is_rounded_to_the_nearest_step(device, depth, step):
    measured = measure(device, depth, disparity_step=step, max_range=10.0)
    assert ((measured == 0) == (depth == 0)).all()
    seen = depth > 0
    true, rounded = FB / depth[seen], FB / measured[seen]
    slack = 1e-6 * true.max(initial=1.0)
    np.testing.assert_allclose(rounded / step, np.round(rounded / step), atol=slack / step)
    assert (np.abs(rounded - true) <= 0.5 * step + slack).all()


@EXAMPLES
@given(depth=images(), near=st.floats(0.2, 1.4))
def test_below_and_above_the_range_there_is_nothing(device, depth, near):
    far = 0.5 * (near + MAX_RANGE)
    measured = measure(device, depth, min_range=near, max_range=far)
    clear = np.minimum(np.abs(depth - near), np.abs(depth - far)) > 1e-5
    inside = (depth >= near) & (depth <= far)
    np.testing.assert_allclose(measured[clear & inside], depth[clear & inside], rtol=3e-7)
    assert not measured[clear & ~inside].any()


@pytest.mark.parametrize("distance", [0.3, 0.6, 1.2])
def test_noise_is_normal_in_disparity_and_grows_with_the_square_of_depth(device, distance):
    std = 0.1
    depth = np.full((2, 90, 160), distance)
    measured = measure(device, depth, disparity_std=std, max_range=10.0)
    error = (FB / measured.astype(float) - FB / distance) / std
    assert stats.kstest(error.ravel(), "norm").pvalue > ALPHA
    # First order: z^2 / (f b) times the disparity's.
    axial = distance**2 / FB * std
    np.testing.assert_allclose((measured - distance).std(), axial, rtol=0.05)
    for a, b in [
        (error[0], error[1]),
        (error[:, 1:], error[:, :-1]),
        (error[:, :, 1:], error[:, :, :-1]),
    ]:
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / np.sqrt(a.size), (
            "pixels share noise"
        )
    again = measure(device, depth, disparity_std=std, max_range=10.0)
    np.testing.assert_array_equal(again, measured)
    other = measure(device, depth, disparity_std=std, max_range=10.0, seed=1)
    assert (other != measured).mean() > 0.99


def step_image(near=0.5, far=0.7, empty=False):
    """Left half near, right half far (or without depth); the edge is between columns 39 and 40."""
    depth = np.full((3, 200, 80), near)
    depth[:, :, 40:] = 0.0 if empty else far
    return depth


def binomial_bound(share, size):
    """Half the width of the range in which a share lies, at the tests' level."""
    return stats.norm.isf(ALPHA / 2) * np.sqrt(share * (1 - share) / size)


def test_edges_fray_and_nothing_else_does(device):
    depth = step_image()
    measured = measure(device, depth, edge_jump=0.02, edge_dropout=0.3, flying=0.2)
    edge = np.zeros(80, bool)
    edge[39:41] = True
    np.testing.assert_allclose(measured[:, :, ~edge], depth[:, :, ~edge], rtol=3e-7)
    pixels, true = measured[:, :, edge], depth[:, :, edge]
    lost = pixels == 0
    between = (pixels > 0.5 + 1e-6) & (pixels < 0.7 - 1e-6)
    assert abs(lost.mean() - 0.3) < binomial_bound(0.3, lost.size)
    assert abs(between.mean() - 0.2) < binomial_bound(0.2, lost.size)
    np.testing.assert_allclose(pixels[~lost & ~between], true[~lost & ~between], rtol=1e-5)
    place = (pixels[between] - 0.5) / 0.2
    assert stats.kstest(place, "uniform").pvalue > ALPHA, "anywhere between the surfaces"


@EXAMPLES
@given(depth=images(), jump=st.floats(0.05, 0.6))
def test_an_edge_is_where_a_neighbour_is_further_away_than_the_jump(device, depth, jump):
    """A slope is none; a neighbour without depth is as far as the range, and itself stays without."""
    far = np.pad(np.where(depth > 0, depth, MAX_RANGE), ((0, 0), (1, 1), (1, 1)), mode="edge")
    middle = far[:, 1:-1, 1:-1]
    others = (far[:, :-2, 1:-1], far[:, 2:, 1:-1], far[:, 1:-1, :-2], far[:, 1:-1, 2:])
    apart = np.max([np.abs(other - middle) for other in others], axis=0)
    assume((np.abs(apart - jump) > 1e-6).all())
    edge = (apart > jump) & (depth > 0)
    lost = measure(device, depth, edge_jump=jump, edge_dropout=1.0)
    np.testing.assert_allclose(lost, np.where(edge, 0.0, depth), rtol=3e-7)
    flying = measure(device, depth, edge_jump=jump, flying=1.0)
    assert (np.abs(flying - depth)[edge] <= apart[edge] + 1e-6).all()
    np.testing.assert_allclose(flying[~edge], depth[~edge], rtol=3e-7)


@EXAMPLES
@given(
    near=st.floats(0.3, 0.6),
    gap=st.floats(0.05, 0.6),
    left=st.integers(60, 90),
    width=st.integers(2, 40),
)
def test_near_things_throw_a_shadow_to_their_left(device, near, gap, left, width):
    scale, far = 14.0, near + gap  # focal length in pixels of the image, times baseline
    depth = np.full((1, 2, 160), far)
    depth[:, :, left : left + width] = near
    measured = measure(device, depth, shadow=scale)
    lost = measured[0, 0] == 0
    # Seen from the right, the near thing covers what lies behind it and up to this many pixels
    # beside it.
    parallax = scale / near - scale / far
    # Where it is a tie, single precision cannot say which pixel is the last.
    assume(abs(parallax - round(parallax)) > 1e-3 and abs(scale / far % 1 - 0.5) > 1e-3)
    column = np.arange(160)
    hidden = (column < left) & (left - column <= parallax)
    hidden |= column + 0.5 < scale / far  # beyond the border of the second image
    np.testing.assert_array_equal(lost, hidden)
    np.testing.assert_array_equal(measured[0, 1], measured[0, 0])


def test_dropout_takes_its_share_of_all_pixels(device):
    measured = measure(device, np.full((2, 100, 100), 0.6), dropout=0.1)
    lost = measured == 0
    assert abs(lost.mean() - 0.1) < binomial_bound(0.1, lost.size)
    np.testing.assert_allclose(measured[~lost], 0.6, rtol=3e-7)


@EXAMPLES
@given(poses=quaternions((4,)), delay=st.floats(0.0, 2.0))
def test_late_poses_are_interpolated_between_frames(device, poses, delay):
    frames = [
        np.concatenate([[0.1 * k, -0.2 * k, k * k], q])[None, None] for k, q in enumerate(poses)
    ]
    history = unwritten((3, 1, 1), wp.transform, device)
    late = unwritten((1, 1), wp.transform, device)
    for k, frame in enumerate(frames):
        launch(delay_poses_kernel, (1, 1), [[k], [delay], frame, history, late], device)
    shown = late.numpy()[0, 0]
    when = len(frames) - 1 - delay
    position = [np.interp(when, range(4), [f[0, 0, i] for f in frames]) for i in range(3)]
    np.testing.assert_allclose(shown[:3], position, atol=1e-5)
    turns = Rotation.from_quat(poses)
    older = int(np.floor(when))
    angle = (turns[min(older + 1, 3)] * turns[older].inv()).magnitude()
    if angle < 2.0:  # chord and arc part company further on
        arc = Slerp(range(4), turns)([when])[0]
        assert (Rotation.from_quat(shown[3:]) * arc.inv()).magnitude() < 2e-3 + angle**3 / 100
