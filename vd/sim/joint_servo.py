"""The identified servo of every hand joint, in every world of a simulation.

The solver's own drive knows kp, kd and an effort limit. :class:`JointServo` puts the missing
effects of :data:`vd.kernels.servo.effects.EFFECTS` around it; without one it is not built and
nothing is launched.
"""

import math
from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from vd.kernels.launch import launch
from vd.kernels.rng import init_rng_kernel
from vd.kernels.servo.actuators import (
    COMMAND_DELAY,
    JITTER_SIGMA,
    PARAMETER_COLUMNS,
    READ_DELAY,
    STATE_COLUMNS,
)
from vd.kernels.servo.effects import EFFECTS, neutral_row
from vd.kernels.servo.joint_servo import (
    MAX_JITTER_SIGMAS,
    drive_joint_kernel,
    finish_joint_kernel,
    joint_inertia_kernel,
    measure_joint_kernel,
    receive_command_kernel,
    reset_joint_kernel,
    send_command_kernel,
)

PARAMETERS = {p.column: (effect.name, p) for effect in EFFECTS.values() for p in effect.parameters}
"""Effect and parameter of every column of a row but the baseline's."""
DELAYS = (COMMAND_DELAY, READ_DELAY, JITTER_SIGMA)
"""Columns whose upper bounds fix the sizes of the buffers."""


def has_effects(rows: np.ndarray) -> bool:
    """Whether any effect is on in parameter rows [..., PARAMETER_COLUMNS]."""
    columns = list(PARAMETERS)
    neutral = np.array(neutral_row(), dtype=np.float32)
    return bool(np.any(np.asarray(rows, dtype=np.float32)[..., columns] != neutral[columns]))


class JointServo:
    """Servos of the D hand joints of N worlds, with their commands in transit and past positions.

    Everything is device work that can be captured in a CUDA graph. P = PARAMETER_COLUMNS.
    """

    def __init__(
        self,
        solver: SolverMuJoCo,
        control: newton.Control,
        joint_q: wp.array2d,
        rows: np.ndarray,
        fingers: Sequence[slice],
        *,
        physics_dt: float,
        control_dt: float,
        seed: int = 0,
    ):
        """Allocate, write the rows and start all servos at the present positions.

        Args:
            solver: The solver, whose model this class writes drives and friction of the hand into.
                The hand's joints are the first of each world, with a position drive each or none.
            control: The control of the simulation; its joint targets become the drives' references
                and its joint forces the torques besides the drives'.
            joint_q: Positions, hand joints first, shape [N, *]; read at every reset.
            rows: Parameter rows, shape [D, P] or [N, D, P].
            fingers: Each finger's joints, as columns.
            physics_dt: Physics step [s].
            control_dt: Time between commands [s].
            seed: Seed of the random delays and losses of commands.

        Raises:
            ValueError: Rows with values that cannot be simulated.
        """
        self.num_envs = n = joint_q.shape[0]
        self.num_joints = d = rows.shape[-2]
        self.dt = physics_dt
        self._solver = solver
        self._control = control
        self._joint_q = joint_q
        self.device = solver.model.device

        def zeros(*shape: int, dtype: Any = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=self.device)

        self.parameters = zeros(n * d, PARAMETER_COLUMNS)
        """Parameter rows, shape [N D, P]. May be written on the device (then
        :meth:`push_inertia`).
        """
        self.state = zeros(n * d, STATE_COLUMNS)
        """State rows, shape [N D, STATE_COLUMNS]."""
        first = np.concatenate(
            [np.full(finger.stop - finger.start, finger.start) for finger in fingers]
        )
        self.first = wp.array(first, dtype=int, device=self.device)
        """First joint of each joint's finger [D]."""
        driven = solver.mjc_actuator_to_newton_idx.numpy()
        actuator = np.full(d, -1)
        actuator[driven] = np.arange(len(driven))
        self._actuator = wp.array(actuator, dtype=int, device=self.device)
        self._dim = n, d
        self.power = wp.ones((n, d), dtype=float, device=self.device)
        """Factor on the controllers' gains; 0 switches the torque off, shape [N, D]."""
        self.reference = zeros(n, d)
        """What filter, profile and backlash make of the commands in the present physics step [rad],
        its mean, shape [N, D]."""
        self.measured_q = zeros(n, d)
        """Positions as the servos report them [rad], with read delay and bias, shape [N, D]."""
        self.measured_qd = zeros(n, d)
        """Velocities as the servos report them [rad/s], with read delay, shape [N, D]."""
        bounds = {column: PARAMETERS[column][1].upper for column in DELAYS}
        longest = bounds[COMMAND_DELAY] + MAX_JITTER_SIGMAS * bounds[JITTER_SIGMA]
        capacity = math.ceil(longest / control_dt) + 2
        past = math.ceil(bounds[READ_DELAY] / physics_dt) + 2
        self._queue = [zeros(n, d, dtype=wp.int32), zeros(n, d, dtype=wp.int32)]
        self._transit = [*self._queue, zeros(n, d, capacity), zeros(n, d, capacity)]
        self._held = zeros(n, d)
        self._history_index = zeros(n, d, dtype=wp.int32)
        self._past = [zeros(n, d, past), zeros(n, d, past)]
        self._rng = zeros(n, dtype=wp.uint32)
        launch(init_rng_kernel, n, [seed], [self._rng])

        model = solver.mjw_model
        self._inverse_inertia = model.dof_invweight0
        self._outputs = [
            control.joint_target_q.reshape((n, -1)),
            control.joint_f.reshape((n, -1)),
            model.actuator_gainprm,
            model.actuator_biasprm,
            model.dof_frictionloss,
            model.dof_solref,
            model.dof_solimp,
        ]
        self._armature = solver.model.joint_armature.reshape((n, -1))
        self._effort = solver.model.joint_effort_limit.reshape((n, -1))
        self.set_rows(rows)
        self.reset(wp.ones(n, dtype=wp.int32, device=self.device))

    def set_rows(self, rows: np.ndarray) -> None:
        """Replace the parameters.

        Args:
            rows: Shape [D, P] for all worlds, or [N, D, P].

        Raises:
            ValueError: Names the joint and the parameter that cannot be simulated.
        """
        n = self.num_envs
        d = self.num_joints
        rows = np.asarray(rows, dtype=np.float32)
        for column, (effect, parameter) in PARAMETERS.items():
            values = rows[..., column]
            limit = parameter.upper if column in DELAYS else np.inf
            bad = ~(np.isfinite(values) & (values <= limit * (1.0 + 1e-6)))
            if bad.any():
                joint = int(np.argwhere(bad)[0][-1])
                raise ValueError(
                    f"joint {joint}: {effect}:{parameter.name} = {values[bad][0]:g} "
                    f"{parameter.unit}; set a finite value of at most {limit:g}"
                )
        self.parameters.assign(np.broadcast_to(rows, (n, d, PARAMETER_COLUMNS)).reshape(n * d, -1))
        self.push_inertia()

    def push_inertia(self) -> None:
        """Hand the rows' inertia to the solver; all else in the rows acts at once, by itself."""
        launch(joint_inertia_kernel, self._dim, [self.parameters], [self._armature])
        self._solver.notify_model_changed(newton.ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES)

    def reset(self, mask: wp.array, *, command: wp.array2d | None = None) -> None:
        """Start the servos of chosen worlds anew, at rest at the present joint positions.

        Call it after the joint positions were reset.

        Args:
            mask: 1 for the worlds to reset, int32, shape [N].
            command: The command they have had so far [rad], shape [N, *]; the positions by default.
        """
        command = self._joint_q if command is None else command
        measured = [*self._past, self.measured_q, self.measured_qd]
        launch(
            reset_joint_kernel,
            self._dim,
            [self.parameters, mask, command, self._joint_q],
            [self.state, *self._queue, self._held, *measured],
        )

    def send(self, command: wp.array2d) -> None:
        """Send a command [rad], shape [N, *], once per control step."""
        inputs = [self.parameters, self.dt, command, self.state]
        launch(send_command_kernel, self.num_envs, inputs, [self._rng, *self._transit])

    def receive(self) -> None:
        """Find the references of the coming physics step from the commands sent."""
        changed = [self.state, *self._transit, self._held, self.reference]
        launch(receive_command_kernel, self._dim, [self.parameters, self.dt], changed)

    def drive(self, joint_q: wp.array2d, joint_qd: wp.array2d) -> None:
        """Advance the servos by one physics step under ``reference`` and set the solver's drives.

        Positions [rad] and velocities [rad/s] are those at the start of the step, shape [N, *].
        """
        joints = [self.parameters, self.first, self._inverse_inertia, self._effort, self._actuator]
        inputs = [self.dt, self.reference, self.power, joint_q, joint_qd]
        launch(drive_joint_kernel, self._dim, [*joints, *inputs], [self.state, *self._outputs])

    def finish(self, previous_q: wp.array2d, joint_q: wp.array2d, joint_qd: wp.array2d) -> None:
        """Apply the velocity limits to the state after a physics step, and remember it.

        Positions before and after the step [rad] and velocities after it [rad/s], shape [N, *].
        """
        changed = [joint_q, joint_qd, self._history_index, *self._past]
        launch(finish_joint_kernel, self._dim, [self.parameters, self.dt, previous_q], changed)

    def measure(self) -> None:
        """Refresh ``measured_q`` and ``measured_qd``, once per control step."""
        inputs = [self.parameters, self.dt, self._history_index, *self._past]
        launch(measure_joint_kernel, self._dim, inputs, [self.measured_q, self.measured_qd])

    def stateful(self) -> dict[str, wp.array]:
        """Arrays to save with a checkpoint, by name."""
        head, count, value, time = self._transit
        position, speed = self._past
        return {
            "servo_parameters": self.parameters,
            "servo_state": self.state,
            "servo_rng": self._rng,
            "servo_held": self._held,
            "servo_transit_head": head,
            "servo_transit_count": count,
            "servo_transit_value": value,
            "servo_transit_time": time,
            "servo_history": position,
            "servo_history_index": self._history_index,
            "servo_speed_history": speed,
            "servo_measured_q": self.measured_q,
            "servo_measured_qd": self.measured_qd,
        }
