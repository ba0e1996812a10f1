"""Reward of turning about an axis, and the past of the joints, against NumPy and SciPy."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, floats, launch, transforms
from scipy.spatial.transform import Rotation

from vd.kernels.task.history import push_history_kernel
from vd.kernels.task.spin import SPIN_TERMS, begin_spin_kernel, spin_kernel

WORLDS, JOINTS, FIRST = 3, 4, 2
DT = 1.0 / 12.0
AXIS = np.array([0.6, 0.0, -0.8])
PARAMS = {
    "axis": wp.vec3(*AXIS),
    "clip": 0.5,
    "rate": 1.0,
    "object_speed": -0.3,
    "posture": -0.03,
    "torque": -0.1,
    "scale": 0.1,
    "dt": DT,
}


def pay(device, start, joints, effort, before, now):
    """Terms [N, 4], added reward, turned angle and the pose that is kept."""
    n = len(joints)
    terms = device_array(np.full((n, FIRST + len(SPIN_TERMS)), 7.0), float, device)
    kept = device_array(before, wp.transform, device)
    turned = device_array(np.full(n, 3.0), float, device)
    reward = device_array(np.full(n, 2.0), float, device)
    inputs = [PARAMS, start, np.hstack([joints, now]), effort, FIRST, kept, turned, reward, terms]
    launch(spin_kernel, n, inputs, device)
    written = terms.numpy()
    assert np.all(written[:, :FIRST] == 7.0), "the columns of other terms are left alone"
    return written[:, FIRST:], reward.numpy() - 2.0, turned.numpy() - 3.0, kept.numpy()


@EXAMPLES
@given(
    start=floats((JOINTS,)),
    joints=floats((WORLDS, JOINTS)),
    effort=floats((WORLDS, JOINTS), -0.5, 0.5),
    before=transforms((WORLDS,)),
    turn=floats((WORLDS, 3), -1.5, 1.5),
    moved=floats((WORLDS, 3), -0.05, 0.05),
    sign=st.sampled_from([1.0, -1.0]),
)
def test_turning_is_paid_by_its_speed_about_the_axis(
    device, start, joints, effort, before, turn, moved, sign
):
    """Either sign of a quaternion is the same pose."""
    turned = Rotation.from_rotvec(turn) * Rotation.from_quat(before[:, 3:])
    now = np.hstack([before[:, :3] + moved, sign * turned.as_quat()])
    terms, reward, angle, kept = pay(device, start, joints, effort, before, now)
    about = turn.astype(float) @ AXIS
    wanted = [
        np.clip(about / DT, -0.5, 0.5),
        -0.3 * np.abs(moved.astype(float)).sum(axis=1) / DT,
        -0.03 * np.square(joints.astype(float) - start).sum(axis=1),
        -0.1 * np.square(effort.astype(float)).sum(axis=1),
    ]
    np.testing.assert_allclose(angle, about, atol=1e-5)
    np.testing.assert_allclose(terms, np.transpose(wanted), rtol=1e-4, atol=2e-4)
    np.testing.assert_allclose(reward, 0.1 * np.sum(wanted, axis=0), rtol=1e-4, atol=2e-4)
    np.testing.assert_allclose(kept, now, atol=1e-6)


@EXAMPLES
@given(before=transforms((WORLDS,)), now=transforms((WORLDS,)))
def test_an_episode_begins_to_turn_where_its_object_is(device, before, now):
    """Others go on."""
    kept = device_array(before, wp.transform, device)
    turned = device_array(np.full(WORLDS, 3.0), float, device)
    q = np.hstack([np.zeros((WORLDS, JOINTS)), now])
    launch(begin_spin_kernel, WORLDS, [[0, 1, 0], q, JOINTS, kept, turned], device)
    assert turned.numpy().tolist() == [3.0, 0.0, 3.0]
    assert np.array_equal(kept.numpy(), [before[0], now[1], before[2]])


@EXAMPLES
@given(
    steps=st.integers(1, 4),
    values=floats((6, 2, 9)),
    fresh=st.lists(st.booleans(), min_size=5, max_size=5),
)
def test_the_history_holds_the_last_steps_in_their_order(device, steps, values, fresh):
    """The second of two worlds may begin anew; its past then is its present."""
    joints, position, action = 2, 1, 5
    first = 9
    width = first + 2 * joints * steps
    row = device_array(np.zeros((2, width)), float, device)
    pasts = [[], []]
    for step, seen in enumerate(values):
        begins = np.array([step == 0, step == 0 or fresh[step - 1]], np.int32)
        row.assign(np.hstack([seen, row.numpy()[:, first:]]).astype(np.float32))
        inputs = [row, position, action, joints, steps, begins, first, row]
        launch(push_history_kernel, (2, 2 * joints), inputs, device)
        for world in range(2):
            told = seen[world, [1, 2, 5, 6]]
            if begins[world]:
                pasts[world] = [told] * steps
            pasts[world] = [*pasts[world][1:], told]
        written = row.numpy()
        assert np.array_equal(written[:, :first], seen)
        assert np.array_equal(written[:, first:], np.reshape(pasts, (2, -1)))
