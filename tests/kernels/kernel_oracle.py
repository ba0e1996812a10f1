"""What the kernel tests share.

Arrays that show unwritten cells, hypothesis strategies, NumPy oracles.

The oracles compute in float64 with SciPy and import nothing from the kernels.
"""

import numpy as np
import warp as wp
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

EXAMPLES = settings(max_examples=25, deadline=None)
"""Enough for the branches of these kernels; keeps the folder fast from a cold start."""

SENTINEL = -77
"""An integer no kernel writes."""

ALPHA = 1e-6
"""Significance level of the statistical tests; the seeds are fixed, so they do not flicker."""


def device_array(value: object, dtype: object, device: str) -> wp.array:
    """Copy ``value`` to a Warp array of ``dtype``."""
    return wp.array(np.ascontiguousarray(value), dtype=dtype, device=device)


def unwritten(shape: int | tuple[int, ...], dtype: object, device: str) -> wp.array:
    """An array of NaN, or of ``SENTINEL`` for integers, so that a cell a kernel missed is seen."""
    array = wp.empty(shape, dtype=dtype, device=device)
    host = array.numpy()
    fill = np.nan if np.issubdtype(host.dtype, np.floating) else SENTINEL
    array.assign(np.full_like(host, fill))
    return array


def on_device(value: object, declared: object, device: str) -> object:
    """A value as its declared type.

    An array, a struct given as a dict with every field, or some of these.
    """
    array = wp.types.is_array(declared) and not isinstance(value, wp.array)
    if array and hasattr(declared.dtype, "vars"):  # type: ignore[attr-defined]
        given = [value] if isinstance(value, dict) else value
        rows = [on_device(row, declared.dtype, device) for row in given]
        return wp.array(rows, dtype=declared.dtype, device=device)
    if isinstance(value, dict):
        assert set(value) == set(declared.vars), f"fields {sorted(set(declared.vars) ^ set(value))}"
        made = declared()
        for name, variable in declared.vars.items():
            setattr(made, name, on_device(value[name], variable.type, device))
        return made
    return device_array(value, declared.dtype, device) if array else value


def launch(
    kernel: wp.Kernel, dim: object, arguments: list, device: str, *outputs: int | tuple[int, ...]
) -> list[np.ndarray]:
    """Launch ``kernel`` on ``arguments``, then on unwritten arrays of these shapes, which are returned."""
    declared = [argument.type for argument in kernel.adj.args]
    given = zip(arguments, declared[: len(arguments)], strict=True)
    values = [on_device(value, kind, device) for value, kind in given]
    shapes = zip(outputs, declared[len(arguments) :], strict=True)
    made = [unwritten(shape, kind.dtype, device) for shape, kind in shapes]
    wp.launch(kernel, dim=dim, inputs=[*values, *made], device=device)
    return [array.numpy() for array in made]


def streams(worlds: int, seed: int, device: str) -> wp.array:
    """Random streams of ``worlds`` worlds."""
    from vd.kernels.rng import init_rng_kernel

    rng = wp.empty(worlds, dtype=wp.uint32, device=device)
    wp.launch(init_rng_kernel, dim=worlds, inputs=[seed], outputs=[rng], device=device)
    return rng


def floats(
    shape: tuple[int, ...], low: float = -2.0, high: float = 2.0
) -> st.SearchStrategy[np.ndarray]:
    """Arrays of float32 in [low, high]."""
    low, high = float(np.float32(low)), float(np.float32(high))
    # Subnormal numbers are flushed to zero on some devices and mean nothing here.
    elements = st.floats(low, high, width=32, allow_subnormal=False)
    return hnp.arrays(np.float32, shape, elements=elements)


def indices(shape: int | tuple[int, ...], count: int) -> st.SearchStrategy[np.ndarray]:
    """Arrays of integers from 0 to below ``count``."""
    return hnp.arrays(np.int32, shape, elements=st.integers(0, count - 1))


@st.composite
def quaternions(draw: st.DrawFn, shape: tuple[int, ...]) -> np.ndarray:
    """Unit quaternions xyzw, float32, shape ``shape`` + (4,).

    Anywhere on the sphere, with special ones.
    """
    raw = draw(floats((*shape, 4), -1.0, 1.0)).astype(np.float64)
    norm = np.linalg.norm(raw, axis=-1, keepdims=True)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    return np.where(norm > 1e-3, raw / np.maximum(norm, 1e-3), identity).astype(np.float32)


@st.composite
def transforms(draw: st.DrawFn, shape: tuple[int, ...]) -> np.ndarray:
    """Poses: position within 0.3 m, then quaternion xyzw; float32, shape ``shape`` + (7,)."""
    return np.concatenate([draw(floats((*shape, 3), -0.3, 0.3)), draw(quaternions(shape))], axis=-1)


@st.composite
def goals(draw: st.DrawFn, orientation: np.ndarray) -> np.ndarray:
    """Goals for orientations of the same shape.

    Random, equal, opposite in sign, or half a turn away.
    """
    goal = draw(quaternions(orientation.shape[:-1]))
    kind = draw(hnp.arrays(np.int8, orientation.shape[:-1], elements=st.integers(0, 4)))[..., None]
    x, y, z, w = np.moveaxis(orientation, -1, 0)
    half_turn = np.stack([w, z, -y, -x], axis=-1)  # (pi about x) * orientation
    goal = np.where(kind == 1, orientation, goal)
    goal = np.where(kind == 2, -orientation, goal)
    return np.where(kind == 3, half_turn, goal).astype(np.float32)


def angle_between(q: np.ndarray, q_goal: np.ndarray) -> np.ndarray:
    """Angle between orientations [rad], by SciPy."""
    return (Rotation.from_quat(q) * Rotation.from_quat(q_goal).inv()).magnitude()


def relative_quaternion(q: np.ndarray, q_goal: np.ndarray) -> np.ndarray:
    """Product q * conj(q_goal) by its 4x4 matrix; SciPy may change the sign of a product."""
    x, y, z, w = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    left = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
    conjugate = np.asarray(q_goal, np.float64) * [-1.0, -1.0, -1.0, 1.0]
    return np.einsum("ij...,...j->...i", left, conjugate)


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """4x4 matrices of poses (position, quaternion xyzw), shape (..., 7) to (..., 4, 4)."""
    pose = np.asarray(pose, np.float64)
    matrix = np.zeros((*pose.shape[:-1], 4, 4))
    rotations = Rotation.from_quat(pose[..., 3:].reshape(-1, 4)).as_matrix()
    matrix[..., :3, :3] = rotations.reshape(*pose.shape[:-1], 3, 3)
    matrix[..., :3, 3] = pose[..., :3]
    matrix[..., 3, 3] = 1.0
    return matrix


def ball_cdf(angle: np.ndarray, max_angle: float) -> np.ndarray:
    """CDF of the rotation angle of a uniform draw on the ball of rotations within ``max_angle``."""
    top = min(max_angle, np.pi)
    return (np.clip(angle, 0, top) - np.sin(np.clip(angle, 0, top))) / (top - np.sin(top))


def rotation_angles(q: np.ndarray) -> np.ndarray:
    """Angles of quaternions in [0, pi], well conditioned everywhere."""
    q = np.asarray(q, np.float64)
    return 2 * np.arctan2(np.linalg.norm(q[..., :3], axis=-1), np.abs(q[..., 3]))
