"""Step many worlds with SolverMuJoCo, with the velocity limits and guards the solver lacks."""

from collections.abc import Callable

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from vd.kernels.launch import launch
from vd.kernels.task.actions import limit_joint_velocity_kernel
from vd.kernels.task.contacts import pair_force_kernel
from vd.kernels.task.environments import place_table_kernel
from vd.kernels.task.guard import collect_overflow_kernel, guard_kernel, put_back_kernel
from vd.paper import PAPER
from vd.sim.cfg import SimCfg
from vd.sim.engine import make_solver
from vd.sim.joint_servo import JointServo
from vd.sim.pair_order import sort_pairs
from vd.sim.scene import SHAPE_OBJECT, SHAPE_OTHER, SHAPE_TABLE, Scene

# Faster than any joint (8 rad/s) or dropped object (2 m/s) can be; an object that spins faster than
# this is a solver failure on its way to NaN.
MAX_SPEED = 500.0

# Height of a table that is not there [m]: an object that is lost on the way down is reset long
# before.
AWAY_M = -10.0

CHECKED = 128
"""Steps on a GPU between two looks at whether values were finite, for which it is waited."""

# MuJoCo Warp's overflow bits that mean lost contacts or constraint rows, by the setting to change.
# Its other bits count solver and line-search iterations, which are stopping rules, not losses.
OVERFLOW_REMEDY = {
    1 << 0: ("constraint rows", "sim.njmax"),
    1 << 1: ("constraint Jacobian entries", "sim.njmax"),
    1 << 2: ("broad-phase pairs", "sim.nconmax"),
    1 << 3: ("contacts", "sim.nconmax"),
    1 << 4: ("overlapping convex pairs", "sim.nccdmax"),
}


class SimulationError(RuntimeError):
    """The simulation lost contacts or left the finite numbers; says what to change."""


class Simulator:
    """N worlds in Newton; one call simulates one control step without touching the host.

    Views per world (D hand joints, B bodies): ``joint_q`` [N, D + 7], ``joint_qd`` [N, D + 6],
    ``target`` [N, T] with T >= D, ``body_q`` [N, B], ``body_qd`` [N, B], ``body_force`` [N, B].
    """

    def __init__(
        self,
        scene: Scene,
        cfg: SimCfg,
        *,
        servo_rows: np.ndarray | None = None,
        servo_seed: int = 0,
    ):
        """Build the solver of a scene.

        Args:
            scene: The worlds.
            cfg: Physics settings.
            servo_rows: Parameters of every joint's servo, shape [D, P] or [N, D, P]
                (:mod:`vd.kernels.servo.actuators`); the solver's plain drives by default.
            servo_seed: Seed of the random delays and losses of commands.
        """
        cfg.validate()
        self.scene = scene
        self.cfg = cfg
        self.model = scene.model
        self.device = self.model.device
        self.num_envs = n = scene.num_envs
        self.solver = make_solver(self.model, cfg, scene.worlds)
        self.state = self.model.state()
        self._next = self.model.state()
        self.control = self.model.control()
        if self.device.is_cuda:  # a processor has no warps that would wait
            sort_pairs(self.solver.mjw_model, self.solver.mjw_data)
        self._observables = self.solver.observables({SolverMuJoCo.ObservableKind.OVERFLOW})

        def per_env(state: newton.State) -> list[wp.array]:
            arrays = state.joint_q, state.joint_qd, state.body_q, state.body_qd, state.body_f
            return [array.reshape((n, -1)) for array in arrays]

        self.joint_q, self.joint_qd, self.body_q, self.body_qd, self.body_force = per_env(
            self.state
        )
        *self._next_arrays, self._next_body_force = per_env(self._next)
        self.target = self.control.joint_target_q.reshape((n, -1))
        self.servo: JointServo | None = None
        """The identified servos, or None: then ``target`` goes to the solver's drives as it is."""

        self.velocity_limit = wp.array(scene.hand.velocity_limit, dtype=float, device=self.device)
        """Joint speed limits [rad/s], shape [D]."""
        geom_shape = self.solver.mjc_geom_to_newton_shape.numpy()
        kind = np.where(geom_shape >= 0, scene.shape_kind[geom_shape], SHAPE_OTHER)
        self._geom_kind = wp.array(kind, dtype=wp.int32, device=self.device)
        self.table_force = wp.zeros(n, dtype=float, device=self.device)
        """Normal force between object and table at the end of the control step [N], shape [N]."""
        self.overflow = wp.zeros(n, dtype=wp.int32, device=self.device)
        self.failures = wp.zeros(n, dtype=wp.int32, device=self.device)
        """Control steps that left the finite numbers or were too fast, shape [N]."""
        self.failed = wp.zeros(n, dtype=wp.int32, device=self.device)
        """1 where the latest control step did, shape [N]."""
        self.force_steps = cfg.substeps
        """Physics steps of a control step in which ``body_force`` acts, then :attr:`lasting_force`
        does.
        """
        self.lasting_force = wp.zeros_like(self.body_force)
        """What goes on once ``force_steps`` are over [N, N m], shape [N, B]."""
        self.after_physics_step: Callable[[wp.array, wp.array, wp.array, wp.array], None] | None = (
            None
        )
        """Called in every physics step with the new positions, velocities and link poses and
        velocities, shape [N, *]; device work only."""
        self._start_q = wp.clone(self.joint_q)
        if servo_rows is not None:
            self.target = wp.clone(self.target)  # the drives' references become the servos' output
            self.servo = JointServo(
                self.solver,
                self.control,
                self.joint_q,
                servo_rows,
                scene.hand.fingers,
                physics_dt=cfg.physics_dt,
                control_dt=cfg.control_dt,
                seed=servo_seed,
            )

    def step(self) -> None:
        """Simulate one control step with the present ``target`` and ``body_force``.

        Device work only, so that it can be captured in a CUDA graph, where the solver allows it
        (:attr:`vd.sim.engine.WarpSolver.captured`).
        """
        wp.copy(self._start_q, self.joint_q)
        wp.copy(self._next_body_force, self.body_force)
        if self.servo is not None:
            self.servo.send(self.target)
        self.physics_steps()
        if self.servo is not None:
            self.servo.measure()
        self._table_contact()
        launch(
            guard_kernel,
            self.num_envs,
            [self.joint_q, self.joint_qd, MAX_SPEED],
            [self.failures, self.failed],
        )

    def put_back(self, step_count: wp.array, last_step: int) -> None:
        """Put worlds of which this step failed back to its begin (:func:`put_back_kernel`)."""
        launch(
            put_back_kernel,
            self.num_envs,
            [self.failed, self._start_q, last_step],
            [self.joint_q, self.joint_qd, step_count],
        )

    def physics_steps(self) -> None:
        """The physics steps of one control step alone; states end where they began."""
        here = self.state, self.joint_q, self.joint_qd, self.body_q, self.body_qd
        there = self._next, *self._next_arrays
        for step in range(self.cfg.substeps):
            if step == self.force_steps:
                wp.copy(self.body_force, self.lasting_force)
                wp.copy(self._next_body_force, self.lasting_force)
            if self.servo is not None:
                self.servo.receive()
                self.servo.drive(*here[1:3])
            self.solver.step(
                here[0],
                there[0],
                self.control,
                None,
                self.cfg.physics_dt,
                observables=self._observables,
            )
            self._limit_and_collect(here[1], *there[1:3])
            if self.after_physics_step is not None:
                self.after_physics_step(*there[1:])
            here, there = there, here

    def _limit_and_collect(self, previous_q: wp.array2d, q: wp.array2d, qd: wp.array2d) -> None:
        # The solver knows no joint velocity limits.
        if self.servo is not None:
            self.servo.finish(previous_q, q, qd)
        else:
            dim = self.num_envs, len(self.velocity_limit)
            limits = [self.velocity_limit, self.cfg.physics_dt, previous_q]
            launch(limit_joint_velocity_kernel, dim, limits, [q, qd])
        raised = [self._observables.overflow, sum(OVERFLOW_REMEDY)]
        launch(collect_overflow_kernel, self.num_envs, raised, [self.overflow])

    def _table_contact(self) -> None:
        self.solver.publish_contacts()
        data = self.solver.mjw_data
        contact = data.contact
        self.table_force.zero_()
        launch(
            pair_force_kernel,
            data.naconmax,
            [
                *(data.nacon, contact.worldid, contact.geom, contact.efc_address, data.efc.force),
                *(self._geom_kind, SHAPE_TABLE, SHAPE_OBJECT),
            ],
            [self.table_force],
        )

    def place_table(self, *, present: bool) -> None:
        """Put the table where it belongs, or out of reach of everything, in all worlds."""
        n = self.num_envs
        counts = wp.zeros(n, dtype=wp.int32, device=self.device)
        self.place_tables(counts, wp.full(n, int(present), dtype=wp.int32, device=self.device))

    def place_tables(self, step_count: wp.array, last_step: wp.array) -> None:
        """Put each world's table where it belongs until its last step, then out of reach.

        The solver computes where fixed shapes are once, when it is built, so this is written into
        its data, where a captured step finds it. Device work only.

        Args:
            step_count: Control steps since the world's reset, shape [N].
            last_step: Control steps for which each table stays, shape [N].
        """
        launch(
            place_table_kernel,
            self._geom_kind.shape,
            [self._geom_kind, SHAPE_TABLE, step_count, last_step, PAPER.scene.table_top_m, AWAY_M],
            [self.solver.mjw_data.geom_xpos],
        )

    def forward_kinematics(self) -> None:
        """Refresh ``body_q`` and ``body_qd`` of all worlds from the joint state (after a reset)."""
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def check(self, tolerated: float = 0.0) -> None:
        """Raise if a step lost contacts, or more steps failed than are tolerated (two host reads).

        Args:
            tolerated: Control steps of worlds that may have left the finite numbers or been too
                fast.

        Raises:
            SimulationError: Names the worlds, the numbers and the setting to change.
        """
        overflow = self.overflow.numpy()
        if overflow.any():
            worlds = np.flatnonzero(overflow)
            names = {self.scene.objects[self.scene.world_object[w]].name for w in worlds}
            lines = [
                f"ran out of {what}: raise {setting} (now "
                f"{getattr(self.cfg, setting.removeprefix('sim.'))})"
                for bit, (what, setting) in OVERFLOW_REMEDY.items()
                if np.any(overflow & bit)
            ]
            raise SimulationError(
                f"{len(worlds)} of {self.num_envs} environments lost contacts (first: {worlds[0]}; "
                f"objects: {', '.join(sorted(names)[:5])}): {'; '.join(lines)}"
            )
        failures = self.failures.numpy()
        if failures.sum() > tolerated:
            worlds = np.flatnonzero(failures)
            name = self.scene.objects[self.scene.world_object[worlds[0]]].name
            raise SimulationError(
                f"{len(worlds)} of {self.num_envs} environments left the finite numbers or "
                f"exceeded {MAX_SPEED:g} m/s or rad/s (first: world {worlds[0]}, object {name}). "
                "Raise sim.physics_hz or sim.contact_time_constant_s"
            )
