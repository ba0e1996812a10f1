"""Recordings of a hand replayed in Newton as policies are trained: same solver, same servo kernels.

The fingers of a hand do not move each other, so one world can replay a different trajectory with every
finger. Contacts are off; SI units, radians.
"""

import dataclasses
import math
import zlib
from collections.abc import Callable
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_model import HandModel
from vd.gap.chain import GRAVITY_M_S2
from vd.gap.recording import Recording, Trajectory
from vd.gap.rollout import STREAM_BITS
from vd.kernels.launch import count_kernel, launch
from vd.kernels.servo.actuators import BACKLASH_WIDTH, ENCODER_BIAS
from vd.kernels.servo.chains import Samples
from vd.kernels.servo.joint_replay import (
    Tracks,
    replay_command_kernel,
    rest_play_kernel,
    sample_position_kernel,
)
from vd.sim.cfg import SimCfg
from vd.sim.engine import make_solver
from vd.sim.joint_servo import JointServo
from vd.sim.scene import build_hand, new_builder

DEFAULT_DT = 1.0 / 480.0
"""Physics step [s]: a quarter of training's, at which the integrator's error is under a milliradian."""
CONSTRAINT_ROWS = 3
"""Rows of a joint without contacts: its limit, its friction, and that it follows another."""
CONTACTS = 4
"""The solver wants room for some contacts even if there are none."""
GRADIENT_STEP = 1.0e-5
"""Step of central differences [rad]: rounding and curvature are both far below a servo's torques."""
GRAPH_STEPS = 16
"""Physics steps per graph; even, since states are swapped every step."""


class HandReplay:
    """Worlds with a hand each, every finger of which follows a trajectory of a recording.

    W worlds, F fingers, D joints, P = PARAMETER_COLUMNS.
    """

    def __init__(
        self,
        recording: Recording,
        hand: HandModel,
        tracks: np.ndarray,
        *,
        dt: float = DEFAULT_DT,
        device: str = "cpu",
        keep_positions: bool = False,
    ):
        """Build the worlds.

        Args:
            recording: The recording; its joints are joints of the hand.
            hand: The hand.
            tracks: Trajectory that each finger follows, or -1 for none, shape [W, F].
            dt: Physics step [s].
            device: Warp device.
            keep_positions: Keep the predicted positions, not just their squared errors.

        Raises:
            ValueError: The recording has joints that the hand has not.
        """
        unknown = [name for name in recording.joints if name not in hand.joint_names]
        if unknown:
            raise ValueError(
                f"{recording.path}: joints {', '.join(unknown)} are not joints of {hand.name} "
                f"({', '.join(hand.joint_names)}); name the hand that was recorded"
            )
        self.hand, self.dt, self.device = hand, dt, device
        tracks = np.asarray(tracks)
        self.num_worlds = w = len(tracks)
        self.num_joints = d = hand.num_joints
        self._load(recording, tracks)
        self._build()

        def zeros(*shape: int, dtype: Any = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.squared_error = zeros(w, d)
        """Sum over samples of the squared error of every joint [rad^2], shape [W, D]."""
        kept = max(self._length[i] for i in tracks.flat if i >= 0) if keep_positions else 0
        self.positions = zeros(w, int(kept), d)
        """Predicted positions [rad] by sample of the world's tracks, shape [W, T, D]."""
        self._step = zeros(1, dtype=wp.int32)
        self._write, self._read = zeros(w, d, dtype=wp.int32), zeros(w, d, dtype=wp.int32)
        self._due_step, self._due_fraction = zeros(w, d, dtype=wp.int32), zeros(w, d)
        self._held, self._held_power = zeros(w, d), zeros(w, d)
        self._graph: Any = None
        self._loaded = False

    def _load(self, recording: Recording, tracks: np.ndarray) -> None:
        """Put the trajectories on the device, one after the other."""
        trajectories = recording.trajectories
        self._length = np.array([len(t.time) for t in trajectories])
        start = np.concatenate([[0], np.cumsum(self._length)])
        first = np.where(tracks >= 0, start[tracks], 0)
        last = np.where(tracks >= 0, start[tracks + 1], 0)
        streams = np.array([random_stream(t) for t in trajectories])
        gains = [float(t.conditions.get("p_gain", 0.0)) for t in trajectories]
        reference = max(gains)
        power = np.concatenate(
            [
                t.enabled * (gain / reference if gain > 0.0 else 1.0)
                for t, gain in zip(trajectories, gains, strict=True)
            ]
        )
        stamps = np.concatenate([t.time for t in trajectories]) / self.dt
        sent = np.concatenate([t.sent for t in trajectories]) / self.dt
        command = np.concatenate([t.command for t in trajectories])
        position = np.concatenate([t.position for t in trajectories])
        names = list(recording.joints)
        column = np.array([names.index(n) if n in names else -1 for n in self.hand.joint_names])
        self.duration = float(max(trajectories[i].time[-1] for i in tracks.flat if i >= 0))

        # Where every joint starts, and the command it has had: rest where nothing is recorded.
        finger = self.hand.joint_finger
        by_joint = first[:, finger]
        recorded = (tracks[:, finger] >= 0) & (column >= 0)
        idle = np.clip(0.0, self.hand.lower, self.hand.upper)
        self._start = np.where(recorded, position[by_joint, column], idle)
        self._start_command = np.where(recorded, command[by_joint, column], idle)
        self._start_power = np.where(recorded, power[by_joint, column], 1.0)
        self._recorded, self._first_sample = recorded, by_joint.astype(np.int32)

        def array(values: np.ndarray, dtype: Any = float) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

        self._position = array(position)
        self._samples = Samples()
        self._samples.step = array(np.floor(stamps), int)
        self._samples.fraction = array(stamps - np.floor(stamps))
        self._samples.sent_step = array(np.floor(sent), int)
        self._samples.sent_fraction = array(sent - np.floor(sent))
        self._samples.command, self._samples.power = array(command), array(power)
        self._tracks = Tracks()
        self._tracks.column, self._tracks.finger = array(column, int), array(finger, int)
        self._tracks.first, self._tracks.last = array(first, int), array(last, int)
        self._tracks.stream = array(streams[tracks], int)

    def _build(self) -> None:
        cfg = dataclasses.replace(
            SimCfg(),
            physics_hz=1.0 / self.dt,
            control_hz=0.5 / self.dt,
            contact_time_constant_s=max(SimCfg().contact_time_constant_s, 2.0 * self.dt),
            njmax=CONSTRAINT_ROWS * self.num_joints,
            nconmax=CONTACTS,
        )
        world = build_hand(self.hand, cfg, visuals=False)
        scene = new_builder()
        scene.replicate(world, self.num_worlds)
        self.model = scene.finalize(device=self.device)
        self.solver = make_solver(self.model, cfg)
        self.solver.mjw_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.control = self.model.control()
        self._states = self.model.state(), self.model.state()
        self._q = [s.joint_q.reshape((self.num_worlds, -1)) for s in self._states]
        self._qd = [s.joint_qd.reshape((self.num_worlds, -1)) for s in self._states]
        self.servo = JointServo(
            self.solver,
            self.control,
            self._q[0],
            self.hand.servo,
            self.hand.fingers,
            physics_dt=self.dt,
            control_dt=self.duration,  # commands come from the recording, none is in transit
        )

    def run(self, rows: np.ndarray, progress: Callable[[float], None] = lambda share: None) -> None:
        """Simulate all trajectories from rest at the first recorded positions.

        Args:
            rows: Servo parameters, shape [D, P] or [W, D, P].
            progress: Called with the share that is done.
        """
        rows = np.asarray(rows, dtype=float)
        self.servo.set_rows(rows)
        start = np.where(self._recorded, self._start - rows[..., ENCODER_BIAS], self._start)
        self._q[0].assign(start.astype(np.float32))
        self._qd[0].zero_()
        self.solver.reset(self._states[0], flags=newton.StateFlags(0))
        self._held.assign(self._start_command.astype(np.float32))
        self._held_power.assign(self._start_power.astype(np.float32))
        wp.copy(self.servo.power, self._held_power)
        self.servo.reset(wp.ones(self.num_worlds, dtype=wp.int32, device=self.device), command=self._held)
        if rows[..., BACKLASH_WIDTH].any():
            load = wp.array(gravity_load(self.hand, start), dtype=float, device=self.device)
            servo = [self.servo.parameters, self.servo.first]
            inputs = [*servo, self._held, self._held_power, load, self._q[0]]
            shape = (self.num_worlds, self.num_joints)
            wp.launch(
                rest_play_kernel, dim=shape, inputs=inputs, outputs=[self.servo.state], device=self.device
            )
        for array in (self._step, self.squared_error, self._due_step, self._due_fraction):
            array.zero_()
        self._write.assign(self._first_sample)
        self._read.assign(self._first_sample)
        steps = math.ceil(self.duration / self.dt) + 1
        graphs = math.ceil(steps / GRAPH_STEPS)
        for number in range(graphs):
            self._advance()
            progress((number + 1) / graphs)

    def _advance(self) -> None:
        """Some physics steps as one graph, once every kernel is loaded: a tenth of the time, on a CPU too."""
        if not self._loaded:
            self._launch_steps()
            self._loaded = True
            return
        if self._graph is None:
            with wp.ScopedCapture(device=self.device) as capture:
                self._launch_steps()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _launch_steps(self) -> None:
        dim, servo = (self.num_worlds, self.num_joints), self.servo
        given = [servo.parameters, self._samples, self._tracks]
        commands = [self._write, self._due_step, self._due_fraction, self._held, self._held_power]
        for k in range(GRAPH_STEPS):
            here, there = k % 2, 1 - k % 2
            wp.launch(
                replay_command_kernel,
                dim=dim,
                inputs=[*given, self.dt, self._step, *commands, servo.state],
                outputs=[servo.reference, servo.power],
                device=self.device,
            )
            servo.drive(self._q[here], self._qd[here])
            self.solver.step(self._states[here], self._states[there], self.control, None, self.dt)
            servo.finish(self._q[here], self._q[there], self._qd[there])
            wp.launch(
                sample_position_kernel,
                dim=dim,
                inputs=[
                    *given,
                    self._position,
                    self.dt,
                    self._step,
                    self._q[here],
                    self._q[there],
                    self._read,
                    self.squared_error,
                ],
                outputs=[self.positions],
                device=self.device,
            )
            launch(count_kernel, 1, [], [self._step])


def gravity_load(hand: HandModel, q: np.ndarray) -> np.ndarray:
    """Torques of gravity on the joints [N m], shape [W, D], at positions [W, D] [rad].

    The gradient of the potential energy by central differences.
    """
    q = np.asarray(q, dtype=float)[..., : hand.num_joints]
    moved = q[:, None] + GRADIENT_STEP * np.concatenate([np.eye(hand.num_joints), -np.eye(hand.num_joints)])
    poses = hand.forward_kinematics(moved)
    turns = Rotation.from_quat(poses[..., 3:].reshape(-1, 4))
    arms = turns.apply(np.broadcast_to(hand.link_com, (*poses.shape[:-1], 3)).reshape(-1, 3))
    fallen = (poses[..., :3] + arms.reshape(poses[..., :3].shape)) @ hand.down
    work = GRAVITY_M_S2 * fallen @ hand.link_mass
    plus, minus = np.split(work, 2, axis=1)
    return (plus - minus) / (2.0 * GRADIENT_STEP)


def random_stream(trajectory: Trajectory) -> int:
    """The stream of a trajectory's random delays, the same as in the rollouts."""
    return zlib.crc32(trajectory.file.encode()) & ((1 << STREAM_BITS) - 1)


def simulate_hand(
    recording: Recording,
    hand: HandModel,
    rows: np.ndarray,
    *,
    dt: float = DEFAULT_DT,
    device: str = "cpu",
) -> np.ndarray:
    """What Newton makes of a recording's commands, sampled where the recording has positions.

    Args:
        recording: A recording of a hand.
        hand: The hand.
        rows: Servo parameters, shape [D, P], or of M models that are simulated side by side [M, D, P].
        dt: Physics step [s].
        device: Warp device.

    Returns:
        Predicted recorded positions [rad] in the recording's columns, the samples of the trajectories one
        after the other, shape [S, J] or [M, S, J].
    """
    count = len(recording.trajectories)
    rows = np.asarray(rows, dtype=float)
    models = rows[None] if rows.ndim == 2 else rows
    tracks = np.repeat(np.tile(np.arange(count), len(models))[:, None], hand.num_fingers, axis=1)
    replay = HandReplay(recording, hand, tracks, dt=dt, device=device, keep_positions=True)
    replay.run(np.repeat(models, count, axis=0))
    columns = [hand.joint_names.index(name) for name in recording.joints]
    positions = replay.positions.numpy()[..., columns].astype(float)
    positions = positions.reshape(len(models), count, -1, len(columns))
    lengths = [len(trajectory.time) for trajectory in recording.trajectories]
    answers = np.concatenate([positions[:, k, :length] for k, length in enumerate(lengths)], axis=1)
    return answers[0] if rows.ndim == 2 else answers
