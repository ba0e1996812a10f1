"""Synthetic point clouds: surface samples carried by links, object and goal, in the hand's base frame.

Metres, quaternions xyzw. N worlds, B bodies a world, H samples of the hand, K samples of each object;
R rows, one cloud each: of all worlds at one time, or of any worlds at any times, from recorded poses.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class CloudModel:
    """What the points are sampled from; constant while the simulation runs.

    hand_points: Samples of the hand, each in the frame of its link [H] [m].
    hand_body: Link of each sample, an index within a world [H].
    object_points: Samples of each object in its frame, unscaled [O, K] [m].
    goal_points: Those by which its goal is shown [O, K] [m].
    world_object: Object of each world [N].
    world_scale: Size factor of each world's object [N].
    base_body: The hand's base, an index within a world.
    object_body: The object, an index within a world.
    goal_position: Where the goal's cloud is shown, base frame [m].
    """

    hand_points: wp.array[wp.vec3]
    hand_body: wp.array[int]
    object_points: wp.array2d[wp.vec3]
    goal_points: wp.array2d[wp.vec3]
    world_object: wp.array[int]
    world_scale: wp.array[float]
    base_body: int
    object_body: int
    goal_position: wp.vec3


@wp.kernel
def link_points_kernel(
    # Model:
    model: CloudModel,
    # In:
    world_in: wp.array[int],
    body_q_in: wp.array2d[wp.transform],
    goal_quat_in: wp.array[wp.quat],
    # Out:
    points_out: wp.array2d[wp.vec3],
):
    """Carry every sample into the hand's base frame: P' = P R^T + p. Launch: [R, K + H] or [R, K + H + K].

    Columns are the goal's samples, then the hand's, then the object's: the shorter launch leaves the
    object out, for a camera to see it instead. Links and object are posed as in the simulation; the
    goal's cloud is the object turned to the wanted orientation, at a fixed place beside the scene.

    Args:
        model: The samples.
        world_in: World of each row, shape [R].
        body_q_in: Body poses of each row in the world frame, shape [R, B].
        goal_quat_in: Wanted orientation of the object in the world frame, shape [R].
        points_out: Points in the base frame [m], shape [R, *]; columns beyond the launch stay.
    """
    row, column = wp.tid()
    world = world_in[row]
    to_base = wp.transform_inverse(body_q_in[row, model.base_body])
    hand, samples = model.hand_points.shape[0], model.object_points.shape[1]
    if column >= samples and column < samples + hand:
        sample = column - samples
        link = wp.transform_multiply(to_base, body_q_in[row, model.hand_body[sample]])
        points_out[row, column] = wp.transform_point(link, model.hand_points[sample])
        return
    if column < samples:
        point = model.world_scale[world] * model.goal_points[model.world_object[world], column]
        turn = wp.transform_get_rotation(to_base) * goal_quat_in[row]
        points_out[row, column] = model.goal_position + wp.quat_rotate(turn, point)
    else:
        sample = column - samples - hand
        point = model.world_scale[world] * model.object_points[model.world_object[world], sample]
        item = wp.transform_multiply(to_base, body_q_in[row, model.object_body])
        points_out[row, column] = wp.transform_point(item, point)
