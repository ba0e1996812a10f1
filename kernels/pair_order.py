"""Order of the solver's candidate pairs.

By the kinds of their shapes, so that threads beside do the same.

P pairs at most, of which the first few are there; G geoms.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

KINDS = 8
"""Kinds of shapes that a key has room for: MuJoCo's from planes to meshes, all but signed distance
fields.
"""
KEY_BITS = 7
"""Bits of a key: three for either kind, and one more for what is no pair."""
NO_PAIR = 2**KEY_BITS - 1
"""Key of what is no pair: after all others."""


@wp.kernel
def pair_key_kernel(
    # Model:
    geom_type: wp.array[int],  # [G] kind of each geom (``mjtGeom``), below :data:`KINDS`
    # In:
    pair_count: wp.array[int],  # [1] number of pairs; it may be more than P
    pair_in: wp.array[wp.vec2i],  # [P] the two geoms of each pair
    # Out:
    key_out: wp.array[int],  # [>= P] key of each pair, :data:`NO_PAIR` behind the last
    order_out: wp.array[int],  # [>= P] 0, 1, ...
):
    """Keys to sort candidate pairs by, and their order as it is. Launch: [P]."""
    pair = wp.tid()
    key = int(NO_PAIR)
    if pair < pair_count[0]:
        geoms = pair_in[pair]
        key = KINDS * geom_type[geoms[0]] + geom_type[geoms[1]]
    key_out[pair] = key
    order_out[pair] = pair


@wp.kernel
def reorder_pairs_kernel(
    # In:
    pair_count: wp.array[int],  # [1] number of pairs; it may be more than P
    order_in: wp.array[int],  # [>= P] which pair comes at each place
    pair_in: wp.array[wp.vec2i],  # [P] the two geoms of each pair
    pair_id_in: wp.array[wp.vec2i],  # [P] what the solver knows each pair by
    world_in: wp.array[int],  # [P] world of each pair
    # Out:
    pair_out: wp.array[wp.vec2i],  # [P] geoms in the new order; what is behind the last pair stays
    pair_id_out: wp.array[wp.vec2i],  # the same of what the solver knows them by
    world_out: wp.array[int],  # the same of their worlds
):
    """Put pairs into an order. Launch: [P]."""
    place = wp.tid()
    if place >= pair_count[0]:
        return
    pair = order_in[place]
    pair_out[place] = pair_in[pair]
    pair_id_out[place] = pair_id_in[pair]
    world_out[place] = world_in[pair]
