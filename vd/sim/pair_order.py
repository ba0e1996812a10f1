"""Candidate pairs of shapes, sorted by kind between the solver's broad and narrow phase.

The broad phase lists pairs as it finds them, world by world, and the narrow phase has a kernel for
each combination of kinds, which passes over all of them: of the threads of a warp few have a pair
of its kind, and the others wait. Sorted, nearly all of a warp have one, or none. Contacts are the
same.
"""

from typing import Any

import warp as wp
from mujoco_warp import Data
from mujoco_warp._src import collision_driver

from vd.kernels.launch import launch
from vd.kernels.pair_order import KEY_BITS, KINDS, pair_key_kernel, reorder_pairs_kernel

_in_order_found = collision_driver._narrowphase


class PairOrder:
    """Sorts the candidate pairs of one solver's data, on its device and without waiting for it."""

    def __init__(self, data: Data):
        """Make room for all pairs that the data has room for."""
        self._most = data.naconmax

        def room(count: int, dtype: type) -> wp.array:
            return wp.zeros(count, dtype=dtype, device=data.geom_xpos.device)

        # Sorting needs as much room again.
        self._key = room(2 * self._most, wp.int32)
        self._order = room(2 * self._most, wp.int32)
        self._pair = room(self._most, wp.vec2i)
        self._pair_id = room(self._most, wp.vec2i)
        self._world = room(self._most, wp.int32)

    def sort(self, model: Any, data: Data, found: Any) -> None:
        """Put the pairs that the broad phase ``found`` into order; its arrays are replaced."""
        listed = [model.geom_type, data.ncollision, found.collision_pair]
        launch(pair_key_kernel, self._most, listed, [self._key, self._order])
        wp.utils.radix_sort_pairs(self._key, self._order, self._most, end_bit=KEY_BITS)
        pairs = [found.collision_pair, found.collision_pairid, found.collision_worldid]
        ordered = [self._pair, self._pair_id, self._world]
        launch(reorder_pairs_kernel, self._most, [data.ncollision, self._order, *pairs], ordered)
        found.collision_pair, found.collision_pairid, found.collision_worldid = ordered


def sort_pairs(model: Any, data: Data) -> None:
    """Let the candidate pairs of a solver's data be sorted from now on.

    Args:
        model: MuJoCo Warp's model.
        data: Its data, whose ``naconmax`` stays.

    Raises:
        ValueError: The model has shapes of kinds that a key has no room for.
    """
    if int(model.geom_type.numpy().max(initial=0)) >= KINDS:
        raise ValueError(
            "pairs with signed distance fields cannot be sorted; make their shapes meshes"
        )
    # The solver has no place for it between the phases: a function of its module is replaced, for
    # all data.
    collision_driver._narrowphase = _narrowphase
    data.pair_order = PairOrder(data)


def _narrowphase(model: Any, data: Data, found: Any) -> None:
    order: PairOrder | None = getattr(data, "pair_order", None)
    if order is not None:
        order.sort(model, data, found)
    _in_order_found(model, data, found)
