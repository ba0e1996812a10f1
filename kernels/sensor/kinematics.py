"""Forward kinematics of a hand: joint positions to link poses, without a simulator.

For a robot's own clouds and for scenes that are not simulated. Metres, radians, quaternions xyzw.
N rows, D joints, B bodies a row.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Joints:
    """Revolute joints of a tree, parents before their children.

    parent: Parent link of each joint, a column of the poses [D].
    child: Child link of each joint, a column of the poses [D].
    axis: Unit axis in the joint frames [D].
    parent_frame: Joint frame in the parent link [D].
    child_frame: Joint frame in the child link [D].
    """

    parent: wp.array[int]
    child: wp.array[int]
    axis: wp.array[wp.vec3]
    parent_frame: wp.array[wp.transform]
    child_frame: wp.array[wp.transform]


@wp.kernel
def forward_kinematics_kernel(
    # Model:
    joints: Joints,
    base_body: int,
    base: wp.transform,
    # In:
    joint_q_in: wp.array2d[float],
    # Out:
    body_q_out: wp.array2d[wp.transform],
):
    """Poses of all links. Launch: [N].

    Args:
        joints: The joints.
        base_body: Column of the base.
        base: Pose of the base in the frame in which poses are wanted.
        joint_q_in: Joint positions [rad], shape [N, >= D].
        body_q_out: Poses, shape [N, B]; columns of other bodies stay.
    """
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
