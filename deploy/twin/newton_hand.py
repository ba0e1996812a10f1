"""The hand in Newton as the plant behind the twin's motors, on the CPU, over a table with an object or none.

One world, stepped at the simulator's physics rate. Steps do not end when somebody asks: a goal that
arrives within a step counts for the rest of it, and the joints are told where they have got to
since the last one.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import newton
import numpy as np
import warp as wp

from vd.assets_usd.hand_model import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.deploy.hardware.joints import Joints
from vd.deploy.twin.plant import Drive
from vd.kernels.task.actions import limit_joint_velocity_kernel
from vd.sim.cfg import SimCfg
from vd.sim.engine import make_solver
from vd.sim.joint_servo import JointServo, has_effects
from vd.sim.scene import Scene, add_table, build_hand, build_scene, new_builder

SHORTEST_COMMAND_S = 0.0025
"""Commands do not come more often, or some of those that are delayed are lost: two for each
goal.
"""
LONGEST_S = 0.3
"""Time that is simulated at once at most, longer than a gap at which the hand is stopped: after a
longer one it is where it was."""
ROOM = 4
"""Times as many contacts as a world of many has on average, for there is no other world to take
them from.
"""


class NewtonHand:
    """A simulated hand; its axes are the motors', in the joints' order.

    A motor at the position gain of the hand's USD has the hand's stiffness and damping; its
    stiffness grows with the gain. In current-based mode its current limits the torque. With its
    torque off a joint has neither. Effects of the hand's layer act as in training.
    """

    def __init__(
        self,
        hand: HandModel,
        joints: Joints,
        cfg: SimCfg | None = None,
        item: ObjectModel | None = None,
    ):
        """Build the world, with the hand in the task's reset pose and the object above the table."""
        self.hand, self.joints = hand, joints
        cfg = cfg or SimCfg()
        self.cfg = cfg = replace(cfg, nconmax=ROOM * cfg.nconmax, njmax=ROOM * cfg.njmax)
        self.scene: Scene | None = None
        """What is where in the world; None without an object to handle."""
        if item is None:
            world = build_hand(hand, cfg, visuals=False)
            if not hand.palm_up:
                add_table(world, cfg, visible=False)
            builder = new_builder()
            builder.add_world(world)
            self._model = builder.finalize(device="cpu")
        else:
            self.scene = build_scene(hand=hand, objects=[item], num_envs=1, cfg=cfg, device="cpu")
            self._model = self.scene.model
        self._solver = make_solver(self._model, cfg)
        self._state, self._next = self._model.state(), self._model.state()
        self._control = self._model.control()
        self._axes = hand.num_joints
        self._target = hand.start
        self._held = np.full(self._axes, np.nan, dtype=np.float32)
        self._limits = wp.zeros(self._axes, dtype=float, device="cpu")
        self._pair_s, self._rest = 2.0 * cfg.physics_dt, 0.0
        self._pulled = np.zeros(self._axes)
        self._stiffness, self._damping = np.zeros(self._axes), np.zeros(self._axes)
        self._p_gain = np.array([motor.p_gain for motor in joints.motors])
        self._effort = hand.effort
        self._gains: tuple[tuple[float, float, float], ...] = ()
        self._write(self._state.joint_q, self._target)
        if item is not None:
            self.place_object((0.0, 0.0, 0.0, 1.0))
        self._servo: JointServo | None = None
        if has_effects(hand.servo):
            self._servo = JointServo(
                self._solver,
                self._control,
                self._state.joint_q.reshape((1, -1)),
                hand.servo,
                hand.fingers,
                physics_dt=cfg.physics_dt,
                control_dt=SHORTEST_COMMAND_S,
            )
            self._sent = wp.array(self._target[None], dtype=float, device="cpu")
        self._graph = self._capture()
        if self._servo is not None:
            self._servo.reset(wp.ones(1, dtype=wp.int32, device="cpu"))
        self._hold(self._target)

    @property
    def joint_q(self) -> np.ndarray:
        """Hand joints [rad] and, with an object, its position [m] and quaternion xyzw, [D] or [D + 7]."""
        return self._state.joint_q.numpy().copy()

    @property
    def joint_qd(self) -> np.ndarray:
        """Their velocities: joints [rad/s], object linear [m/s] and angular [rad/s], [D] or [D + 6]."""
        return self._state.joint_qd.numpy().copy()

    @property
    def body_q(self) -> wp.array:
        """Poses of all bodies in the world frame, shape [1, B]."""
        return self._state.body_q.reshape((1, -1))

    def place_object(self, quat: Sequence[float]) -> None:
        """Put the object where an episode starts, at rest, turned as wanted (xyzw).

        It falls from there.
        """
        self._write(self._state.joint_q, [*self.hand.workspace.drop_m, *quat], self._axes)
        self._write(self._state.joint_qd, np.zeros(6), self._axes)
        # The solver warm-starts from the last accelerations, which mean nothing after a jump.
        self._solver.reset(self._state, flags=newton.StateFlags(0))

    @staticmethod
    def _write(array: wp.array, values: Sequence[float] | np.ndarray, first: int = 0) -> None:
        """Write ``values`` into an array from ``first`` on."""
        whole = array.numpy()
        whole[first : first + len(values)] = values
        array.assign(whole)

    def _capture(self) -> Any:
        """Two physics steps as one recorded launch, which takes a tenth of the time.

        The launches of a step one by one would take most of its time, and hold the interpreter,
        which the thread that answers packets needs. Two, because states swap; they end where they
        began.
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
            before, q, qd = (
                a.reshape((1, -1)) for a in (here.joint_q, there.joint_q, there.joint_qd)
            )
            if self._servo is not None:
                self._servo.receive()
                self._servo.drive(before, here.joint_qd.reshape((1, -1)))
            self._solver.step(here, there, self._control, None, self.cfg.physics_dt)
            wp.launch(
                limit_joint_velocity_kernel,
                dim=(1, len(self._limits)),
                inputs=[self._limits, self.cfg.physics_dt, before],
                outputs=[q, qd],
                device="cpu",
            )
            if self._servo is not None:
                self._servo.finish(before, q, qd)
            here, there = there, here
        if self._servo is not None:
            self._servo.measure()

    def advance(self, seconds: float, drives: Sequence[Drive]) -> None:
        """Go on by ``seconds``; what is less than a pair of physics steps is kept for the next time."""
        self._set_gains(drives)
        goals = np.array([np.nan if drive.goal_rad is None else drive.goal_rad for drive in drives])
        self._target = np.where(np.isnan(goals), self._target, self.joints.to_joint(goals))
        fastest = np.array([drive.velocity_limit for drive in drives]) / self.joints.gear
        self._limits.assign(np.minimum(fastest, self.hand.velocity_limit))
        seconds = min(seconds, LONGEST_S)
        while self._rest + seconds >= self._pair_s:
            share = self._pair_s - self._rest
            self._hold((self._pulled + share * self._target) / self._pair_s)
            wp.capture_launch(self._graph)
            seconds -= share
            self._rest, self._pulled = 0.0, np.zeros(self._axes)
        self._rest += seconds
        self._pulled = self._pulled + seconds * self._target

    def _hold(self, target: np.ndarray) -> None:
        """Give the joints the goals of the next steps [rad] [D]."""
        target = target.astype(np.float32)
        if np.array_equal(target, self._held):
            return
        self._held = target
        if self._servo is None:
            self._write(self._control.joint_target_q, target)
        else:
            self._sent.assign(target[None])
            self._servo.send(self._sent)

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [rad], velocities [rad/s] and torques [N m] of the motors, each of shape [D].

        Without an object positions are those of now, else of the last step, as is what the object
        and the camera tell.
        """
        q, qd = self.joint_q[: self._axes].astype(float), self.joint_qd[: self._axes].astype(float)
        reference = self._held if self._servo is None else self._servo.reference.numpy()[0]
        torque = self._stiffness * (reference - q) - self._damping * qd
        torque = np.clip(torque, -self._effort, self._effort)
        if self._servo is not None:  # late, or with an offset
            q = self._servo.measured_q.numpy()[0].astype(float)
            qd = self._servo.measured_qd.numpy()[0].astype(float)
        if self.scene is None:
            q = q + self._rest * qd
        sign, gear = self.joints.sign, self.joints.gear
        return self.joints.to_motor(q), sign * gear * qd, sign * torque / gear

    def _set_gains(self, drives: Sequence[Drive]) -> None:
        """Tell the solver of gains that changed, and of torque switched on or off."""
        gains = tuple(
            (one.p_gain, float(one.goal_rad is not None), one.torque_limit) for one in drives
        )
        if gains == self._gains:
            return
        self._gains = gains
        p_gain, on, torque = np.array(gains).T
        scale = on * p_gain / self._p_gain
        if self.joints.capped.any():
            most = np.minimum(self.hand.effort, torque * self.joints.gear)
            self._effort = np.where(self.joints.capped, most, self.hand.effort)
            self._write(self._model.joint_effort_limit, self._effort)
        self._stiffness, self._damping = self.hand.kp * scale, self.hand.kd * on
        if self._servo is not None:
            self._servo.power.assign(scale[None].astype(np.float32))
        else:
            self._write(self._model.joint_target_ke, self._stiffness)
            self._write(self._model.joint_target_kd, self._damping)
        self._solver.notify_model_changed(newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
