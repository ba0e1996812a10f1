"""The state as a policy sees it.

Of the present, or as old as the latencies that its episode has drawn.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from vd.envs.cfg import ReorientCfg
from vd.envs.task_state import TaskState
from vd.kernels.task.latency import (
    StateArrays,
    begin_latency_kernel,
    recall_state_kernel,
    record_state_kernel,
    ring_columns,
)


class SeenState:
    """What observations are made of; without latency these are the simulator's own arrays.

    Args:
        state: The task.

    Attributes:
        latency: How late each object is seen in its episode [s], shape [N].
        encoder_latency: How late joints and fingertips are [s], shape [N].
        slots, head: Rows of an environment in the ring of past states, and which was written last,
            int32, shape [N]; only where something is late.
        arrays: Joint positions and velocities as the encoders report them, positions and velocities
            of hand and object, poses and velocities of the links (of fingertips alone where they
            are late).
    """

    def __init__(self, state: TaskState):
        self._state = state
        sim = state.sim
        n = state.num_envs
        random = state.cfg.randomisation
        longest = max(
            random.observation_latency_s[1],
            random.encoder_latency_s[1],
            _oldest_pose_s(state.cfg),
        )
        self.is_late = random.enabled and longest > 0.0
        names = ("latency", "encoder_latency") if self.is_late else ("", "")
        self.latency, self.encoder_latency = (state.zeros(n, saved=name) for name in names)
        present = [
            state.measured_q,
            state.measured_qd,
            sim.joint_q,
            sim.joint_qd,
            sim.body_q,
            sim.body_qd,
        ]
        self.arrays: list[Any] = present
        if not self.is_late:
            return
        self.arrays = list(map(wp.zeros_like, present))
        d = state.num_joints
        f = state.num_fingers
        slots = math.ceil(longest / state.cfg.sim.physics_dt) + 1
        columns = ring_columns(d, sim.joint_q.shape[1], sim.joint_qd.shape[1], f)
        self._ring = state.zeros(n * slots, columns, saved="latency_ring")
        self.slots = slots
        self.head = state.zeros(n, dtype=wp.int32, saved="latency_head")
        self._model = [d, slots, state.fingers.tip_body]
        ranges = [random.observation_latency_s, random.encoder_latency_s]
        self._ranges = state.parameters.blended(np.zeros((2, 2)), ranges, wp.vec2)
        sim.after_physics_step = self.record

    def record(
        self, joint_q: wp.array, joint_qd: wp.array, body_q: wp.array, body_qd: wp.array
    ) -> None:
        """Remember the state after a physics step, shapes [N, *]. Device work only."""
        now = self._now(joint_q, joint_qd, body_q, body_qd)
        self._state.launch(record_state_kernel, [*self._model, now], [self.head, self._ring])

    def begin(self, mask: wp.array) -> None:
        """Draw the latencies of the environments of ``mask`` [N]; their past is their present state."""
        if not self.is_late:
            return
        state = self._state
        sim = self._state.sim
        now = self._now(sim.joint_q, sim.joint_qd, sim.body_q, sim.body_qd)
        state.launch(
            begin_latency_kernel,
            [*self._model, self._ranges, mask, now, state.rng],
            [self.latency, self.encoder_latency, self._ring],
        )

    def recall(self) -> None:
        """Refresh :attr:`arrays`."""
        if self.is_late:
            state = self._state
            ages = [state.cfg.sim.physics_dt, self.latency, self.encoder_latency]
            state.launch(
                recall_state_kernel,
                [*self._model, *ages, self.head, self._ring],
                [_packed(self.arrays)],
            )

    def _now(self, joint_q: wp.array, joint_qd: wp.array, *bodies: wp.array) -> StateArrays:
        """A state, with the joints as their encoders report them."""
        measured = (joint_q, joint_qd)
        servo = self._state.sim.servo
        if servo is not None:
            servo.measure()  # once a control step otherwise
            measured = servo.measured_q, servo.measured_qd
        return _packed([*measured, joint_q, joint_qd, *bodies])


def _oldest_pose_s(cfg: ReorientCfg) -> float:
    """Age of the oldest pose of a tracker that is looked up [s]: it comes late, within a step."""
    tracker = cfg.randomisation.tracked_pose
    if not tracker.enabled:
        return 0.0
    return tracker.age_s[1] + 1.0 / tracker.rate_hz[0] + cfg.sim.control_dt


def _packed(arrays: Sequence[wp.array]) -> StateArrays:
    """Arrays in the order of :attr:`SeenState.arrays`, as kernels take them."""
    packed = StateArrays()
    names = "measured_q", "measured_qd", "joint_q", "joint_qd", "body_q", "body_qd"
    for name, array in zip(names, arrays, strict=True):
        setattr(packed, name, array)
    return packed
