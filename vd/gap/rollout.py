"""Predict a recording: whole trajectories of one chain of joints, many parameter sets at once.

Chains: :mod:`vd.gap.chain`. Physics: :mod:`vd.kernels.servo.chains`.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from vd.gap.chain import Chain, load_of
from vd.kernels.servo import actuators as servo
from vd.kernels.servo.chain_bodies import links_of_size, room_for
from vd.kernels.servo.chains import Samples, rollout_kernel
from vd.logs.recording import Recording

STEP_S = 1.0 / 480.0
"""Time step [s]: four of the simulator's, a fifth of a servo's fastest time constant (inertia /
kd).
"""


def links_of(chain: Any) -> Any:
    """The bodies of a :class:`Chain`, or of what has the same arrays, as kernels take them."""
    size = room_for(len(chain.mass))
    links = links_of_size(size)()
    for name in ("axis", "offset", "mass", "com", "inertia"):
        values = getattr(chain, name)
        rows = np.zeros((size, *values.shape[1:]))
        rows[: len(values)] = values
        setattr(links, name, type(getattr(links, name))(*rows.ravel().tolist()))
    links.gravity = wp.vec3(*np.asarray(chain.gravity, float).tolist())
    return links


class Rollouts:
    """Predictions of a recording's trajectories for one chain. S samples in all, n joints.

    A gain set on purpose acts on the stiffness (``p_gain`` over the chain's reference), as does the
    servo's torque being off; both travel with the command. Before the first command is sent it
    holds.

    Attributes:
        chain: The chain.
        recording: The recording.
        num_joints: n.
        measured: Recorded positions [S, n] [rad], float64.
        time: Time stamps within each trajectory [S] [s].
        sample_trajectory: Index of each sample's trajectory [S].
    """

    def __init__(
        self,
        chain: Chain,
        recording: Recording,
        *,
        dt: float = STEP_S,
        device: str = "cpu",
    ):
        """Prepare the trajectories.

        Args:
            chain: A chain of the recording, or of one that this is a subset of.
            recording: The recording.
            dt: Time step [s].
            device: Warp device.

        Raises:
            ValueError: ``dt`` is not positive.
        """
        if not dt > 0.0:
            raise ValueError(f"dt is {dt}; give a positive time step in seconds")
        self.chain = chain
        self.recording = recording
        self.dt = dt
        self.device = device
        self.num_joints = len(chain.joints)
        counts = []
        streams = []
        times = []
        positions = []
        for trajectory in recording.trajectories:
            counts.append(len(trajectory.time))
            streams.append(trajectory.stream)
            times.append(trajectory.time)
            positions.append(trajectory.position[:, chain.columns])
        self._count = np.array(counts, np.int32)
        self._first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int32)
        self._stream = np.array(streams, np.int32)
        self.time = np.concatenate(times)
        self.measured = np.concatenate(positions)
        self.sample_trajectory = np.repeat(np.arange(len(counts)), counts)

    def at(self, dt: float) -> "Rollouts":
        """The same with another time step [s]."""
        return Rollouts(self.chain, self.recording, dt=dt, device=self.device)

    @cached_property
    def _samples(self) -> Samples:
        commands = []
        powers = []
        sent = []
        for trajectory in self.recording.trajectories:
            gain = self._gain(trajectory.conditions)
            commands.append(trajectory.command[:, self.chain.columns])
            powers.append(trajectory.enabled[:, self.chain.columns] * gain)
            sent.append(trajectory.sent)
        samples = Samples()
        samples.step, samples.fraction = self._steps_of(self.time)
        samples.sent_step, samples.sent_fraction = self._steps_of(np.concatenate(sent))
        samples.command = self._floats(np.concatenate(commands))
        samples.power = self._floats(np.concatenate(powers))
        return samples

    def _steps_of(self, time: np.ndarray) -> tuple[wp.array, wp.array]:
        """Times [s] as whole steps and a fraction in [0, 1)."""
        steps = time / self.dt
        whole = np.floor(steps)
        # In single precision a fraction just under 1 is 1: the next step, which must then be
        # counted.
        fraction = (steps - whole).astype(np.float32)
        whole = whole + (fraction >= 1.0)
        fraction = np.where(fraction < 1.0, fraction, 0.0)
        return self._integers(whole), self._floats(fraction)

    def _gain(self, conditions: dict[str, float | str]) -> float:
        reference = self.chain.reference_p_gain
        return float(conditions.get("p_gain", reference)) / reference if reference else 1.0

    def _integers(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=int, device=self.device)

    def _floats(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=float, device=self.device)

    @cached_property
    def _links(self) -> list[Any]:
        """Slots, lower and upper stops, efforts, whether links have mass, and the links."""
        chain = self.chain
        bounds = map(self._floats, (chain.lower, chain.upper, chain.effort))
        return [self._integers(chain.slot), *bounds, int(chain.bodies), links_of(chain)]

    def predict(
        self,
        rows: np.ndarray,
        trajectories: Sequence[int] | np.ndarray | None = None,
        *,
        joint: int | None = None,
        keep: np.ndarray | None = None,
    ) -> np.ndarray:
        """Recorded positions as each parameter set would have them, in one launch.

        Joints start at rest where they were measured. A rollout that diverges stays finite, far
        away.

        Args:
            rows: Parameter rows of C sets [C, n, PARAMETER_COLUMNS].
            trajectories: Indices of the trajectories, in the order wanted; all by default.
            joint: The only joint whose positions are wanted.
            keep: Which of the trajectories to simulate with each set [C, trajectories]; all by
                default.

        Returns:
            Positions [C, S', n] [rad], or [C, S'] of one joint, float32, S' samples of the chosen
            trajectories one after the other; 0 in those not simulated.

        Raises:
            ValueError: ``rows`` has another shape.
        """
        n = self.num_joints
        rows = np.asarray(rows, np.float32)
        if rows.ndim != 3 or rows.shape[1:] != (n, servo.PARAMETER_COLUMNS):
            raise ValueError(
                f"rows has shape {rows.shape}; it must be (C, {n}, {servo.PARAMETER_COLUMNS})"
            )
        chosen = (
            np.arange(len(self._count)) if trajectories is None else np.asarray(trajectories, int)
        )
        counts = self._count[chosen]
        length = int(counts.sum())
        width = n if joint is None else 1
        kept = np.ones((len(rows), len(counts)), bool) if keep is None else keep
        index, place = np.nonzero(kept)
        trajectory = chosen[place]
        parameters = rows[index]
        self._scale_loads(parameters, trajectory)
        output = index * length + (np.cumsum(counts) - counts)[place]
        wanted = np.full(len(index), -1 if joint is None else joint)
        predicted = wp.zeros((len(rows) * length, width), dtype=float, device=self.device)
        if len(trajectory):
            self._launch(parameters, trajectory, output, wanted, predicted)
        shape = (len(rows), length, width)
        return predicted.numpy().reshape(shape if joint is None else shape[:2])

    def _launch(
        self,
        parameters: np.ndarray,
        trajectory: np.ndarray,
        output: np.ndarray,
        wanted: np.ndarray,
        predicted: wp.array,
    ) -> None:
        """Simulate R rollouts: parameters [R, n, PARAMETER_COLUMNS], and the rest [R]."""
        device = self.device
        shape = (len(trajectory), self.num_joints, servo.STATE_COLUMNS)
        state = wp.empty(shape, dtype=float, device=device)
        first = self._first[trajectory]
        wp.launch(
            rollout_kernel(room_for(self.num_joints)),
            dim=len(trajectory),
            inputs=[
                self._samples,
                self._integers(first),
                self._integers(self._count[trajectory]),
                self._integers(output),
                self._integers(self._stream[trajectory]),
                self._floats(self.measured[first]),
                self._integers(wanted),
                *self._links,
                self._floats(parameters.reshape(-1, servo.PARAMETER_COLUMNS)),
                self.dt,
            ],
            outputs=[state, predicted],
            device=device,
        )

    def _scale_loads(self, parameters: np.ndarray, trajectory: np.ndarray) -> None:
        """Turn inertia and gravity torque from the reference load's to each trajectory's, in place.

        The gravity torque scales with mass times arm. The inertia changes by the difference of the
        point masses, in the unit of torque in which the gravity torque stands.
        """
        reference = self.chain.reference_load
        if reference is None:
            return
        for index in np.unique(trajectory):
            load = load_of(self.recording.trajectories[index].conditions)
            if load is None or (load.mass_kg, load.arm_m) == (reference.mass_kg, reference.arm_m):
                continue
            here = trajectory == index
            unit = parameters[here, :, servo.GRAVITY_TORQUE] / reference.torque
            inertia = parameters[here, :, servo.INERTIA] + unit * (load.inertia - reference.inertia)
            parameters[here, :, servo.INERTIA] = np.maximum(inertia, 0.0)
            parameters[here, :, servo.GRAVITY_TORQUE] = unit * load.torque
