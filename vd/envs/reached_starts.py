"""Episodes that begin in states which the policy reached itself, with the object off the table."""

from collections.abc import Mapping

import warp as wp

from vd.envs.task_state import TaskState
from vd.kernels.task.reached_starts import (
    choose_kept_kernel,
    choose_start_kernel,
    keep_rows_kernel,
    put_rows_kernel,
)
from vd.paper import PAPER

SLOTS = 4
"""States of each environment (ours, not tuned): of an object as many as it has environments, times
this."""
KEPT_SHARE = 0.05
"""Of the states that qualify (ours, not tuned): one in 1.7 s, so that they come from many moments."""
HELD_M_S, HELD_RAD_S = 0.1, 2.0
"""Speed and spin of an object that is held or turned slowly; one that falls is faster within a
control step."""


class ReachedStarts:
    """A ring of states of each environment, of which new episodes begin in some.

    An environment gets only states of its own back: they fit its object, its size and its masses.

    Args:
        state: The task.
        motion: What the motion goes on from, arrays with N rows, see ``ReorientEnv.motion``.

    Attributes:
        reset: 1 where an episode begins as usual, after :meth:`begin`, int32, shape [N].
    """

    def __init__(self, state: TaskState, motion: Mapping[str, wp.array]):
        self._state = state
        n = state.num_envs
        self.reset = state.zeros(n, dtype=wp.int32)
        self._slot = state.zeros(n, dtype=wp.int32)
        self._count = state.zeros(n, dtype=wp.int32, saved="reached_count")
        self._rows = {name: _rows(array, n) for name, array in motion.items()}
        self._kept = {
            name: state.zeros(n, SLOTS, rows.shape[1], dtype=wp.int32, saved=f"reached_{name}")
            for name, rows in self._rows.items()
        }

    def keep(self, ended: wp.array, step_count: wp.array) -> None:
        """Keep some of the states that qualify, before resets. Device work only."""
        state, sim = self._state, self._state.sim
        state.launch(
            choose_kept_kernel,
            [
                KEPT_SHARE,
                HELD_M_S,
                HELD_RAD_S,
                PAPER.reward.table_contact_force_n,
                state.num_joints,
                ended,
                step_count,
                state.parameters.table_steps,
                sim.table_force,
                sim.failed,
                sim.joint_qd,
                SLOTS,
                self._count,
                state.rng,
            ],
            [self._slot],
        )
        for name, rows in self._rows.items():
            state.launch(keep_rows_kernel, [self._slot, rows], [self._kept[name]], dim=rows.shape)

    def begin(self, ended: wp.array, new_goal: wp.array, step_count: wp.array) -> None:
        """Put states back into a share of the environments of ``ended`` [N]. Device work only.

        These get a goal by ``new_goal`` [N]; :attr:`reset` says where to reset as usual.
        """
        state = self._state
        state.launch(
            choose_start_kernel,
            [
                state.cfg.start.reached_share,
                SLOTS,
                ended,
                self._count,
                new_goal,
                step_count,
                state.rng,
            ],
            [self._slot, self.reset],
        )
        for name, rows in self._rows.items():
            state.launch(put_rows_kernel, [self._slot, self._kept[name], rows], [], dim=rows.shape)


def _rows(array: wp.array, count: int) -> wp.array:
    """An array of numbers of 32 bits as rows of integers [count, C], in the same memory."""
    columns = array.capacity // (4 * count)
    return wp.array(
        ptr=array.ptr, dtype=wp.int32, shape=(count, columns), device=array.device, copy=False
    )
