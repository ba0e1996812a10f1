"""The hand in Newton, on the CPU, over a table with an object or none.

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
    """A simulated hand. Arrays are of its joints, shape [D].

    A joint that is driven has the stiffness and damping of the hand's USD, or a share of its
    stiffness. One that is let go has neither. Effects of the hand's layer act as in training.

    Attributes:
        scene: What is where in the world; None without an object to handle.
    """

    def __init__(self, hand: HandModel, cfg: SimCfg | None = None, item: ObjectModel | None = None):
        """Build the world, with the hand in the task's reset pose and the object above the table."""
        self.hand = hand
        cfg = cfg or SimCfg()
        self.cfg = cfg = replace(cfg, nconmax=ROOM * cfg.nconmax, njmax=ROOM * cfg.njmax)
        self.scene: Scene | None = None
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
        self._state = self._model.state()
        self._next = self._model.state()
        self._control = self._model.control()
        self._axes = hand.num_joints
        self._target = hand.start
        self._held = np.full(self._axes, np.nan, dtype=np.float32)
        self._limits = wp.array(hand.velocity_limit, dtype=float, device="cpu")
        self._pair_s = 2.0 * cfg.physics_dt
        self._rest_s = 0.0  # simulated time that is less than a pair of steps
        self._pulled = np.zeros(self._axes)  # targets over that time
        self._power = np.full(self._axes, np.nan)
        self._effort = hand.effort
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
        self.drive(self._target, np.zeros(self._axes), hand.effort)

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
        which the loop's threads need. Two, because states swap; they end where they began.
        """
        q = wp.clone(self._state.joint_q)
        qd = wp.clone(self._state.joint_qd)
        self._two_steps()  # loads kernels and allocates
        with wp.ScopedCapture(device="cpu") as capture:
            self._two_steps()
        wp.copy(self._state.joint_q, q)
        wp.copy(self._state.joint_qd, qd)
        return capture.graph

    def _two_steps(self) -> None:
        self._step(self._state, self._next)
        self._step(self._next, self._state)
        if self._servo is not None:
            self._servo.measure()

    def _step(self, here: newton.State, there: newton.State) -> None:
        """One physics step from one state to the other."""
        before = here.joint_q.reshape((1, -1))
        q = there.joint_q.reshape((1, -1))
        qd = there.joint_qd.reshape((1, -1))
        if self._servo is not None:
            self._servo.receive()
            self._servo.drive(before, here.joint_qd.reshape((1, -1)))
        self._solver.step(here, there, self._control, None, self.cfg.physics_dt)
        wp.launch(
            limit_joint_velocity_kernel,
            dim=(1, self._axes),
            inputs=[self._limits, self.cfg.physics_dt, before],
            outputs=[q, qd],
            device="cpu",
        )
        if self._servo is not None:
            self._servo.finish(before, q, qd)

    def drive(self, target: np.ndarray, power: np.ndarray, effort: np.ndarray) -> None:
        """Say where the joints are to go from now on.

        Args:
            target: Angles [rad].
            power: Stiffness over the hand's own; 0 lets a joint go.
            effort: Largest torques [N m].
        """
        self._target = np.where(power > 0.0, target, self._target)
        if not np.array_equal(effort, self._effort):
            self._effort = effort
            self._write(self._model.joint_effort_limit, effort)
        elif np.array_equal(power, self._power):
            return
        self._power = power
        if self._servo is not None:
            self._servo.power.assign(power[None].astype(np.float32))
        else:
            self._write(self._model.joint_target_ke, self.hand.kp * power)
            self._write(self._model.joint_target_kd, self.hand.kd * (power > 0.0))
        self._solver.notify_model_changed(newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES)

    def advance(self, seconds: float) -> None:
        """Go on by ``seconds``; what is less than a pair of physics steps is kept for the next time."""
        seconds = min(seconds, LONGEST_S)
        while self._rest_s + seconds >= self._pair_s:
            share = self._pair_s - self._rest_s
            self._hold((self._pulled + share * self._target) / self._pair_s)
            wp.capture_launch(self._graph)
            seconds -= share
            self._rest_s = 0.0
            self._pulled = np.zeros(self._axes)
        self._rest_s += seconds
        self._pulled = self._pulled + seconds * self._target

    def _hold(self, target: np.ndarray) -> None:
        """Give the joints the goals of the next steps [rad]."""
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
        """Positions [rad], velocities [rad/s] and torques [N m].

        Without an object positions are those of now, else of the last step, as is what the object
        and the camera tell.
        """
        q = self.joint_q[: self._axes].astype(float)
        qd = self.joint_qd[: self._axes].astype(float)
        reference = self._held if self._servo is None else self._servo.reference.numpy()[0]
        damping = self.hand.kd * (self._power > 0.0)
        torque = self.hand.kp * self._power * (reference - q) - damping * qd
        torque = np.clip(torque, -self._effort, self._effort)
        if self._servo is not None:  # late, or with an offset
            q = self._servo.measured_q.numpy()[0].astype(float)
            qd = self._servo.measured_qd.numpy()[0].astype(float)
        if self.scene is None:
            q = q + self._rest_s * qd
        return q, qd, torque
