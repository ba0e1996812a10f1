"""Recordings of a hand replayed in Newton as policies are trained: same solver, same servo kernels.

Every world replays one trajectory with one set of parameters. Contacts are off; SI units, radians.
"""

import dataclasses
import math
from functools import partial
from operator import attrgetter
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
    count = len(recording.trajectories)
    replay = _Replay(recording, hand, len(models), dt, device)
    positions = replay.run(np.repeat(models, count, axis=0))
    positions = positions.reshape(len(models), count, -1, hand.num_joints)
    answers = []
    for k, trajectory in enumerate(recording.trajectories):
        answers.append(positions[:, k, : len(trajectory.time)])
    columns = list(map(hand.joint_names.index, recording.joints))
    return np.concatenate(answers, axis=1)[..., columns]


def _power(recording: Recording) -> np.ndarray:
    """Share of the largest P gain with which each sample is driven, 0 without torque [S, J]."""
    gains = [float(t.conditions.get("p_gain", 0.0)) for t in recording.trajectories]
    power = []
    for t, gain in zip(recording.trajectories, gains, strict=True):
        share = gain / max(gains) if gain > 0.0 else 1.0
        power.append(t.enabled * share)
    return np.concatenate(power)


class _Replay:
    """Worlds with a hand each, one for every trajectory of each of M models.

    W worlds, D joints, P = PARAMETER_COLUMNS.
    """

    def __init__(self, recording: Recording, hand: HandModel, models: int, dt: float, device: str):
        self.hand = hand
        self.dt = dt
        self.device = device
        worlds = models * len(recording.trajectories)
        self.shape = (worlds, hand.num_joints)
        self._load(recording, models)
        self._build()
        zeros = partial(wp.zeros, device=device)
        most = max(len(t.time) for t in recording.trajectories)
        self.positions = zeros((worlds, most, hand.num_joints), dtype=float)
        self._step = zeros(1, dtype=wp.int32)
        # Of every joint the next sample to command and to write, and what is commanded now.
        self._write = zeros(self.shape, dtype=wp.int32)
        self._read = zeros(self.shape, dtype=wp.int32)
        self._due_step = zeros(self.shape, dtype=wp.int32)
        self._due_fraction = zeros(self.shape, dtype=float)
        self._held = zeros(self.shape, dtype=float)
        self._held_power = zeros(self.shape, dtype=float)

    def _load(self, recording: Recording, models: int) -> None:
        """Put the trajectories on the device, one after the other."""
        trajectories = recording.trajectories
        lengths = np.array([len(t.time) for t in trajectories])
        first = np.cumsum(lengths) - lengths

        def joined(name: str) -> np.ndarray:
            """What trajectories have by this name, one after the other."""
            return np.concatenate(list(map(attrgetter(name), trajectories)))

        command = joined("command")
        power = _power(recording)
        names = recording.joints
        column = np.array([names.index(n) if n in names else -1 for n in self.hand.joint_names])
        self.duration = max(t.duration for t in trajectories)
        self._recorded = column >= 0

        def array(values: np.ndarray, dtype: Any = float) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

        def start(values: np.ndarray, idle: np.ndarray | float) -> np.ndarray:
            """Of every joint at the first samples [W, D]; rest where nothing is recorded."""
            return np.tile(np.where(self._recorded, values[first][:, column], idle), (models, 1))

        centre = np.clip(0.0, self.hand.lower, self.hand.upper)
        self._start = start(joined("position"), centre)
        self._start_command = start(command, centre)
        self._start_power = start(power, 1.0)
        step, fraction = np.divmod(joined("time") / self.dt, 1.0)
        sent_step, sent_fraction = np.divmod(joined("sent") / self.dt, 1.0)
        self._samples = Samples()
        self._samples.step = array(step, int)
        self._samples.fraction = array(fraction)
        self._samples.sent_step = array(sent_step, int)
        self._samples.sent_fraction = array(sent_fraction)
        self._samples.command = array(command)
        self._samples.power = array(power)
        self._tracks = Tracks()
        self._tracks.column = array(column, int)
        self._tracks.first = array(np.tile(first, models), int)
        self._tracks.last = array(np.tile(first + lengths, models), int)
        self._tracks.stream = array(np.tile([t.stream for t in trajectories], models), int)

    def _build(self) -> None:
        """The worlds; without contacts a joint has three rows.

        Its limit, friction, and whom it follows.
        """
        worlds, joints = self.shape
        cfg = dataclasses.replace(
            SimCfg(),
            physics_hz=1.0 / self.dt,
            control_hz=0.5 / self.dt,
            contact_time_constant_s=max(SimCfg().contact_time_constant_s, 2.0 * self.dt),
            njmax=3 * joints,
            nconmax=4,  # the solver wants room for some even if there are none
        )
        scene = new_builder()
        scene.replicate(build_hand(self.hand, cfg, visuals=False), worlds)
        self.model = scene.finalize(device=self.device)
        self.solver = make_solver(self.model, cfg)
        self.solver.mjw_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.control = self.model.control()
        self._states = (self.model.state(), self.model.state())
        self._q = []
        self._qd = []
        for state in self._states:
            self._q.append(state.joint_q.reshape((worlds, -1)))
            self._qd.append(state.joint_qd.reshape((worlds, -1)))
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
            launch(
                rest_play_kernel,
                self.shape,
                [
                    self.servo.parameters,
                    self.servo.first,
                    self._held,
                    self._held_power,
                    load,
                    self._q[0],
                ],
                [self.servo.state],
            )
        first = np.repeat(self._tracks.first.numpy()[:, None], self.shape[1], axis=1)
        self._write.assign(first)
        self._read.assign(first)
        self._launch_steps()  # loads every kernel, which a capture cannot
        with wp.ScopedCapture(device=self.device) as capture:  # a tenth of the time, on a CPU too
            self._launch_steps()
        steps = math.ceil(self.duration / self.dt) + 1
        for _ in range(math.ceil(0.5 * steps) - 1):
            wp.capture_launch(capture.graph)
        return self.positions.numpy().astype(float)

    def _gravity(self, q: np.ndarray) -> np.ndarray:
        """Torques of gravity on the joints [N m], shape [W, D], at positions [W, D] [rad]."""
        data = mujoco.MjData(self.solver.mj_model)
        load = np.empty_like(q)
        for i, place in enumerate(q):
            data.qpos[: q.shape[1]] = place
            mujoco.mj_forward(self.solver.mj_model, data)
            load[i] = -data.qfrc_bias[: q.shape[1]]
        return load

    def _launch_steps(self) -> None:
        """Two steps: states are swapped every step."""
        servo = self.servo
        for here, there in ((0, 1), (1, 0)):
            launch(
                replay_command_kernel,
                self.shape,
                [
                    servo.parameters,
                    self._samples,
                    self._tracks,
                    self.dt,
                    self._step,
                    self._write,
                    self._due_step,
                    self._due_fraction,
                    self._held,
                    self._held_power,
                    servo.state,
                ],
                [servo.reference, servo.power],
            )
            servo.drive(self._q[here], self._qd[here])
            self.solver.step(self._states[here], self._states[there], self.control, None, self.dt)
            servo.finish(self._q[here], self._q[there], self._qd[there])
            launch(
                sample_position_kernel,
                self.shape,
                [
                    servo.parameters,
                    self._samples,
                    self._tracks,
                    self.dt,
                    self._step,
                    self._q[here],
                    self._q[there],
                    self._read,
                ],
                [self.positions],
            )
            launch(count_kernel, 1, [], [self._step])
