"""Domain randomisation (Table S3): draws on the device, written into the simulator's model."""

from typing import TYPE_CHECKING, Any

import newton
import numpy as np
import warp as wp

from vd.envs.servo import gain_scales
from vd.kernels.actuators import INERTIA, PAYLOAD_INERTIA
from vd.kernels.observations import teacher_observation_size
from vd.kernels.randomisation import (
    disturbance_force_kernel,
    draw_dynamics_kernel,
    draw_masses_kernel,
    draw_restitution_kernel,
    draw_servo_kernel,
)
from vd.kernels.worlds import (
    redraw_mask_kernel,
    write_friction_kernel,
    write_gains_kernel,
    write_object_force_kernel,
)
from vd.paper import PAPER
from vd.sim.scene import SHAPE_HAND, SHAPE_OBJECT, SHAPE_TABLE

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

# Drawn gains and frictions reach the solver once a second: a world in this many has new ones then.
PUSH_INTERVAL_S = 1.0


class Randomiser:
    """Masses once at start-up; gains, servos, frictions and constant errors at resets; forces every step.

    With randomisation off the same arrays hold the nominal values.
    """

    def __init__(self, env: "ReorientEnv"):
        """Allocate for ``env`` and draw the masses."""
        self._env = env
        cfg = env.cfg
        self.enabled = cfg.randomisation.enabled
        n, d = env.num_worlds, env.num_actions
        device = env.device

        def zeros(*shape: int, dtype: Any = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.kp, self.kd = zeros(n, d), zeros(n, d)
        """Joint stiffness [N m/rad] and damping [N m s/rad], shape [N, D]."""
        self.hand_friction, self.object_friction, self.table_friction = zeros(n), zeros(n), zeros(n)
        self.object_mass = zeros(n)
        """Object mass [kg], shape [N]."""
        self.action_offset = zeros(n, d)
        # Not of the shape's values, which no sensor measures.
        self.observation_offset = zeros(n, teacher_observation_size(env.num_fingers))
        self.force = zeros(n, dtype=wp.vec3)
        """Disturbance force on the object [N], world frame, shape [N]."""
        self._no_force = zeros(n, dtype=wp.vec3)
        if self.enabled:
            env.sim.force_steps = cfg.randomisation.force_steps(cfg.sim)
        self._gravity = wp.vec3(*env.sim.model.gravity.numpy()[0].tolist())
        self._age, self._due = zeros(n, dtype=wp.int32), zeros(n, dtype=wp.int32)
        self._interval = round(cfg.randomisation.redraw_s * cfg.sim.control_hz)
        self._push_interval = round(PUSH_INTERVAL_S * cfg.sim.control_hz)
        self._push_graph: Any = None

        model, scene = env.sim.model, env.scene
        self._nominal_kp = wp.array(env.hand.kp, dtype=float, device=device)
        self._nominal_kd = wp.array(env.hand.kd, dtype=float, device=device)
        kp_scale, kd_scale = gain_scales(env.hand, cfg.randomisation)
        self._kp_scale = wp.array(kp_scale, dtype=wp.vec2, device=device)
        self._kd_scale = wp.array(kd_scale, dtype=wp.vec2, device=device)
        self._servo_ranges = wp.array(env.servo_ranges, dtype=wp.vec2, device=device)
        inertia = env.servo_ranges[:, [INERTIA, PAYLOAD_INERTIA]]
        self._inertia_varies = bool(np.any(inertia[..., 0] != inertia[..., 1]))
        self._shape_kind = wp.array(scene.shape_kind, dtype=wp.int32, device=device)
        self._nominal_friction = wp.clone(model.shape_material_mu)
        self._model_kp = model.joint_target_ke.reshape((n, -1))
        self._model_kd = model.joint_target_kd.reshape((n, -1))
        self._draw_masses()

    def _draw_masses(self) -> None:
        """Draw link and object masses; inertias scale with them."""
        env = self._env
        n, model = env.num_worlds, env.sim.model
        link_scale = wp.ones((n, len(env.scene.link_body)), dtype=float, device=env.device)
        wp.launch(
            draw_masses_kernel,
            dim=n,
            inputs=[env.parameters.randomisation, wp.ones(n, dtype=wp.int32, device=env.device), env.rng],
            outputs=[link_scale, self.object_mass],
            device=env.device,
        )
        factor = np.ones((n, env.scene.bodies_per_world))
        factor[:, env.scene.link_body] = link_scale.numpy()
        mass = model.body_mass.numpy().reshape(n, -1)
        if not self.enabled:  # nothing is drawn: objects weigh what their files say
            self.object_mass.assign(mass[:, env.scene.object_body])
        factor[:, env.scene.object_body] = self.object_mass.numpy() / mass[:, env.scene.object_body]
        flat = factor.reshape(-1)
        inverse = 1.0 / flat
        for array, scale in (
            (model.body_mass, flat),
            (model.body_inv_mass, inverse),
            (model.body_inertia, flat[:, None, None]),
            (model.body_inv_inertia, inverse[:, None, None]),
        ):
            array.assign((array.numpy() * scale).astype(np.float32))
        env.sim.solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)

    def redraw(self, reset: wp.array) -> None:
        """Draw anew for the worlds of ``reset`` whose dynamics are old enough."""
        if not self.enabled:
            return
        wp.launch(
            redraw_mask_kernel,
            dim=self._env.num_worlds,
            inputs=[reset, self._interval, self._age],
            outputs=[self._due],
            device=self._env.device,
        )
        self.draw(self._due)

    def draw(self, mask: wp.array) -> None:
        """Draw gains, servos, frictions, restitution and constant errors for the worlds of ``mask`` [N]."""
        env = self._env
        wp.launch(
            draw_dynamics_kernel,
            dim=env.num_worlds,
            inputs=[
                self._nominal_kp,
                self._nominal_kd,
                self._kp_scale,
                self._kd_scale,
                env.parameters.randomisation,
                mask,
                env.rng,
            ],
            outputs=[
                self.kp,
                self.kd,
                self.hand_friction,
                self.object_friction,
                self.table_friction,
                self.action_offset,
                self.observation_offset,
            ],
            device=env.device,
        )
        if env.sim.servo is not None:
            wp.launch(
                draw_servo_kernel,
                dim=env.num_worlds,
                inputs=[self._servo_ranges, mask, self.kp, self.kd, env.rng],
                outputs=[env.sim.servo.parameters],
                device=env.device,
            )
        if env.sim.restitution is not None:
            drawn = env.sim.restitution
            wp.launch(
                draw_restitution_kernel,
                dim=env.num_worlds,
                inputs=[wp.vec2(*env.cfg.randomisation.restitution), mask, env.rng],
                outputs=[drawn.hand, drawn.object, drawn.table],
                device=env.device,
            )

    def disturb(self) -> None:
        """Draw this control step's disturbance force, and apply it and what carries the object."""
        env = self._env
        if self.enabled:
            wp.launch(
                disturbance_force_kernel,
                dim=env.num_worlds,
                inputs=[self.object_mass, env.parameters.force, self.force, env.rng],
                device=env.device,
            )
        elif not env.cfg.curriculum.lightens:
            return
        self._write_force(self.force, env.sim.body_force)
        if env.cfg.curriculum.lightens:
            self._write_force(self._no_force, env.sim.lasting_force)

    def _write_force(self, force: wp.array, out: wp.array) -> None:
        """Write a force on the objects, shape [N], and what carries them, as forces on bodies [N, B]."""
        env = self._env
        wp.launch(
            write_object_force_kernel,
            dim=env.num_worlds,
            inputs=[
                self.object_mass,
                env.must_lift,
                self._gravity,
                env.parameters.weight,
                env.scene.object_body,
                force,
            ],
            outputs=[out],
            device=env.device,
        )

    def after_step(self, steps: int) -> None:
        """Hand what was drawn in this step to the solver, once a second (outside the step's graph)."""
        if not self.enabled or steps % self._push_interval:
            return
        if self._env.device == "cpu":
            self.push()
            return
        if self._push_graph is None:
            with wp.ScopedCapture(device=self._env.device) as capture:
                self._push_gains_and_frictions()
            self._push_graph = capture.graph
        wp.capture_launch(self._push_graph)
        self._push_inertia()

    def push(self) -> None:
        """Write gains, frictions and inertias of rotors into the model and tell the solver."""
        self._push_gains_and_frictions()
        self._push_inertia()

    def _push_inertia(self) -> None:
        # The solver computes constants from it in memory of its own: not for a graph.
        if self._env.sim.servo is not None and self._inertia_varies:
            self._env.sim.servo.push_inertia()

    def _push_gains_and_frictions(self) -> None:
        env = self._env
        model = env.sim.model
        flags = newton.ModelFlags.SHAPE_PROPERTIES
        if env.sim.servo is None:  # which sets the gains itself, in every physics step
            flags |= newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES
            wp.launch(
                write_gains_kernel,
                dim=(env.num_worlds, env.num_actions),
                inputs=[self.kp, self.kd],
                outputs=[self._model_kp, self._model_kd],
                device=env.device,
            )
        wp.launch(
            write_friction_kernel,
            dim=model.shape_count,
            inputs=[
                model.shape_world,
                self._shape_kind,
                self._nominal_friction,
                PAPER.materials.friction,
                SHAPE_TABLE,
                SHAPE_OBJECT,
                SHAPE_HAND,
                self.hand_friction,
                self.object_friction,
                self.table_friction,
            ],
            outputs=[model.shape_material_mu],
            device=env.device,
        )
        env.sim.solver.notify_model_changed(flags)

    def stateful(self) -> dict[str, wp.array]:
        """Arrays to save with a checkpoint. Masses are drawn from the seed alone and need no saving."""
        return {
            "kp": self.kp,
            "kd": self.kd,
            "hand_friction": self.hand_friction,
            "object_friction": self.object_friction,
            "table_friction": self.table_friction,
            "action_offset": self.action_offset,
            "observation_offset": self.observation_offset,
            "force": self.force,
            "dynamics_age": self._age,
        }
