"""Reward for turning an object about an axis, without a goal.

Terms of HORA (Qi et al. 2022, arXiv 2210.04887) but for the work, which is the energy of
:mod:`vd.kernels.task.rewards`. World frame, SI units, radians, quaternions xyzw.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3
from vd.kernels.transforms import rotation_difference, rotation_vector

wp.set_module_options({"enable_backward": False})

SPIN_TERMS = ("spin", "object_speed", "posture", "torque")
"""Columns of its terms, the first of those that :func:`spin_kernel` writes."""


@wp.struct
class SpinParams:
    """Coefficients and settings; an array of length 1 in device memory."""

    axis: wp.vec3  # unit vector about which the object is to turn, world frame
    clip: float  # speed about it, either way, from which more is worth nothing [rad/s]
    rate: float  # coefficient on the clipped speed about the axis [s/rad]
    object_speed: float  # on the sum of the absolute components of the object's velocity [s/m]
    posture: float  # on the summed squared distance of the joints from their start [1/rad^2]
    torque: float  # on the summed squared torque of the joints [1/(N m)^2]
    scale: float  # factor on the sum of all terms
    dt: float  # control step [s]


@wp.func
def object_pose(world: int, joints: int, joint_q: wp.array2d[float]) -> wp.transform:
    """Pose of the object, after the joints of the hand."""
    position = read_vec3(world, joints, joint_q)
    return wp.transform(position, read_quat(world, joints + 3, joint_q))


@wp.kernel
def begin_spin_kernel(
    # In:
    mask: wp.array[wp.int32],  # [N] 1 where an episode begins
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    joints: int,  # D
    # Out:
    before_out: wp.array[wp.transform],  # [N] pose of the object; written where masked, as below
    turned_out: wp.array[float],  # [N] angle turned about the axis since then [rad]
):
    """Begin to measure where an episode begins. Launch: [N]."""
    world = wp.tid()
    if mask[world] != 0:
        before_out[world] = object_pose(world, joints, joint_q_in)
        turned_out[world] = 0.0


@wp.kernel
def spin_kernel(
    # Model:
    params: wp.array[SpinParams],  # [1] coefficients
    start_q: wp.array[float],  # [D] joints at the start of an episode [rad]
    # In:
    joint_q_in: wp.array2d[float],  # [N, D + 7] joints [rad], object's position [m], quaternion
    effort_in: wp.array2d[float],  # [N, D] joint torques [N m]
    first: int,  # column of the first of these terms
    # In/Out:
    before: wp.array[wp.transform],  # [N] pose of the object a control step ago
    turned: wp.array[float],  # [N] angle turned about the axis in this episode [rad]
    reward: wp.array[float],  # [N] reward; these terms are added
    # Out:
    terms_out: wp.array2d[float],  # [N, T] terms with their coefficients, without scale
):
    """Add the reward of turning in a control step. Launch: [N], after the reward kernel.

    Speeds are differences of two poses, as in HORA: contact makes those of a moment rough.
    reward += scale * (rate clamp(axis . w, -clip, clip) + object_speed sum abs(v)
    + posture sum (q - start)^2 + torque sum tau^2). ``before`` becomes the present pose.
    """
    world = wp.tid()
    weights = params[0]
    joints = start_q.shape[0]
    pose = object_pose(world, joints, joint_q_in)
    last = before[world]
    turn = rotation_difference(wp.transform_get_rotation(pose), wp.transform_get_rotation(last))
    angle = wp.dot(weights.axis, rotation_vector(turn))
    moved = wp.transform_get_translation(pose) - wp.transform_get_translation(last)

    bent = wp.float32(0.0)
    strain = wp.float32(0.0)
    for joint in range(joints):
        away = joint_q_in[world, joint] - start_q[joint]
        bent += away * away
        strain += effort_in[world, joint] * effort_in[world, joint]
    distance = wp.abs(moved[0]) + wp.abs(moved[1]) + wp.abs(moved[2])

    spin = weights.rate * wp.clamp(angle / weights.dt, -weights.clip, weights.clip)
    speed = weights.object_speed * distance / weights.dt
    posture = weights.posture * bent
    torque = weights.torque * strain
    terms_out[world, first] = spin
    terms_out[world, first + 1] = speed
    terms_out[world, first + 2] = posture
    terms_out[world, first + 3] = torque
    reward[world] = reward[world] + weights.scale * (spin + speed + posture + torque)
    turned[world] = turned[world] + angle
    before[world] = pose
