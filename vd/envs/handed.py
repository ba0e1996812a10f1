"""Episodes that begin in the air: the grasps in which goals were reached, and environments that get them."""

import numpy as np
import warp as wp

from vd.envs.setup import chosen
from vd.envs.task_state import TaskState
from vd.kernels.task.resets import hand_over_kernel

GRASPS = 8
"""Grasps that an environment remembers (ours): some variety, and a fall in each forgets them all. Chosen, not
tuned: half and twice have not been tried."""


class HandedOver:
    """Remembers grasps of the environments of ``table.handed_share``, and lets their episodes begin in them.

    Args:
        state: The task.
        reset_q: Hand joints after a reset [rad], shape [D].
        table_steps: Control steps for which each table stays, shape [N].
    """

    def __init__(self, state: TaskState, reset_q: wp.array, table_steps: wp.array):
        self._state = state
        handed = chosen(state.cfg, state.cfg.table.handed_share)
        self._model = [reset_q, wp.array(handed, dtype=wp.int32, device=state.device), table_steps]
        self._grasps = state.zeros(state.num_envs, GRASPS, 2 * state.num_joints + 7)
        self._count = state.zeros(state.num_envs, dtype=wp.int32)

    def hand_over(self, success: wp.array, fell: wp.array, reset: wp.array, step_count: wp.array) -> None:
        """Remember, and write the states in which episodes begin; arguments as of :func:`hand_over_kernel`.

        The joint targets become those of a grasp, or of the hand after a reset. Device work only.
        """
        sim = self._state.sim
        own = [self._grasps, self._count, sim.joint_q, sim.target, self._state.rng]
        ends = [success, fell, sim.failed]
        self._state.launch(hand_over_kernel, [*self._model, *ends], [reset, step_count, *own])

    def stateful(self) -> dict[str, wp.array]:
        """Arrays to save with a checkpoint, by name."""
        return {"grasps": self._grasps, "grasp_count": self._count}


def success_ends(state: TaskState) -> wp.array:
    """1 where a success ends the episode, int32, shape [N]."""
    cfg = state.cfg
    goes_on = chosen(cfg, cfg.table.handed_share)
    ends = np.where(goes_on, 0, int(cfg.success_ends_episode))
    return wp.array(ends, dtype=wp.int32, device=state.device)
