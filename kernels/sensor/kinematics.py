"""Forward kinematics of a hand: joint positions to link poses, without a simulator.

For a robot's own clouds and for scenes that are not simulated. Metres, radians, quaternions xyzw.
N rows, D joints, B bodies a row.
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
        turn = wp.transform(wp.vec3(0.0), wp.quat_from_axis_angle(joints.axis[joint], joint_q_in[row, joint]))
        pose = wp.transform_multiply(
            body_q_out[row, joints.parent[joint]], wp.transform_multiply(joints.parent_frame[joint], turn)
        )
        body_q_out[row, joints.child[joint]] = wp.transform_multiply(
            pose, wp.transform_inverse(joints.child_frame[joint])
        )
