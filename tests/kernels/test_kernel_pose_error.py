import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    EXAMPLES,
    floats,
    launch,
    pose_matrix,
    quaternions,
    streams,
    transforms,
)
from scipy.spatial.transform import Rotation

from vd.kernels.task.pose_error import draw_pose_error_kernel, mistake_pose_kernel


@EXAMPLES
@given(data=st.data(), worlds=st.integers(1, 4))
def test_the_object_alone_is_displaced_and_turned_about_its_origin(device, data, worlds):
    joints = data.draw(st.sampled_from([9, 12]))
    pose = [data.draw(floats((worlds, 3))), data.draw(quaternions((worlds,)))]
    q = np.concatenate([data.draw(floats((worlds, joints))), *pose], axis=1)
    error = data.draw(transforms((worlds,)))
    (believed,) = launch(mistake_pose_kernel, worlds, [error, q], device, q.shape)
    np.testing.assert_array_equal(believed[:, :joints], q[:, :joints])
    np.testing.assert_allclose(believed[:, joints : joints + 3], pose[0] + error[:, :3], atol=1e-6)
    turned = pose_matrix(error)[:, :3, :3] @ Rotation.from_quat(pose[1]).as_matrix()
    np.testing.assert_allclose(
        Rotation.from_quat(believed[:, joints + 3 :]).as_matrix(), turned, atol=1e-5
    )


def test_errors_have_their_size_and_every_direction_and_others_stay(device):
    worlds, size = 2000, (0.005, 0.1)
    mask = np.arange(worlds) % 4 != 0
    sizes = wp.array([size], dtype=wp.vec2, device=device)
    inputs = [sizes, mask, streams(worlds, 3, device)]
    (drawn,) = launch(draw_pose_error_kernel, worlds, inputs, device, worlds)
    assert np.isnan(drawn[~mask]).all()
    turn = Rotation.from_quat(drawn[mask, 3:]).as_rotvec()
    for vector, length in ((drawn[mask, :3], size[0]), (turn, size[1])):
        np.testing.assert_allclose(np.linalg.norm(vector, axis=1), length, rtol=1e-4)
        assert np.abs(vector.mean(axis=0)).max() < 0.1 * length
