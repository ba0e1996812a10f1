"""Point clouds of hands: samples carried by their links, in the frame of the base.

Metres, quaternions xyzw. R rows, one cloud each; B bodies a row, H samples of the hand.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def link_points_kernel(
    # Model:
    points: wp.array[wp.vec3],  # [H] samples of the hand, each in the frame of its link [m]
    body: wp.array[int],  # [H] link of each sample, a column of ``body_q_in``
    base_body: int,  # the hand's base, likewise
    # In:
    body_q_in: wp.array2d[wp.transform],  # [R, B] poses in the world frame
    # Out:
    points_out: wp.array2d[wp.vec3],  # [R, H] points in the base frame [m]
):
    """Carry every sample into the hand's base frame: P' = P R^T + p. Launch: [R, H]."""
    row, sample = wp.tid()
    to_base = wp.transform_inverse(body_q_in[row, base_body])
    link = wp.transform_multiply(to_base, body_q_in[row, body[sample]])
    points_out[row, sample] = wp.transform_point(link, points[sample])
