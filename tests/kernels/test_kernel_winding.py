"""Winding numbers of sampled surfaces, against NumPy sums and what Gauss says of closed ones."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, unwritten

from vd.kernels.winding import winding_kernel

SHAPE = (5, 4, 3)


def run(device, samples, areas, *, width, corner, pitch, shape=SHAPE):
    """Winding numbers of the kernel, [X, Y, Z]."""
    out = unwritten(shape, float, device)
    inputs = [
        device_array(samples, wp.vec3, device),
        device_array(areas, wp.vec3, device),
        width,
        wp.vec3(*corner),
        pitch,
    ]
    wp.launch(winding_kernel, dim=shape, inputs=inputs, outputs=[out], device=device)
    return out.numpy()


def grid(corner, pitch, shape=SHAPE):
    """Its points [X, Y, Z, 3]."""
    axes = [c + pitch * np.arange(n) for c, n in zip(corner, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


@EXAMPLES
@given(seed=st.integers(0, 2**31), width=st.floats(0.01, 1.0), pitch=st.floats(0.05, 1.0))
def test_pieces_count_by_their_solid_angles(device, seed, width, pitch):
    rng = np.random.default_rng(seed)
    samples, areas = rng.normal(size=(2, 7, 3))
    corner = rng.normal(size=3)
    found = run(device, samples, areas, width=width, corner=corner, pitch=pitch)
    away = samples - grid(corner, pitch)[..., None, :]
    distance = np.maximum(np.linalg.norm(away, axis=-1), width)
    expected = ((away * areas).sum(axis=-1) / distance**3).sum(axis=-1) / (4 * np.pi)
    largest = (np.linalg.norm(areas, axis=-1) / distance**2).sum(axis=-1)  # before they cancel
    assert (np.abs(found - expected) < 1e-4 * largest).all()


def test_of_a_sphere_it_is_one_inside_and_zero_outside(device):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    areas = normals * (4 * np.pi / len(normals))
    found = run(device, normals, areas, width=0.1, corner=(-2.0, -2.0, -2.0), pitch=1.0, shape=(5, 5, 5))
    radius = np.linalg.norm(grid((-2, -2, -2), 1.0, (5, 5, 5)), axis=-1)
    assert abs(found[radius < 0.5] - 1.0).max() < 0.05
    assert abs(found[radius > 1.5]).max() < 0.05
    assert abs(found[radius == 1.0] - 0.5).max() < 0.1
