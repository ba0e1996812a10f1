"""Link poses of a hand from its joint positions, without a simulator, and the cloud that its links carry.

Metres, radians, quaternions xyzw. N rows, D joints, B bodies a row, H samples of the hand.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Joints:
    """Revolute joints of a tree, parents before their children."""

    parent: wp.array[int]  # [D] parent link of each joint, a column of the poses
    child: wp.array[int]  # [D] child link of each joint, a column of the poses
    axis: wp.array[wp.vec3]  # [D] unit axis in the joint frames
    parent_frame: wp.array[wp.transform]  # [D] joint frame in the parent link
    child_frame: wp.array[wp.transform]  # [D] joint frame in the child link


@wp.kernel
def forward_kinematics_kernel(
    # Model:
    joints: Joints,  # the joints
    base_body: int,  # column of the base
    base: wp.transform,  # pose of the base in the frame in which poses are wanted
    # In:
    joint_q_in: wp.array2d[float],  # [N, >= D] joint positions [rad]
    # Out:
    body_q_out: wp.array2d[wp.transform],  # [N, B] poses; columns of other bodies stay
):
    """Poses of all links. Launch: [N]."""
    row = wp.tid()
    body_q_out[row, base_body] = base
    for joint in range(joints.parent.shape[0]):
        turn = wp.transform(
            wp.vec3(0.0), wp.quat_from_axis_angle(joints.axis[joint], joint_q_in[row, joint])
        )
        pose = wp.transform_multiply(
            body_q_out[row, joints.parent[joint]],
            wp.transform_multiply(joints.parent_frame[joint], turn),
        )
        body_q_out[row, joints.child[joint]] = wp.transform_multiply(
            pose, wp.transform_inverse(joints.child_frame[joint])
        )


@wp.kernel
def link_points_kernel(
    # Model:
    points: wp.array[wp.vec3],  # [H] samples of the hand, each in the frame of its link [m]
    body: wp.array[int],  # [H] link of each sample, a column of ``body_q_in``
    base_body: int,  # the hand's base, likewise
    # In:
    body_q_in: wp.array2d[wp.transform],  # [N, B] poses in the world frame
    # Out:
    points_out: wp.array2d[wp.vec3],  # [N, H] points in the base frame [m]
):
    """Carry every sample into the hand's base frame: P' = P R^T + p. Launch: [N, H]."""
    row, sample = wp.tid()
    to_base = wp.transform_inverse(body_q_in[row, base_body])
    link = wp.transform_multiply(to_base, body_q_in[row, body[sample]])
    points_out[row, sample] = wp.transform_point(link, points[sample])
