"""Errors of the object's pose in what is observed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from vd.envs.task_state import TaskState
from vd.kernels.task.pose_error import draw_pose_error_kernel, mistake_pose_kernel


class PoseError:
    """The same error of the object's pose all through an episode.

    Nothing where there is to be none.

    Args:
        state: The task.
    """

    def __init__(self, state: TaskState):
        self._state = state
        random = state.cfg.randomisation
        self.is_wrong = random.enabled and max(random.object_pose_error) > 0.0
        if self.is_wrong:
            sizes = [random.object_pose_error]
            self._size = state.parameters.blended(np.zeros((1, 2)), sizes, wp.vec2)
            self._error = state.zeros(state.num_envs, dtype=wp.transform, saved="pose_error")
            self._believed = wp.zeros_like(state.sim.joint_q)

    def begin(self, mask: wp.array) -> None:
        """Draw the errors of the environments of ``mask`` [N]."""
        if self.is_wrong:
            self._state.launch(
                draw_pose_error_kernel, [self._size, mask, self._state.rng], [self._error]
            )

    def apply(self, seen: Sequence[Any]) -> Sequence[Any]:
        """What is seen (``SeenState.arrays``), with the errors. Device work only."""
        if not self.is_wrong:
            return seen
        measured_q, measured_qd, joint_q, *others = seen
        self._state.launch(mistake_pose_kernel, [self._error, joint_q], [self._believed])
        return [measured_q, measured_qd, self._believed, *others]
