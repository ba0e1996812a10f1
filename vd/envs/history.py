"""The past of the joints in what is observed."""

import warp as wp

from vd.envs.task_state import TaskState
from vd.kernels.task.history import push_history_kernel
from vd.kernels.task.observations import teacher_observation_slices


class JointHistory:
    """Appends what the joints tell to the history part of observations. Nothing where there is none.

    Args:
        state: The task.
        parts: Columns of what is observed.
    """

    def __init__(self, state: TaskState, parts: dict[str, slice]):
        self._state, self._parts = state, parts
        self._fresh = state.zeros(state.num_envs, dtype=wp.int32)

    def begin(self, mask: wp.array) -> None:
        """Forget the past of the environments of ``mask`` [N]. Device work only."""
        wp.copy(self._fresh, mask)

    def push(self, values: wp.array) -> None:
        """Append the joints of the state in ``values`` [N, A] to the history in it. Device work only."""
        if "history" not in self._parts:
            return
        state = self._state
        inside = teacher_observation_slices(state.num_fingers, state.num_joints)
        first = self._parts["state"].start
        columns = [first + inside[name].start for name in ("joint_position", "previous_action")]
        settings = [*columns, state.num_joints, state.cfg.observation.history, self._fresh]
        state.launch(
            push_history_kernel,
            [values, *settings, self._parts["history"].start],
            [values],
            dim=(state.num_envs, 2 * state.num_joints),
        )
        self._fresh.zero_()
