"""The hand in Newton as the plant behind the twin's motors, on the CPU, over a table.

One world, stepped at the simulator's physics rate in as many steps as the time that passed holds.
"""

from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
import warp as wp

from vd.assets_usd.hand_model import HandModel
from vd.deploy.joints import Joints
from vd.deploy.plant import P_GAIN_UNIT, Drive
from vd.kernels.actions import limit_joint_velocity_kernel
from vd.paper import PAPER
from vd.sim.cfg import SimCfg
from vd.sim.scene import add_table, build_hand, new_builder
from vd.sim.simulator import make_solver

LONGEST_S = 0.1
"""Time that is simulated at once at most: after a longer pause the hand is where it was."""


class NewtonHand:
    """A simulated hand; its axes are the motors', in the joints' order.

    A motor at the paper's position gain has the hand's identified stiffness and damping; its stiffness grows
    with the gain. With its torque off a joint has neither.

    Args:
        hand: The hand.
        joints: Which motor turns which joint, and how.
        cfg: Physics.
    """

    def __init__(self, hand: HandModel, joints: Joints, cfg: SimCfg | None = None):
        """Build the world, with the hand in the task's reset pose."""
        self.hand, self.joints, self.cfg = hand, joints, cfg or SimCfg()
        world = build_hand(hand, self.cfg, visuals=False)
        add_table(world, self.cfg, visible=False)
        builder = new_builder()
        builder.add_world(world)
        self._model = builder.finalize(device="cpu")
        self._solver = make_solver(self._model, self.cfg)
        self._state, self._next = self._model.state(), self._model.state()
        self._control = self._model.control()
        start = np.tile(PAPER.scene.reset_joint_rad, hand.num_fingers).astype(np.float32)
        self._state.joint_q.assign(start)
        self._target = start
        self._limits = wp.zeros(len(start), dtype=float, device="cpu")
        self._rest = 0.0
        self._gains: tuple[tuple[float, float], ...] = ()
        self._graph = self._capture()

    def _capture(self) -> Any:
        """Two physics steps as one recorded launch, which takes a tenth of the time.

        The launches of a step one by one would take most of its time, and hold the interpreter, which the
        thread that answers packets needs. Two, because states swap; they end where they began.
        """
        q, qd = wp.clone(self._state.joint_q), wp.clone(self._state.joint_qd)
        self._two_steps()  # loads kernels and allocates
        with wp.ScopedCapture(device="cpu") as capture:
            self._two_steps()
        wp.copy(self._state.joint_q, q)
        wp.copy(self._state.joint_qd, qd)
        return capture.graph

    def _two_steps(self) -> None:
        here, there = self._state, self._next
        for _ in range(2):
            self._solver.step(here, there, self._control, None, self.cfg.physics_dt)
            wp.launch(
                limit_joint_velocity_kernel,
                dim=(1, len(self._limits)),
                inputs=[self._limits, self.cfg.physics_dt, here.joint_q.reshape((1, -1))],
                outputs=[there.joint_q.reshape((1, -1)), there.joint_qd.reshape((1, -1))],
                device="cpu",
            )
            here, there = there, here

    def advance(self, seconds: float, drives: Sequence[Drive]) -> None:
        """Go on by ``seconds``, to the pair of physics steps before."""
        self._set_gains(drives)
        goals = np.array([np.nan if drive.goal_rad is None else drive.goal_rad for drive in drives])
        self._target = np.where(np.isnan(goals), self._target, self.joints.to_joint(goals)).astype(np.float32)
        self._control.joint_target_q.assign(self._target)
        self._limits.assign(np.minimum([drive.velocity_limit for drive in drives], self.hand.velocity_limit))
        self._rest = min(self._rest + seconds, LONGEST_S)
        while self._rest >= 2.0 * self.cfg.physics_dt:
            self._rest -= 2.0 * self.cfg.physics_dt
            wp.capture_launch(self._graph)

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [rad], velocities [rad/s] and torques [N m] of the motors, each of shape [D]."""
        q, qd = self._state.joint_q.numpy().astype(float), self._state.joint_qd.numpy().astype(float)
        stiffness = self._model.joint_target_ke.numpy()
        damping = self._model.joint_target_kd.numpy()
        torque = np.clip(stiffness * (self._target - q) - damping * qd, -self.hand.effort, self.hand.effort)
        sign = self.joints.sign
        return self.joints.to_motor(q), sign * qd, sign * torque

    def _set_gains(self, drives: Sequence[Drive]) -> None:
        """Tell the solver of gains that changed, and of torque switched on or off."""
        gains = tuple((drive.p_gain, float(drive.goal_rad is not None)) for drive in drives)
        if gains == self._gains:
            return
        self._gains = gains
        on = np.array([switched for _, switched in gains])
        scale = np.array([p_gain for p_gain, _ in gains]) / P_GAIN_UNIT
        self._model.joint_target_ke.assign((self.hand.kp * scale * on).astype(np.float32))
        self._model.joint_target_kd.assign((self.hand.kd * on).astype(np.float32))
        self._solver.notify_model_changed(newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
