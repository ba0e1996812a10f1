"""Recordings of a hand replayed in Newton as policies are trained: same solver, same servo kernels.

Every world replays one trajectory with one set of parameters. Contacts are off; SI units, radians.
"""

import dataclasses
import math
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp

from vd.assets_usd.hand_model import HandModel
from vd.kernels.launch import count_kernel, launch
from vd.kernels.servo.actuators import BACKLASH_WIDTH, ENCODER_BIAS
from vd.kernels.servo.chains import Samples
from vd.kernels.servo.joint_replay import (
    Tracks,
    replay_command_kernel,
    rest_play_kernel,
    sample_position_kernel,
)
from vd.logs.motions import Recording
from vd.sim.cfg import SimCfg
from vd.sim.engine import make_solver
from vd.sim.joint_servo import JointServo
from vd.sim.scene import build_hand, new_builder


def simulate_hand(
    recording: Recording,
    hand: HandModel,
    rows: np.ndarray,
    *,
    dt: float,
    device: str = "cpu",
) -> np.ndarray:
    """What Newton makes of a recording's commands, sampled where the recording has positions.

    Args:
        recording: A recording of the hand.
        hand: The hand.
        rows: Servo parameters of M models that are simulated side by side [M, D, P].
        dt: Physics step [s].
        device: Warp device.

    Returns:
        Predicted recorded positions [rad] in the recording's columns, the samples of the
        trajectories one after the other, shape [M, S, J].
    """
    models = np.asarray(rows, dtype=float)
    lengths = [len(trajectory.time) for trajectory in recording.trajectories]
    replay = _Replay(recording, hand, len(models), dt, device)
    positions = replay.run(np.repeat(models, len(lengths), axis=0))
    positions = positions.reshape(len(models), len(lengths), -1, hand.num_joints)
    answers = np.concatenate([positions[:, k, :length] for k, length in enumerate(lengths)], axis=1)
    return answers[..., [hand.joint_names.index(name) for name in recording.joints]]


class _Replay:
    """Worlds with a hand each, one for every trajectory of each of M models.

    W worlds, D joints, P = PARAMETER_COLUMNS.
    """

    def __init__(self, recording: Recording, hand: HandModel, models: int, dt: float, device: str):
        self.hand, self.dt, self.device = hand, dt, device
        self.shape = w, d = models * len(recording.trajectories), hand.num_joints

        def zeros(*shape: int, dtype: Any = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self._load(recording, models)
        self._build()
        self.positions = zeros(w, max(len(t.time) for t in recording.trajectories), d)
        self._step = zeros(1, dtype=wp.int32)
        self._write, self._read, self._due_step = (zeros(w, d, dtype=wp.int32) for _ in range(3))
        self._due_fraction, self._held, self._held_power = (zeros(w, d) for _ in range(3))

    def _load(self, recording: Recording, models: int) -> None:
        """Put the trajectories on the device, one after the other."""
        trajectories, names = recording.trajectories, list(recording.joints)
        lengths = [len(t.time) for t in trajectories]
        first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
        gains = [float(t.conditions.get("p_gain", 0.0)) for t in trajectories]
        shares = [gain / max(gains) if gain > 0.0 else 1.0 for gain in gains]
        power = np.concatenate(
            [t.enabled * share for t, share in zip(trajectories, shares, strict=True)]
        )
        command = np.concatenate([t.command for t in trajectories])
        column = np.array([names.index(n) if n in names else -1 for n in self.hand.joint_names])
        self.duration = max(t.duration for t in trajectories)

        def array(values: np.ndarray, dtype: Any = float) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

        def start(values: np.ndarray, idle: np.ndarray | float) -> np.ndarray:
            """Of every joint at the first samples [W, D]; rest where nothing is recorded."""
            return np.tile(np.where(column >= 0, values[first][:, column], idle), (models, 1))

        centre = np.clip(0.0, self.hand.lower, self.hand.upper)
        self._start = start(np.concatenate([t.position for t in trajectories]), centre)
        self._start_command, self._start_power = start(command, centre), start(power, 1.0)
        self._recorded = column >= 0
        self._samples, self._tracks = Samples(), Tracks()
        for prefix, times in (
            ("", [t.time for t in trajectories]),
            ("sent_", [t.sent for t in trajectories]),
        ):
            step, fraction = np.divmod(np.concatenate(times) / self.dt, 1.0)
            setattr(self._samples, f"{prefix}step", array(step, int))
            setattr(self._samples, f"{prefix}fraction", array(fraction))
        self._samples.command, self._samples.power = array(command), array(power)
        self._tracks.column = array(column, int)
        self._tracks.first = array(np.tile(first, models), int)
        self._tracks.last = array(np.tile(first + lengths, models), int)
        self._tracks.stream = array(np.tile([t.stream for t in trajectories], models), int)

    def _build(self) -> None:
        """The worlds; without contacts a joint has three rows.

        Its limit, friction, and whom it follows.
        """
        w, d = self.shape
        cfg = dataclasses.replace(
            SimCfg(),
            physics_hz=1.0 / self.dt,
            control_hz=0.5 / self.dt,
            contact_time_constant_s=max(SimCfg().contact_time_constant_s, 2.0 * self.dt),
            njmax=3 * d,
            nconmax=4,  # the solver wants room for some even if there are none
        )
        scene = new_builder()
        scene.replicate(build_hand(self.hand, cfg, visuals=False), w)
        self.model = scene.finalize(device=self.device)
        self.solver = make_solver(self.model, cfg)
        self.solver.mjw_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.control = self.model.control()
        self._states = self.model.state(), self.model.state()
        self._q = [s.joint_q.reshape((w, -1)) for s in self._states]
        self._qd = [s.joint_qd.reshape((w, -1)) for s in self._states]
        self.servo = JointServo(
            self.solver,
            self.control,
            self._q[0],
            self.hand.servo,
            self.hand.fingers,
            physics_dt=self.dt,
            control_dt=self.duration,  # commands come from the recording, none is in transit
        )

    def run(self, rows: np.ndarray) -> np.ndarray:
        """Simulate from rest at the first recorded positions.

        Args:
            rows: Servo parameters, shape [W, D, P].

        Returns:
            Predicted positions [rad] by sample of the world's trajectory, shape [W, T, D].
        """
        self.servo.set_rows(rows)
        start = np.where(self._recorded, self._start - rows[..., ENCODER_BIAS], self._start)
        self._q[0].assign(start.astype(np.float32))
        self.solver.reset(self._states[0], flags=newton.StateFlags(0))
        self._held.assign(self._start_command.astype(np.float32))
        self._held_power.assign(self._start_power.astype(np.float32))
        wp.copy(self.servo.power, self._held_power)
        self.servo.reset(
            wp.ones(self.shape[0], dtype=wp.int32, device=self.device), command=self._held
        )
        if rows[..., BACKLASH_WIDTH].any():
            load = wp.array(self._gravity(start), dtype=float, device=self.device)
            servo = [self.servo.parameters, self.servo.first]
            inputs = [*servo, self._held, self._held_power, load, self._q[0]]
            launch(rest_play_kernel, self.shape, inputs, [self.servo.state])
        first = np.repeat(self._tracks.first.numpy()[:, None], self.shape[1], axis=1)
        self._write.assign(first)
        self._read.assign(first)
        self._launch_steps()  # loads every kernel, which a capture cannot
        with wp.ScopedCapture(device=self.device) as capture:  # a tenth of the time, on a CPU too
            self._launch_steps()
        for _ in range(math.ceil(0.5 * (math.ceil(self.duration / self.dt) + 1)) - 1):
            wp.capture_launch(capture.graph)
        return self.positions.numpy().astype(float)

    def _gravity(self, q: np.ndarray) -> np.ndarray:
        """Torques of gravity on the joints [N m], shape [W, D], at positions [W, D] [rad]."""
        data, load = mujoco.MjData(self.solver.mj_model), np.empty_like(q)
        for i, place in enumerate(q):
            data.qpos[: q.shape[1]] = place
            mujoco.mj_forward(self.solver.mj_model, data)
            load[i] = -data.qfrc_bias[: q.shape[1]]
        return load

    def _launch_steps(self) -> None:
        """Two steps: states are swapped every step."""
        servo = self.servo
        given = [servo.parameters, self._samples, self._tracks, self.dt, self._step]
        commands = [self._write, self._due_step, self._due_fraction, self._held, self._held_power]
        for here, there in ((0, 1), (1, 0)):
            inputs = [*given, *commands, servo.state]
            launch(replay_command_kernel, self.shape, inputs, [servo.reference, servo.power])
            servo.drive(self._q[here], self._qd[here])
            self.solver.step(self._states[here], self._states[there], self.control, None, self.dt)
            servo.finish(self._q[here], self._q[there], self._qd[there])
            inputs = [*given, self._q[here], self._q[there], self._read]
            launch(sample_position_kernel, self.shape, inputs, [self.positions])
            launch(count_kernel, 1, [], [self._step])
