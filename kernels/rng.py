"""Random streams: one 32-bit state per world, kept in device memory.

A kernel reads its world's state at the start, draws from it, and writes :func:`next_stream` of it
at the end. Warp passes ``rng`` states to its own generators by reference but to user functions by
value, so a function that draws returns the advanced state first: ``rng, value = function(rng)``.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def next_stream(rng: wp.uint32, world: int) -> wp.uint32:
    """State to store for the next kernel.

    Warp's generator walks one permutation of the 32-bit integers, so thousands of worlds that only
    walked on would soon repeat each other's numbers. Hashing the world in gives each its own walk.
    """
    return wp.rand_init(int(rng), world)


@wp.func
def uniform(rng: wp.uint32, bounds: wp.vec2):
    """Draw uniformly from ``bounds`` = (low, high); returns ``(rng, value)``."""
    value = wp.randf(rng, bounds[0], bounds[1])
    return rng, value


@wp.kernel
def init_rng_kernel(
    # In:
    seed: int,
    # Out:
    rng_out: wp.array[wp.uint32],
):
    """Start the stream of every world, shape [N], from one seed. Launch: [N]."""
    world = wp.tid()
    rng_out[world] = wp.rand_init(seed, world)
