"""What the policy observes: state, shape, and what a critic or a teacher is told."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from vd.envs.history import JointHistory
from vd.envs.latency import SeenState
from vd.envs.parts import actor_size, observation_parts
from vd.envs.randomise import Randomiser
from vd.envs.shapes import ShapeObserver
from vd.envs.symmetry import ChosenFrames
from vd.envs.task_state import TaskState
from vd.envs.tracked_pose import TrackedPose
from vd.kernels.task.dynamics import dynamics_kernel
from vd.kernels.task.observations import teacher_observation_kernel, teacher_observation_slices
from vd.paper import PAPER


class Observer:
    """Writes the observations of N environments.

    Attributes:
        parts: Columns of what is observed.
        num_observations: Values that the actor reads, O.
        seen: The state that observations are made of.
        all_values: Everything, in the symmetry frames if there are any, shape [N, A].
        world_values: Everything in the world frame, shape [N, A].
        symmetry_frames: The frames in which the policy observes and acts; None where that is the
            world frame.
        shapes: Observes and measures shapes, or None.
    """

    def __init__(self, state: TaskState, drawn: Randomiser, *, shapes: bool):
        """Allocate for what ``drawn`` has drawn; ``shapes`` also where they are not observed."""
        self._state = state
        self._drawn = drawn
        cfg = state.cfg.observation
        n = state.num_envs
        device = state.device
        self.parts = observation_parts(cfg, state.num_fingers, state.num_joints)
        self.num_observations = actor_size(self.parts)
        self.seen = SeenState(state)
        self._tracked_pose = TrackedPose(state, self.seen)
        self._history = JointHistory(state, self.parts)
        width = max(columns.stop for columns in self.parts.values())

        zeros = state.zeros

        self.all_values = self.world_values = zeros(n, width, saved="observation")
        self.symmetry_frames = ChosenFrames(state, self.all_values) if cfg.view != "world" else None
        if self.symmetry_frames is not None:
            self.world_values = self.symmetry_frames.observation
        self.shapes: ShapeObserver | None = None
        if shapes:
            items = state.surface_points, state.world_object, state.world_scale
            self.shapes = ShapeObserver(*items, state.fingers.tip_body, state.fingers.tip_offset)
        slices = teacher_observation_slices(state.num_fingers, state.num_joints)
        self._body_com = wp.clone(state.sim.model.body_com[: state.scene.bodies_per_world])
        hand = state.hand
        materials = PAPER.materials
        self._gains = [wp.array(gain, dtype=float, device=device) for gain in (hand.kp, hand.kd)]
        self._nominal = wp.vec4(
            materials.friction,
            materials.friction,
            state.cfg.table_friction,
            materials.object_mass_kg,
        )
        self._no_servo = zeros(0, 0)
        self._exact: list[Any] = []
        if "present" in self.parts:
            settings = state.parameters.exact_observation
            self._exact = [
                settings,
                zeros(n, slices["previous_action"].stop),
                zeros(n, dtype=wp.uint32),
            ]

    def split(self, values: wp.array) -> tuple[wp.array, wp.array]:
        """What the actor reads [N, O], and the critic besides [N, A - O], of everything [N, A]."""
        count = self.num_observations
        width = values.shape[1]
        if count == width:
            return values, wp.zeros((values.shape[0], 0), dtype=float, device=values.device)
        return values[:, :count], values[:, count:]

    def begin(self, mask: wp.array) -> None:
        """Begin the episodes of the environments of ``mask`` [N], after their state was reset."""
        self.seen.begin(mask)
        self._tracked_pose.begin(mask)
        self._history.begin(mask)

    def observe(self) -> None:
        """Write the observation of the present state. Device work only."""
        state = self._state
        self._tracked_pose.take()
        self.seen.recall()
        seen = self._tracked_pose.hold(self.seen.arrays)
        noise = state.parameters.observation, self._drawn.observation_offset, state.rng
        self._observe_state(seen, noise, self.world_values[:, self.parts["state"].start :])
        self._history.push(self.world_values)
        if "present" in self.parts:
            sim = state.sim
            true = [sim.joint_q, sim.joint_qd, sim.joint_q, sim.joint_qd, sim.body_q, sim.body_qd]
            self._observe_state(
                true, self._exact, self.world_values[:, self.parts["present"].start :]
            )
        self._tell()
        if self.symmetry_frames is not None:
            self.symmetry_frames.observe()

    def _observe_state(self, seen: Sequence[Any], noise: Sequence[Any], out: wp.array) -> None:
        """Write state and shape to the first columns of ``out``.

        Args:
            seen: As :attr:`SeenState.arrays`.
            noise: Settings of the observation, constant errors [N, *], random streams [N].
            out: Observation in the world frame, shape [N, *].
        """
        state = self._state
        settings, offset, rng = noise
        state.launch(
            teacher_observation_kernel,
            [
                state.lower,
                state.upper,
                state.fingers.tip_body,
                state.fingers.tip_offset,
                self._body_com,
                settings,
                *seen,
                state.goal_quat,
                state.smoothed,
                offset,
                rng,
            ],
            [out],
        )
        if "shape" in self.parts:
            assert self.shapes is not None
            _, _, joint_q, _, body_q, _ = seen
            first = self.parts["shape"].start - self.parts["state"].start
            self.shapes.observe(joint_q, state.num_joints, body_q, state.goal_quat, out, first)

    def _tell(self) -> None:
        """Write what was drawn."""
        if "dynamics" not in self.parts:
            return
        state = self._state
        drawn = self._drawn
        servo = self._no_servo if state.sim.servo is None else state.sim.servo.parameters
        frictions = [drawn.hand_friction, drawn.object_friction, drawn.table_friction]
        state.launch(
            dynamics_kernel,
            [
                *self._gains,
                self._nominal,
                self.parts["dynamics"].start,
                drawn.kp,
                drawn.kd,
                servo,
                *frictions,
                drawn.object_mass,
                self.seen.latency,
            ],
            [self.world_values],
        )
