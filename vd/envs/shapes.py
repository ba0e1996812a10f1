"""The shapes of the objects: their points on the device, what a teacher sees of them, how high they are."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from vd.envs.task_state import TaskState
from vd.kernels.task.observations import teacher_observation_size
from vd.kernels.task.shapes import (
    ORIENTATIONS,
    clearance_kernel,
    extent_directions,
    extent_kernel,
    shape_observation_slices,
    surface_kernel,
)
from vd.paper import PAPER


class ShapeObserver:
    """Writes the columns of ``vd.kernels.task.shapes`` behind the state, and how high the objects are.

    Args:
        state: The task.
    """

    def __init__(self, state: TaskState):
        self._state = state
        self._objects = [state.surface_points, state.world_object, state.world_scale]
        self._directions = wp.array(extent_directions(state.num_fingers), dtype=wp.vec3, device=state.device)
        first = teacher_observation_size(state.num_fingers)
        slices = shape_observation_slices(state.num_fingers)
        self._surface_column = first + slices["surface"].start
        self._extent_column = first + slices["extent"].start

    def measure_clearance(self, out: wp.array) -> None:
        """Write the heights of the objects' lowest points above the table [m] into ``out``, shape [N]."""
        state = self._state
        state.launch(
            clearance_kernel,
            [
                *self._objects,
                state.num_actions,
                PAPER.scene.table_top_m,
                state.sim.joint_q,
            ],
            [out],
        )

    def launch(self, seen: Sequence[Any], out: wp.array) -> None:
        """Write the values of a state (``SeenState.arrays``), and of the goal, to ``out``, shape [N, *]."""
        state = self._state
        _, _, joint_q, _, body_q, _ = seen
        state.launch(
            surface_kernel,
            [
                *self._objects,
                state.fingers.tip_body,
                state.fingers.tip_offset,
                state.num_actions,
                self._surface_column,
                joint_q,
                body_q,
            ],
            [out],
            dim=(state.num_envs, state.num_fingers),
        )
        state.launch(
            extent_kernel,
            [
                *self._objects,
                self._directions,
                state.num_actions,
                self._extent_column,
                joint_q,
                state.goal_quat,
            ],
            [out],
            dim=(state.num_envs, ORIENTATIONS, len(self._directions)),
        )
