"""Candidate pairs by the kinds of their shapes, against NumPy's stable sort."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, SENTINEL, device_array, launch, unwritten

from vd.kernels.pair_order import KEY_BITS, pair_key_kernel, reorder_pairs_kernel

GEOMS = 30


@EXAMPLES
@given(seed=st.integers(0, 2**31), most=st.integers(1, 300), fill=st.floats(0.0, 1.5))
def test_pairs_are_sorted_by_kind_and_else_as_they_were(device, seed, most, fill):
    """Also where more were found than there is room for."""
    rng, count = np.random.default_rng(seed), round(fill * most)
    kinds, pairs = rng.integers(0, 8, GEOMS), rng.integers(0, GEOMS, (most, 2))
    ids, worlds = rng.integers(-1, 50, (most, 2)), rng.integers(0, 9, most)
    found = [device_array(values, wp.vec2i, device) for values in (pairs, ids)]
    world, counted = device_array(worlds, int, device), device_array(np.array([count]), int, device)
    key, order = (unwritten(2 * most, int, device) for _ in range(2))
    inputs = [device_array(kinds, int, device), counted, found[0]]
    launch(pair_key_kernel, most, [*inputs, key, order], device)
    wp.utils.radix_sort_pairs(key, order, most, end_bit=KEY_BITS)
    out = [unwritten(most, dtype, device) for dtype in (wp.vec2i, wp.vec2i, int)]
    launch(reorder_pairs_kernel, most, [counted, order, *found, world, *out], device)
    there = min(count, most)
    expected = np.argsort((kinds[pairs[:there, 0]] * 8 + kinds[pairs[:there, 1]]), kind="stable")
    for values, given_ in zip((pairs, ids, worlds), out, strict=True):
        np.testing.assert_array_equal(given_.numpy()[:there], values[expected])
        assert (given_.numpy()[there:] == SENTINEL).all(), "what is behind the last stays"
