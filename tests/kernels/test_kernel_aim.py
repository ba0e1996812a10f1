"""Where a policy is told that its goal is, against SciPy's rotations."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, unwritten
from scipy.spatial.transform import Rotation

from vd.kernels.aim import aim_kernel

COLUMN = 3
"""Where the orientation is in the rows: behind a position."""
EDGE = 1e-3
"""Nothing is asked of angles as near as this to the bound, where the last bit decides."""


def run(device, orientation, goal, *, past, within):
    """Aimed orientations of the kernel, [N, 4]."""
    rows = np.full((len(goal), COLUMN + 6), 7.0)
    rows[:, COLUMN : COLUMN + 4] = orientation
    out = unwritten(len(goal), wp.quat, device)
    inputs = [past, within, COLUMN, device_array(rows, float, device), device_array(goal, wp.quat, device)]
    wp.launch(aim_kernel, dim=len(goal), inputs=inputs, outputs=[out], device=device)
    return out.numpy()


@EXAMPLES
@given(
    seed=st.integers(0, 2**31),
    past=st.floats(0.01, 1.0),
    within=st.floats(0.05, 3.0),
    farthest=st.sampled_from([0.1, 0.5, np.pi]),
)
def test_goals_that_are_near_move_on_along_what_is_left(device, seed, past, within, farthest):
    rng = np.random.default_rng(seed)
    here = Rotation.random(16, rng=rng)
    axis = rng.normal(size=(16, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = rng.uniform(0.01, farthest, 16)
    # Either sign of a quaternion is the same orientation.
    goal = (Rotation.from_rotvec(-angle[:, None] * axis) * here).as_quat() * rng.choice([-1.0, 1.0], (16, 1))
    found = run(device, here.as_quat(), goal, past=past, within=within)
    assert np.allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)
    moved = np.where(angle < within, np.minimum(angle + past, np.pi), angle)
    expected = Rotation.from_rotvec(-moved[:, None] * axis) * here
    apart = (Rotation.from_quat(found) * expected.inv()).magnitude()
    certain = np.abs(angle - within) > EDGE
    assert (apart[certain] < 2e-3).all()
    beside = np.sum(found * goal, axis=1) > 0.0
    assert beside[moved - angle < 1.5].all(), "the sign is the goal's"


def test_at_the_goal_there_is_nowhere_to_go(device):
    here = Rotation.random(4, rng=np.random.default_rng(0)).as_quat()
    found = run(device, here, here, past=0.2, within=0.4)
    assert np.allclose(found, here, atol=1e-6)
