"""Domain randomisation (Table S3): draws on the device, written into the simulator's model."""

from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
import warp as wp

from vd.assets_usd.objects.model import ObjectModel
from vd.envs.servo import gain_scales, plain_servos
from vd.envs.task_state import TaskState
from vd.kernels.servo.actuators import INERTIA, PAYLOAD_INERTIA
from vd.kernels.task.environments import (
    copy_columns_kernel,
    redraw_mask_kernel,
    write_friction_kernel,
    write_object_force_kernel,
)
from vd.kernels.task.observations import teacher_observation_size
from vd.kernels.task.randomisation import (
    disturbance_force_kernel,
    draw_dynamics_kernel,
    draw_masses_kernel,
    draw_servo_kernel,
    scale_masses_kernel,
)
from vd.paper import PAPER
from vd.sim.graphs import Graphs
from vd.sim.scene import SHAPE_HAND, SHAPE_OBJECT, SHAPE_TABLE

# Drawn gains and frictions reach the solver once a second: an environment in this many has new ones
# then.
PUSH_INTERVAL_S = 1.0


class Randomiser:
    """Masses once at start-up; servos at resets, frictions and the like at some; forces every step.

    With randomisation off the same arrays hold the nominal values.
    """

    def __init__(self, state: TaskState):
        """Allocate, and draw the masses."""
        self._state = state
        cfg = state.cfg
        self.enabled = cfg.randomisation.enabled
        n, d = state.num_envs, state.num_joints
        device = state.device

        zeros = state.zeros

        self.kp = zeros(n, d, saved="kp")
        self.kd = zeros(n, d, saved="kd")
        """Joint stiffness [N m/rad] and damping [N m s/rad], shape [N, D]."""
        self.hand_friction = zeros(n, saved="hand_friction")
        self.object_friction = zeros(n, saved="object_friction")
        self.table_friction = zeros(n, saved="table_friction")
        model, scene = state.sim.model, state.scene
        self.object_mass = model.body_mass.reshape((n, -1))[:, scene.object_body]
        """Object mass [kg], shape [N], where the model holds it."""
        self.action_offset = zeros(n, d, saved="action_offset")
        # Not of the shape's values, which no sensor measures.
        size = teacher_observation_size(state.num_fingers, state.num_joints)
        self.observation_offset = zeros(n, size, saved="observation_offset")
        self.force = zeros(n, dtype=wp.vec3, saved="force")
        """Disturbance force on the object [N], world frame, shape [N]."""
        self._no_force = zeros(n, dtype=wp.vec3)
        if self.enabled:
            state.sim.force_steps = cfg.randomisation.force_steps(cfg.sim)
        self._gravity = wp.vec3(*state.sim.model.gravity.numpy()[0].tolist())
        self._age = zeros(n, dtype=wp.int32, saved="dynamics_age")
        self._due = zeros(n, dtype=wp.int32)
        self._interval = round(cfg.randomisation.redraw_s * cfg.sim.control_hz)
        self._push_interval = round(PUSH_INTERVAL_S * cfg.sim.control_hz)
        self._graphs = Graphs(device)

        self._nominal_kp = wp.array(state.hand.kp, dtype=float, device=device)
        self._nominal_kd = wp.array(state.hand.kd, dtype=float, device=device)
        kp_scale, kd_scale = gain_scales(state.hand, cfg.randomisation)
        blended = state.parameters.blended
        self._kp_scale = blended(1.0, kp_scale, wp.vec2)
        self._kd_scale = blended(1.0, kd_scale, wp.vec2)
        plain = plain_servos(state.hand, state.servo_ranges)
        self._servo_ranges = blended(plain, state.servo_ranges, wp.vec2)
        inertia = state.servo_ranges[:, [INERTIA, PAYLOAD_INERTIA]]
        self._inertia_varies = bool(np.any(inertia[..., 0] != inertia[..., 1]))
        random = cfg.randomisation
        table = (cfg.table_friction,) * 2
        mass = (PAPER.materials.object_mass_kg,) * 2
        nominal = self._ranges("table_friction", table)
        drawn = self._ranges("table_friction", random.table_friction if self.enabled else table)
        self._table_friction = blended(nominal, drawn, wp.vec2)
        masses = self._ranges("mass", random.object_mass_kg if self.enabled else mass)
        self._object_mass = wp.array(masses, dtype=wp.vec2, device=device)
        measured = self._of_objects(["table_friction" in item.contact for item in state.objects])
        # The average of table and object, as the paper's engine has it; what was measured is of the
        # pair.
        self._table_share = wp.array(np.where(measured, 1.0, 0.5), dtype=float, device=device)
        self._shape_kind = wp.array(scene.shape_kind, dtype=wp.int32, device=device)
        self._nominal_friction = wp.clone(model.shape_material_mu)
        self._places = wp.clone(state.sim.solver.mjw_data.geom_xpos)
        self._model_kp = model.joint_target_ke.reshape((n, -1))
        self._model_kd = model.joint_target_kd.reshape((n, -1))
        self._draw_masses()

    def _of_objects(self, values: Sequence[Any]) -> np.ndarray:
        """A value of each object as one of each environment, shape [N, ...]."""
        return np.array(values)[self._state.scene.world_object]

    def _ranges(self, name: str, usual: tuple[float, float]) -> np.ndarray:
        """Range of a parameter in each environment [N, 2].

        An identified one varies within its interval.
        """

        def of(item: ObjectModel) -> tuple[float, float]:
            if name not in item.contact:
                return usual
            (value,), (low,), (high,) = item.contact[name]
            return (low, high) if usual[0] < usual[1] else (value, value)

        return self._of_objects(list(map(of, self._state.objects)))

    def _draw_masses(self) -> None:
        """Draw link and object masses, with which inertias scale, and where the objects' centres are."""
        state, scene = self._state, self._state.scene
        n, model = state.num_envs, state.sim.model
        link_scale = wp.ones((n, len(scene.link_body)), dtype=float, device=state.device)
        drawn = state.zeros(n)
        everywhere = wp.ones(n, dtype=wp.int32, device=state.device)
        state.launch(
            draw_masses_kernel,
            [self._object_mass, state.parameters.randomisation, everywhere, state.rng],
            [link_scale, drawn],
        )
        factor = np.ones((n, scene.bodies_per_world))
        factor[:, scene.link_body] = link_scale.numpy()
        if self.enabled:  # else objects weigh what their files say
            factor[:, scene.object_body] = drawn.numpy() / self.object_mass.numpy()
        self._mass_factor = wp.array(factor.ravel(), dtype=float, device=state.device)
        self._inertial = [
            model.body_mass,
            model.body_inv_mass,
            model.body_inertia,
            model.body_inv_inertia,
        ]
        self._own_inertial = list(map(wp.clone, self._inertial))
        shift = state.cfg.randomisation.object_com_m
        if self.enabled and shift > 0.0:
            direction = np.random.default_rng(state.cfg.seed).normal(size=(n, 3))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            centre = model.body_com.numpy().reshape(n, -1, 3)
            centre[:, scene.object_body] += shift * direction
            model.body_com.assign(centre.reshape(-1, 3))
        self.set_masses(1.0)

    def set_masses(self, level: float) -> None:
        """Give links and objects the masses of their files at level 0 of physics, those drawn at 1."""
        own = [level, self._mass_factor, *self._own_inertial]
        count = len(self._mass_factor)
        self._state.launch(scale_masses_kernel, own, self._inertial, dim=count)
        flags = newton.ModelFlags.BODY_INERTIAL_PROPERTIES
        self._state.sim.solver.notify_model_changed(flags)

    def redraw(self, reset: wp.array) -> None:
        """Draw servos for the environments of ``reset``, and what the solver holds where it is old enough."""
        if not self.enabled:
            return
        self._state.launch(redraw_mask_kernel, [reset, self._interval, self._age], [self._due])
        self._draw_dynamics(self._due)
        self._draw_servos(reset)

    def draw(self, mask: wp.array) -> None:
        """Draw all but the masses where ``mask`` [N] is set."""
        self._draw_dynamics(mask)
        self._draw_servos(mask)

    def _draw_dynamics(self, mask: wp.array) -> None:
        """Draw gains, frictions and constant errors."""
        state = self._state
        ranges = (
            self._kp_scale,
            self._kd_scale,
            self._table_friction,
            state.parameters.randomisation,
        )
        state.launch(
            draw_dynamics_kernel,
            [self._nominal_kp, self._nominal_kd, *ranges, mask, state.rng],
            [
                self.kp,
                self.kd,
                self.hand_friction,
                self.object_friction,
                self.table_friction,
                self.action_offset,
                self.observation_offset,
            ],
        )

    def _draw_servos(self, mask: wp.array) -> None:
        """Draw delays, friction, backlash and the like.

        The servos read them in every physics step.
        """
        state = self._state
        if state.sim.servo is not None:
            state.launch(
                draw_servo_kernel,
                [self._servo_ranges, mask, self.kp, self.kd, state.rng],
                [state.sim.servo.parameters],
            )

    def disturb(self) -> None:
        """Draw this control step's disturbance force, and apply it and what carries the object."""
        state = self._state
        if self.enabled:
            state.launch(
                disturbance_force_kernel,
                [self.object_mass, state.parameters.force, self.force, state.rng],
                [],
            )
        elif not state.cfg.curriculum.lightens:
            return
        self._write_force(self.force, state.sim.body_force)
        if state.cfg.curriculum.lightens:
            self._write_force(self._no_force, state.sim.lasting_force)

    def _write_force(self, force: wp.array, out: wp.array) -> None:
        """Write a force on the objects, shape [N], and what carries them, as forces on bodies [N, B]."""
        state = self._state
        state.launch(
            write_object_force_kernel,
            [
                self.object_mass,
                state.parameters.must_lift,
                self._gravity,
                state.parameters.weight,
                state.scene.object_body,
                force,
            ],
            [out],
        )

    def after_step(self, steps: int) -> None:
        """Hand what was drawn in this step to the solver, once a second (outside the step's graph)."""
        if not self.enabled or steps % self._push_interval:
            return
        if self._state.device == "cpu":
            self.write_model()
            return
        self._graphs.replay(self._push_gains_and_frictions)
        self._push_inertia()

    def write_model(self) -> None:
        """Write gains, frictions and inertias of rotors into the model and tell the solver."""
        self._push_gains_and_frictions()
        self._push_inertia()

    def _push_inertia(self) -> None:
        # The solver computes constants from it in memory of its own: not for a graph.
        if self._state.sim.servo is not None and self._inertia_varies:
            self._state.sim.servo.push_inertia()

    def _push_gains_and_frictions(self) -> None:
        state = self._state
        model = state.sim.model
        flags = newton.ModelFlags.SHAPE_PROPERTIES
        if state.sim.servo is None:  # which sets the gains itself, in every physics step
            flags |= newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES
            for gains, of_model in ((self.kp, self._model_kp), (self.kd, self._model_kd)):
                state.launch(copy_columns_kernel, [gains], [of_model], dim=gains.shape)
        state.launch(
            write_friction_kernel,
            [
                model.shape_world,
                self._shape_kind,
                self._nominal_friction,
                self._table_share,
                PAPER.materials.friction,
                SHAPE_TABLE,
                SHAPE_OBJECT,
                SHAPE_HAND,
                self.hand_friction,
                self.object_friction,
                self.table_friction,
            ],
            [model.shape_material_mu],
            dim=model.shape_count,
        )
        # The solver then puts fixed shapes back to where the model has them: tables that were taken
        # away.
        places = state.sim.solver.mjw_data.geom_xpos
        wp.copy(self._places, places)
        state.sim.solver.notify_model_changed(flags)
        wp.copy(places, self._places)
