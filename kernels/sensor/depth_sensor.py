"""What a stereo depth camera makes of the true depth, and when: noise, gaps, late frames.

Such a camera measures disparity, focal length * baseline / depth, in pixels of its imagers. Noise
and rounding are even in disparity, hence grow with the square of the distance in depth. At the edge
of a surface the matched patch covers near and far, which gives no value or one in between.
"""

import warp as wp

from vd.kernels.sensor.raycast import EMPTY

wp.set_module_options({"enable_backward": False})

SHADOW_NEAREST = wp.constant(0.2)
"""Nothing nearer than this hides others from the second imager [m]: it bounds the length of a
shadow.
"""


@wp.struct
class DepthSensorParams:
    """A stereo depth camera. Zero switches an effect off."""

    depth_disparity: float  # focal length times baseline, depth times disparity [m pixel]
    disparity_std: float  # standard deviation of the disparity [pixel]
    disparity_step: float  # rounding of the disparity [pixel]
    shadow: float  # as depth_disparity, in pixels of the image: what :func:`is_hidden` has no value
    edge_jump: float  # difference of depth to one of four neighbours that makes an edge [m]
    edge_dropout: float  # probability that an edge pixel has no value
    flying: float  # probability that an edge pixel lies somewhere between both surfaces
    dropout: float  # probability that any pixel has no value
    min_range: float  # depth below which there is no value [m]
    max_range: float  # depth above which there is no value [m]


@wp.func
def depth_behind(depth: wp.array3d[float], world: int, row: int, column: int, far: float) -> float:
    """Depth of a pixel, ``far`` where it has none.

    Rows and columns beyond the image repeat its border.
    """
    r = wp.clamp(row, 0, depth.shape[1] - 1)
    c = wp.clamp(column, 0, depth.shape[2] - 1)
    value = depth[world, r, c]
    if value <= 0.0:
        return far
    return value


@wp.func
def is_hidden(depth: wp.array3d[float], world: int, row: int, column: int, shadow: float) -> bool:
    """Whether the second imager, to the right, does not see what a pixel shows.

    It sees a pixel moved to the left by its disparity. Something nearer moves further, and hides
    what it lands on or passes.
    """
    mine = shadow / depth[world, row, column]
    if float(column) + 0.5 < mine:
        return True  # out of its image
    reach = int(shadow / SHADOW_NEAREST - mine)
    for step in range(1, wp.min(reach, depth.shape[2] - 1 - column) + 1):
        other = depth[world, row, column + step]
        if other > 0.0 and shadow / other - mine >= float(step):
            return True
    return False


@wp.kernel
def measure_depth_kernel(
    # Model:
    params: wp.array[DepthSensorParams],  # [N] settings of each world's sensor
    # In:
    depth_in: wp.array3d[float],  # [N, H, W] true depth [m], 0 for none
    rng_in: wp.array[wp.uint32],  # [N] random state of each world; not advanced
    # Out:
    measured_out: wp.array3d[float],  # [N, H, W] measured depth [m], 0 for none
):
    """Measured depth of every pixel. Launch: [N, H, W]."""
    world, row, column = wp.tid()
    sensor = params[world]
    rng = wp.rand_init(int(rng_in[world]), row * depth_in.shape[2] + column)
    depth = depth_in[world, row, column]
    if depth <= 0.0:
        measured_out[world, row, column] = EMPTY
        return

    lost = wp.randf(rng) < sensor.dropout
    if sensor.shadow > 0.0 and is_hidden(depth_in, world, row, column, sensor.shadow):
        lost = True
    if sensor.edge_jump > 0.0:
        other = depth
        for side in range(4):
            step = 1 - 2 * (side % 2)
            neighbour = depth_behind(
                depth_in,
                world,
                row + step * (side // 2),
                column + step * (1 - side // 2),
                sensor.max_range,
            )
            if wp.abs(neighbour - depth) > wp.abs(other - depth):
                other = neighbour
        if wp.abs(other - depth) > sensor.edge_jump:
            chance = wp.randf(rng)
            if chance < sensor.edge_dropout:
                lost = True
            elif chance < sensor.edge_dropout + sensor.flying:
                depth += wp.randf(rng) * (other - depth)

    disparity = sensor.depth_disparity / depth
    if sensor.disparity_std > 0.0:
        disparity += sensor.disparity_std * wp.randn(rng)
    if sensor.disparity_step > 0.0:
        disparity = wp.floor(disparity / sensor.disparity_step + 0.5) * sensor.disparity_step
    if disparity <= 0.0:
        lost = True
    else:
        depth = sensor.depth_disparity / disparity
    if lost or depth < sensor.min_range or depth > sensor.max_range:
        depth = EMPTY
    measured_out[world, row, column] = depth


@wp.kernel
def forget_poses_kernel(
    # In:
    reset_in: wp.array[wp.int32],  # [N] 1 where a world was reset
    body_q_in: wp.array2d[wp.transform],  # [N, B] body poses in the world frame
    # Out:
    history_out: wp.array3d[wp.transform],  # [L, N, B] poses of past frames
):
    """Fill the past of the worlds that were reset with their present. Launch: [N, B]."""
    world, body = wp.tid()
    if reset_in[world] != 0:
        for slot in range(history_out.shape[0]):
            history_out[slot, world, body] = body_q_in[world, body]


@wp.kernel
def delay_poses_kernel(
    # In:
    frame_in: wp.array[int],  # [1] number of the present frame
    delay_in: wp.array[float],  # [N] age of the poses that are wanted [frame], 0 to L - 1
    body_q_in: wp.array2d[wp.transform],  # [N, B] body poses in the world frame
    # In/Out:
    history: wp.array3d[wp.transform],  # [L, N, B] poses of the last L frames, k in slot k mod L
    # Out:
    late_q_out: wp.array2d[wp.transform],  # [N, B] body poses in the world frame at that time
):
    """Record the present poses and give those of some frames ago, interpolated in between.

    Launch: [N, B].

    An image drawn from the poses of a past frame is that frame's image, and poses take far less
    memory.
    """
    world, body = wp.tid()
    slots = history.shape[0]
    frame = frame_in[0]
    history[frame % slots, world, body] = body_q_in[world, body]
    delay = wp.clamp(delay_in[world], 0.0, float(slots - 1))
    whole = int(wp.floor(delay))
    newer = history[(frame + slots - whole) % slots, world, body]
    older = history[(frame + slots - wp.min(whole + 1, slots - 1)) % slots, world, body]
    share = delay - float(whole)
    position = wp.lerp(
        wp.transform_get_translation(newer), wp.transform_get_translation(older), share
    )
    q = wp.transform_get_rotation(newer)
    p = wp.transform_get_rotation(older)
    if wp.dot(q, p) < 0.0:
        p = p * -1.0
    # Along the chord: between two control steps a link turns 0.65 rad at most, and the arc is 1
    # mrad away.
    late_q_out[world, body] = wp.transform(position, wp.normalize(q * (1.0 - share) + p * share))
