"""The hand in Newton, on the CPU, over a table with an object or none.

One world, stepped at the simulator's physics rate. Steps do not end when somebody asks: a goal that
arrives within a step counts for the rest of it, and the joints are told where they have got to
since the last one.
"""

from dataclasses import replace

import newton
import numpy as np
import warp as wp

from vd.assets_usd.hand_model import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.sim.cfg import SimCfg
from vd.sim.graphs import Graphs
from vd.sim.joint_servo import has_effects
from vd.sim.scene import build_scene
from vd.sim.simulator import Simulator

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
        scene: What is where in the world.
        sim: Its simulation, of which a control step is a pair of physics steps.
    """

    def __init__(self, hand: HandModel, cfg: SimCfg | None = None, item: ObjectModel | None = None):
        """Build the world, with the hand in the task's reset pose, the object above the table."""
        self.hand = hand
        cfg = cfg or SimCfg()
        self.cfg = cfg = replace(
            cfg,
            control_hz=0.5 * cfg.physics_hz,
            nconmax=ROOM * cfg.nconmax,
            njmax=ROOM * cfg.njmax,
        )
        objects = [] if item is None else [item]
        self.scene = build_scene(hand=hand, objects=objects, num_envs=1, cfg=cfg, device="cpu")
        rows = hand.servo if has_effects(hand.servo) else None
        self.sim = Simulator(self.scene, cfg, servo_rows=rows)
        self._graphs = Graphs("cpu")
        self._axes = hand.num_joints
        self._target = hand.start
        self._held = np.full(self._axes, np.nan, dtype=np.float32)
        self._rest_s = 0.0  # simulated time that is less than a pair of steps
        self._pulled = np.zeros(self._axes)  # targets over that time
        self._power = np.full(self._axes, np.nan)
        self._effort = hand.effort
        self._begin()
        for _ in range(2):  # loads the kernels, and records them
            self._graphs.replay(self._two_steps)
        self._begin()
        self._hold(self._target)
        self.drive(self._target, np.zeros(self._axes), hand.effort)

    @property
    def joint_q(self) -> np.ndarray:
        """Hand joints [rad], and position [m] and quaternion xyzw of an object, [D] or [D + 7]."""
        return np.array(self.sim.joint_q.numpy()[0])

    @property
    def joint_qd(self) -> np.ndarray:
        """Velocities: joints [rad/s], object linear [m/s] and angular [rad/s], [D] or [D + 6]."""
        return np.array(self.sim.joint_qd.numpy()[0])

    def _begin(self) -> None:
        """Put the joints where an episode starts, at rest, and the object above the table."""
        self.sim.joint_q.numpy()[0, : self._axes] = self.hand.start
        self.sim.joint_qd.zero_()
        self.place_object()
        self.sim.forward_kinematics()
        if self.sim.servo is not None:
            self.sim.servo.reset(wp.ones(1, dtype=wp.int32, device="cpu"))

    def place_object(self) -> None:
        """Put the object, if there is one, where an episode starts, at rest.

        It falls from there.
        """
        if self.scene.objects:
            start = [*self.hand.workspace.drop_m, 0.0, 0.0, 0.0, 1.0]
            self.sim.joint_q.numpy()[0, self._axes :] = start
            self.sim.joint_qd.numpy()[0, self._axes :] = 0.0
        # The solver warm-starts from the last accelerations, which mean nothing after a jump.
        self.sim.solver.reset(self.sim.state, flags=newton.StateFlags(0))

    def _two_steps(self) -> None:
        """A pair of physics steps: states swap, and end where they began.

        Recorded as one launch it takes a tenth of the time: launched one by one its kernels would
        hold the interpreter, which the loop's threads need.
        """
        self.sim.physics_steps()
        if self.sim.servo is not None:
            self.sim.servo.measure()

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
            self.sim.model.joint_effort_limit.numpy()[: self._axes] = effort
        elif np.array_equal(power, self._power):
            return
        self._power = power
        if self.sim.servo is not None:
            self.sim.servo.power.assign(power[None].astype(np.float32))
        else:
            model = self.sim.model
            model.joint_target_ke.numpy()[: self._axes] = self.hand.kp * power
            model.joint_target_kd.numpy()[: self._axes] = self.hand.kd * (power > 0.0)
        self.sim.solver.notify_model_changed(newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES)

    def advance(self, seconds: float) -> None:
        """Go on by ``seconds``.

        What is less than a pair of physics steps is kept for the next time.
        """
        seconds = min(seconds, LONGEST_S)
        pair_s = self.cfg.control_dt
        while self._rest_s + seconds >= pair_s:
            share = pair_s - self._rest_s
            self._hold((self._pulled + share * self._target) / pair_s)
            self._graphs.replay(self._two_steps)
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
        self.sim.target.numpy()[0, : self._axes] = target
        if self.sim.servo is not None:
            self.sim.servo.send(self.sim.target)

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [rad], velocities [rad/s] and torques [N m].

        Without an object positions are those of now, else of the last step, as is what the object
        and the camera tell.
        """
        q = self.joint_q[: self._axes].astype(float)
        qd = self.joint_qd[: self._axes].astype(float)
        servo = self.sim.servo
        reference = self._held if servo is None else servo.reference.numpy()[0]
        damping = self.hand.kd * (self._power > 0.0)
        torque = self.hand.kp * self._power * (reference - q) - damping * qd
        torque = np.clip(torque, -self._effort, self._effort)
        if servo is not None:  # late, or with an offset
            q = servo.measured_q.numpy()[0].astype(float)
            qd = servo.measured_qd.numpy()[0].astype(float)
        if not self.scene.objects:
            q = q + self._rest_s * qd
        return q, qd, torque
