"""The object's pose in what is observed, as a tracker outside tells it."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from vd.envs.latency import SeenState
from vd.envs.task_state import TaskState
from vd.kernels.task.tracked_pose import (
    begin_tracked_pose_kernel,
    hold_pose_kernel,
    take_pose_kernel,
)


class TrackedPose:
    """A tracker of each environment. Nothing where there is to be none.

    Args:
        state: The task.
        seen: The past, from which poses are taken, and whose latency follows the tracker.
    """

    def __init__(self, state: TaskState, seen: SeenState):
        self._state = state
        self._seen = seen
        random = state.cfg.randomisation
        self.is_tracked = random.enabled and random.tracked_pose.enabled
        if not self.is_tracked:
            return
        self._params = state.parameters.tracked_pose
        n = state.num_envs
        zeros = state.zeros
        self._rate = zeros(n, saved="tracked_rate")
        self._delay = zeros(n, saved="tracked_delay")
        self._clock = zeros(n, saved="tracked_clock")
        self._due = zeros(n, saved="tracked_due")
        self._head = zeros(n, dtype=wp.int32, saved="tracked_head")
        self._came = zeros(n, dtype=wp.int32, saved="tracked_came")
        self._held_s = zeros(n, saved="tracked_held_s")
        self._held = zeros(n, dtype=wp.transform, saved="tracked_held")
        self._twist = zeros(n, dtype=wp.spatial_vector, saved="tracked_twist")
        self._joint_q = wp.zeros_like(state.sim.joint_q)
        self._joint_qd = wp.zeros_like(state.sim.joint_qd)

    def begin(self, mask: wp.array) -> None:
        """Draw the trackers of the environments of ``mask`` [N], after their past was begun."""
        if self.is_tracked:
            drawn = [self._rate, self._delay, self._clock, self._head, self._due, self._held_s]
            self._state.launch(
                begin_tracked_pose_kernel,
                [self._params, mask, self._seen.head, self._state.rng],
                [*drawn, self._seen.latency, self._came],
            )

    def take(self) -> None:
        """Age of the newest pose, by which the past is recalled next. Device work only."""
        if self.is_tracked:
            settings = [self._params, self._seen.slots, self._state.cfg.sim.physics_dt]
            changing = [self._head, self._clock, self._due, self._seen.latency, self._came]
            self._state.launch(
                take_pose_kernel,
                [*settings, self._rate, self._delay, self._seen.head],
                [self._state.rng, *changing],
            )

    def hold(self, seen: Sequence[Any]) -> Sequence[Any]:
        """What is seen (``SeenState.arrays``), with the pose that is held. Device work only."""
        if not self.is_tracked:
            return seen
        measured_q, measured_qd, joint_q, joint_qd, *bodies = seen
        kept = [self._came, self._held_s, self._held, self._twist]
        self._state.launch(
            hold_pose_kernel,
            [self._params, self._clock, self._seen.latency, joint_q, joint_qd],
            [self._state.rng, *kept, self._joint_q, self._joint_qd],
        )
        return [measured_q, measured_qd, self._joint_q, self._joint_qd, *bodies]
