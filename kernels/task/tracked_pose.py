"""The object's pose as a tracker tells it: at a rate of its own, late, held in between.

Some poses do not come, some are far off, and velocities are differences of poses. A pose is taken
from the ring of past states (:mod:`vd.kernels.task.latency`), at the age that is written here.
"""

import warp as wp

from vd.kernels.columns import read_quat, read_vec3, write_quat, write_vec3
from vd.kernels.rng import next_stream, uniform
from vd.kernels.transforms import rotation_difference, rotation_vector

wp.set_module_options({"enable_backward": False})

CAME, FIRST = wp.constant(1), wp.constant(2)
"""What a step brings: a new pose, or the first one of an episode, of which nothing came before."""


@wp.struct
class TrackedPoseParams:
    """Settings of a tracker; an array of length 1 in device memory."""

    rate_hz: wp.vec2  # range of the poses a second
    age_s: wp.vec2  # range of the age at which a pose comes [s]
    dropped: float  # share of the poses that do not come
    jumping: float  # share of the poses that are off by ``jump``
    jump: wp.vec2  # by how much [m] [rad]
    noise: wp.vec2  # standard deviation of each pose in each axis [m] [rad]


@wp.kernel
def begin_tracked_pose_kernel(
    # Model:
    params: wp.array[TrackedPoseParams],  # [1] settings
    # In:
    mask_in: wp.array[int],  # [N] 1 where an episode begins
    head_in: wp.array[int],  # [N] slot of the ring written last
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    # Out:
    rate_out: wp.array[float],  # [N] poses a second
    delay_out: wp.array[float],  # [N] age of a pose when it comes [s]
    clock_out: wp.array[float],  # [N] time since the episode's beginning [s]
    head_out: wp.array[int],  # [N] slot of the ring at that time
    due_out: wp.array[float],  # [N] time of the next pose [s], which comes its delay later
    held_s_out: wp.array[float],  # [N] time of the pose that is held [s]
    latency_out: wp.array[float],  # [N] age of the pose that is held [s]
    came_out: wp.array[int],  # [N] what the step brings
):
    """Draw rate, delay and phase of the masked worlds, whose first pose is the present one. Launch: [N]."""
    world = wp.tid()
    if mask_in[world] == 0:
        return
    settings = params[0]
    state, rate = uniform(rng[world], settings.rate_hz)
    state, delay = uniform(state, settings.age_s)
    state, phase = uniform(state, wp.vec2(0.0, 1.0))
    rng[world] = next_stream(state, world)
    rate_out[world] = rate
    delay_out[world] = delay
    clock_out[world] = 0.0
    head_out[world] = head_in[world]
    due_out[world] = phase / rate - delay
    held_s_out[world] = (phase - 1.0) / rate - delay
    latency_out[world] = 0.0
    came_out[world] = FIRST


@wp.kernel
def take_pose_kernel(
    # Model:
    params: wp.array[TrackedPoseParams],  # [1] settings
    slots: int,  # rows of the ring of each world
    physics_dt: float,  # time between two rows [s]
    # In:
    rate_in: wp.array[float],  # [N] poses a second
    delay_in: wp.array[float],  # [N] age of a pose when it comes [s]
    head_in: wp.array[int],  # [N] slot of the ring written last
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    head: wp.array[int],  # [N] slot of the ring at the last call
    clock: wp.array[float],  # [N] time since the episode's beginning [s]
    due: wp.array[float],  # [N] time of the next pose [s]
    latency: wp.array[float],  # [N] age of the newest pose [s]
    came: wp.array[int],  # [N] FIRST stays until it was held; else CAME or 0
):
    """The newest pose that has come since the last call and was not dropped, and its age. Launch: [N]."""
    world = wp.tid()
    passed = physics_dt * float((head_in[world] - head[world] + slots) % slots)
    head[world] = head_in[world]
    now = clock[world] + passed
    clock[world] = now
    age = latency[world] + passed
    brought = wp.int32(0)
    state = rng[world]
    while due[world] + delay_in[world] <= now:
        if wp.randf(state) >= params[0].dropped:
            age = now - due[world]
            brought = CAME
        due[world] = due[world] + 1.0 / rate_in[world]
    rng[world] = next_stream(state, world)
    latency[world] = age
    if came[world] != FIRST:
        came[world] = brought


@wp.kernel
def hold_pose_kernel(
    # Model:
    params: wp.array[TrackedPoseParams],  # [1] settings
    # In:
    clock_in: wp.array[float],  # [N] time since the episode's beginning [s]
    latency_in: wp.array[float],  # [N] age of the newest pose [s]
    joint_q_in: wp.array2d[float],  # [N, D + 7] hand joints, object position p and quaternion q
    joint_qd_in: wp.array2d[float],  # [N, D + 6] hand joints, object velocity and spin
    # In/Out:
    rng: wp.array[wp.uint32],  # [N] random stream of each world
    came: wp.array[int],  # [N] what the step brings; 0 afterwards
    held_s: wp.array[float],  # [N] time of the pose that is held [s]
    held: wp.array[wp.transform],  # [N] the pose that is held
    twist: wp.array[wp.spatial_vector],  # [N] its velocity [m/s] and spin [rad/s]
    # Out:
    joint_q_out: wp.array2d[float],  # [N, D + 7] the same with the pose that is held
    joint_qd_out: wp.array2d[float],  # [N, D + 6] the same with its velocity
):
    """Hold the newest pose until another one comes. Launch: [N].

    A new pose has an error e of translation and rotation vector: p + e_p, exp(e_r) q. Velocity is
    the difference to the pose held before over the time between the two; of a first pose, which
    has no error, it is zero.
    """
    world = wp.tid()
    settings = params[0]
    joints = joint_q_in.shape[1] - 7
    position = read_vec3(world, joints, joint_q_in)
    orientation = read_quat(world, joints + 3, joint_q_in)
    if came[world] == FIRST:
        held[world] = wp.transform(position, orientation)
        twist[world] = wp.spatial_vector()
    if came[world] == CAME:
        state = rng[world]
        shift = settings.noise[0] * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
        turn = settings.noise[1] * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
        if wp.randf(state) < settings.jumping:
            shift += settings.jump[0] * wp.sample_unit_sphere_surface(state)
            turn += settings.jump[1] * wp.sample_unit_sphere_surface(state)
        rng[world] = next_stream(state, world)
        position += shift
        angle = wp.length(turn)
        if angle > 0.0:
            orientation = wp.quat_from_axis_angle(turn / angle, angle) * orientation
        before = held[world]
        taken_s = clock_in[world] - latency_in[world]
        between_s = taken_s - held_s[world]
        moved = position - wp.transform_get_translation(before)
        turned = rotation_vector(
            rotation_difference(orientation, wp.transform_get_rotation(before))
        )
        twist[world] = wp.spatial_vector(moved / between_s, turned / between_s)
        held[world] = wp.transform(position, orientation)
        held_s[world] = taken_s
    came[world] = 0
    for joint in range(joints):
        joint_q_out[world, joint] = joint_q_in[world, joint]
        joint_qd_out[world, joint] = joint_qd_in[world, joint]
    pose = held[world]
    column = write_vec3(world, joints, wp.transform_get_translation(pose), joint_q_out)
    write_quat(world, column, wp.transform_get_rotation(pose), joint_q_out)
    column = write_vec3(world, joints, wp.spatial_top(twist[world]), joint_qd_out)
    write_vec3(world, column, wp.spatial_bottom(twist[world]), joint_qd_out)
