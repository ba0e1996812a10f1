"""What was drawn for a world, told to a critic or a teacher: servos, frictions, mass, latency.

Zero is nominal, and one about what training draws.
"""

import warp as wp

from vd.kernels.servo.actuators import BACKLASH_WIDTH, COMMAND_DELAY, COULOMB_TORQUE

wp.set_module_options({"enable_backward": False})

GAIN_UNIT = 0.2
"""Unit of a gain's relative change: Table S3 draws as much."""
DELAY_UNIT_S = 0.04
"""Unit of the command's delay [s] (ours): the largest that training draws."""
TORQUE_UNIT_NM = 0.15
"""Unit of dry friction [N m] (ours): likewise."""
PLAY_UNIT_RAD = 0.03
"""Unit of the backlash [rad] (ours): likewise."""
LATENCY_UNIT_S = 0.12
"""Unit of the observation's latency [s] (ours): likewise."""
JOINT_CHANNELS = 5
"""Values of a joint: stiffness, damping, delay of commands, dry friction, backlash."""
SCALARS = 5
"""Values of a world: frictions of hand, object and table, object's mass, latency."""


def dynamics_size(joints: int) -> int:
    """Values that tell the dynamics of a hand with D ``joints``."""
    return JOINT_CHANNELS * joints + SCALARS


@wp.kernel
def dynamics_kernel(
    # Model:
    nominal_kp: wp.array[float],  # [D] stiffness before randomisation [N m/rad]
    nominal_kd: wp.array[float],  # [D] damping before randomisation [N m s/rad]
    nominal: wp.vec4,  # frictions of hand, object and table, mass [kg]; also their units
    column: int,  # first column
    # In:
    kp_in: wp.array2d[float],  # [N, D] stiffness [N m/rad]
    kd_in: wp.array2d[float],  # [N, D] damping [N m s/rad]
    servo_in: wp.array2d[float],  # [N D, P] rows of servo parameters; none without a servo
    hand_friction_in: wp.array[float],  # [N] friction coefficient of the hand
    object_friction_in: wp.array[float],  # [N] that of the object
    table_friction_in: wp.array[float],  # [N] that of the table
    object_mass_in: wp.array[float],  # [N] mass of the object [kg]
    latency_in: wp.array[float],  # [N] how late the world is seen [s]
    # Out:
    observation_out: wp.array2d[float],  # [N, *] observation in the world frame
):
    """Write the drawn dynamics, channel by channel over the joints, then the scalars.

    Launch: [N].
    """
    world = wp.tid()
    joints = nominal_kp.shape[0]
    for joint in range(joints):
        out = column + joint
        row = world * joints + joint
        delay = wp.float32(0.0)
        friction = wp.float32(0.0)
        play = wp.float32(0.0)
        if servo_in.shape[0] > 0:
            delay = servo_in[row, COMMAND_DELAY]
            friction = servo_in[row, COULOMB_TORQUE]
            play = servo_in[row, BACKLASH_WIDTH]
        kp = wp.float32(1.0)
        kd = wp.float32(1.0)
        if nominal_kp[joint] > 0.0:  # a joint that follows another has no drive
            kp = kp_in[world, joint] / nominal_kp[joint]
            kd = kd_in[world, joint] / nominal_kd[joint]
        observation_out[world, out] = (kp - 1.0) / wp.static(GAIN_UNIT)
        observation_out[world, out + joints] = (kd - 1.0) / wp.static(GAIN_UNIT)
        observation_out[world, out + 2 * joints] = delay / wp.static(DELAY_UNIT_S)
        observation_out[world, out + 3 * joints] = friction / wp.static(TORQUE_UNIT_NM)
        observation_out[world, out + 4 * joints] = play / wp.static(PLAY_UNIT_RAD)
    out = column + wp.static(JOINT_CHANNELS) * joints
    observation_out[world, out] = hand_friction_in[world] / nominal[0] - 1.0
    observation_out[world, out + 1] = object_friction_in[world] / nominal[1] - 1.0
    observation_out[world, out + 2] = table_friction_in[world] / nominal[2] - 1.0
    observation_out[world, out + 3] = object_mass_in[world] / nominal[3] - 1.0
    observation_out[world, out + 4] = latency_in[world] / wp.static(LATENCY_UNIT_S)
