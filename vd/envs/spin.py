"""Turning about an axis: its reward, and how far the object has turned."""

import numpy as np
import warp as wp

from vd.envs.task_state import TaskState
from vd.kernels.task.spin import SpinParams, begin_spin_kernel, spin_kernel


class Spin:
    """Measures and rewards turning in N environments.

    Args:
        state: The task.
        first: Column of its first term among those of the reward.

    Attributes:
        turned: Angle by which the object has turned about the axis in its episode [rad], shape
            [N]; of the one that ended until environments are reset.
    """

    def __init__(self, state: TaskState, first: int):
        self._state, self._first = state, first
        cfg = state.cfg.reward.spin
        params = SpinParams()
        params.axis = wp.vec3(*(np.array(cfg.axis) / np.linalg.norm(cfg.axis)))
        params.clip = cfg.clip_rad_s
        params.rate = cfg.rate
        params.object_speed = cfg.object_speed
        params.posture = cfg.posture
        params.torque = cfg.torque
        params.scale = state.cfg.reward.scale
        params.dt = state.cfg.sim.control_dt
        self._params = wp.array([params], dtype=SpinParams, device=state.device)
        self._start = wp.array(state.hand.start, dtype=float, device=state.device)
        n = state.num_envs
        self._before = state.zeros(n, dtype=wp.transform, saved="spin_before")
        self.turned = state.zeros(n, saved="spin_turned")

    def begin(self, mask: wp.array) -> None:
        """Begin where ``mask`` [N] is set, once those environments are reset. Device work only."""
        state = self._state
        state.launch(
            begin_spin_kernel,
            [mask, state.sim.joint_q, state.num_joints],
            [self._before, self.turned],
        )

    def pay(self, reward: wp.array, terms: wp.array) -> None:
        """Add what a control step is worth to ``reward`` [N], its terms to ``terms`` [N, T].

        Device work only.
        """
        state = self._state
        inputs = [self._params, self._start, state.sim.joint_q, state.fingers.effort, self._first]
        state.launch(spin_kernel, inputs, [self._before, self.turned, reward, terms])
