"""Actions of a hand in which joints follow others: those of A actuated joints as those of all D."""

import numpy as np
import warp as wp

from vd.envs.task_state import TaskState
from vd.kernels.task.symmetry import world_action_kernel


class ActuatedActions:
    """Gives each joint its action; joints that follow another have none, which is 0."""

    def __init__(self, state: TaskState):
        """Put the columns of the actions on the device."""
        self._state = state
        hand = state.hand
        self._full: wp.array | None = None
        if len(hand.actuated) == hand.num_joints:
            return
        moves = hand.mimic < 0
        columns = np.where(moves, np.cumsum(moves) - 1, 0)
        self._columns = wp.array(columns[None], dtype=wp.int32, device=state.device)
        self._moves = wp.array(moves[None], dtype=float, device=state.device)
        self._frame = state.zeros(state.num_envs, dtype=wp.int32)
        self._full = state.zeros(state.num_envs, hand.num_joints)

    def all_joints(self, action: wp.array) -> wp.array:
        """Actions of all joints [N, D], of those of actuated ones [N, A]. Device work only."""
        if self._full is None:
            return action
        inputs = [self._columns, self._moves, self._frame, action]
        self._state.launch(world_action_kernel, inputs, [self._full], dim=self._full.shape)
        return self._full
