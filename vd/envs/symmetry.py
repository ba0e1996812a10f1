"""The symmetry frames of :mod:`vd.kernels.task.symmetry` in the environments of a task.

Their launches.
"""

import warp as wp

from vd.envs.symmetry_frames import symmetry_frames
from vd.envs.task_state import TaskState
from vd.kernels.task.symmetry import (
    choose_frame_kernel,
    frame_observation_kernel,
    world_action_kernel,
)


class ChosenFrames:
    """The symmetry frame of each environment, and what the policy sees and does in it.

    Attributes:
        tables: What they are made of.
        chosen: Symmetry frame of each environment, from 0, shape [N].
        observation: Observation in the world frame, shape [N, A]; what its frames show goes to
            ``out``.
    """

    def __init__(self, state: TaskState, out: wp.array):
        """Put the tables of the hand on the device.

        Args:
            state: The task.
            out: Where the observation is written as its frames show it, shape [N, A].

        Raises:
            ValueError: The hand has no such frames, see
                :func:`vd.envs.symmetry_frames.symmetry_frames`.
        """
        self._state = state
        self._out = out
        device = state.device
        envs = state.num_envs
        seen = state.cfg.observation
        tables = self.tables = symmetry_frames(state.hand, seen, seen.view)
        chosen_from = seen.num_frames(state.num_fingers)
        self._source = wp.array(tables.source, dtype=wp.int32, device=device)
        self._factor = wp.array(tables.factor, dtype=float, device=device)
        self._joints = wp.array(tables.joints, dtype=wp.int32, device=device)
        self._offset = wp.array(tables.offset, dtype=float, device=device)
        self._sign = wp.array(tables.sign, dtype=float, device=device)
        self._sector = wp.array(tables.sector[:chosen_from], dtype=wp.vec3, device=device)
        self._action = wp.zeros((envs, state.num_joints), dtype=float, device=device)
        self.chosen = state.zeros(envs, dtype=wp.int32, saved="view")
        self.observation = wp.zeros_like(out)

    def choose(self, reset: wp.array, new_goal: wp.array) -> None:
        """Choose anew for environments in which either mask, shape [N], is set."""
        state = self._state
        state.launch(
            choose_frame_kernel,
            [self._sector, state.num_joints, reset, new_goal, state.sim.joint_q, state.goal_quat],
            [self.chosen],
        )

    def observe(self) -> None:
        """Write the observation in the present frames."""
        self._state.launch(
            frame_observation_kernel,
            [self._source, self._factor, self._offset, self.chosen, self.observation],
            [self._out],
            dim=self._out.shape,
        )

    def world_action(self, action: wp.array, out: wp.array | None = None) -> wp.array:
        """Action of the frames, shape [N, D], with the joints in the world's order.

        In ``out`` if given.
        """
        out = self._action if out is None else out
        self._state.launch(
            world_action_kernel,
            [self._joints, self._sign, self.chosen, action],
            [out],
            dim=action.shape,
        )
        return out
