"""Inverse weights of bodies, by which the solver scales the softness of their contacts.

N environments, B bodies.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LEAST_LEVER_M = 1e-5
"""Distance between a centre of mass and all joint axes that move it, below which it is rounding
[m].
"""


@wp.kernel
def inverse_weights_kernel(
    # In/Out:
    weight: wp.array2d[wp.vec2],  # [N, B] of translation [1/kg] and rotation [1/(kg m2)], pose zero
):
    """Give bodies that only turn about their centre of mass the weight of rotation. Launch: [N, B].

    The solver does so where that of translation is 0. Of a link whose centre of mass lies on its
    axes it is 1e-15, with luck less: with more a contact with the palm is 1e15 times too stiff, and
    ends in NaN.
    """
    world, body = wp.tid()
    both = weight[world, body]
    if both[0] < LEAST_LEVER_M * LEAST_LEVER_M * both[1]:
        weight[world, body] = wp.vec2(both[1], both[1])
