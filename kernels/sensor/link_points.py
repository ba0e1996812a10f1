"""Synthetic point clouds: surface samples carried by links, object and goal, in the hand's base frame.

Metres, quaternions xyzw. N worlds, B bodies a world, H samples of the hand, K samples of each object;
R rows, one cloud each: of all worlds at one time, or of any worlds at any times, from recorded poses.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class CloudModel:
    """What the points are sampled from; constant while the simulation runs."""

    hand_points: wp.array[wp.vec3]  # [H] samples of the hand, each in the frame of its link [m]
    hand_body: wp.array[int]  # [H] link of each sample, an index within a world
    object_points: wp.array2d[wp.vec3]  # [O, K] samples of each object in its frame, unscaled [m]
    goal_points: wp.array2d[wp.vec3]  # [O, K] those by which its goal is shown [m]
    world_object: wp.array[int]  # [N] object of each world
    world_scale: wp.array[float]  # [N] size factor of each world's object
    base_body: int  # the hand's base, an index within a world
    object_body: int  # the object, an index within a world
    goal_position: wp.vec3  # where the goal's cloud is shown, base frame [m]


@wp.kernel
def link_points_kernel(
    # Model:
    model: CloudModel,  # the samples
    # In:
    world_in: wp.array[int],  # [R] world of each row
    body_q_in: wp.array2d[wp.transform],  # [R, B] body poses of each row in the world frame
    goal_quat_in: wp.array[wp.quat],  # [R] wanted orientation of the object in the world frame
    # Out:
    points_out: wp.array2d[wp.vec3],  # [R, *] points in the base frame [m]; columns beyond the launch stay
):
    """Carry every sample into the hand's base frame: P' = P R^T + p. Launch: [R, K + H] or [R, K + H + K].

    Columns are the goal's samples, then the hand's, then the object's: the shorter launch leaves the
    object out, for a camera to see it instead. Links and object are posed as in the simulation; the
    goal's cloud is the object turned to the wanted orientation, at a fixed place beside the scene.
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
