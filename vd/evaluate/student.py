"""Students in an environment: what they see and sense there, and one at work."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import warp as wp

from vd.assets_usd.objects.model import ObjectModel
from vd.config import from_dict
from vd.evaluate.goals import Goals
from vd.evaluate.scanned import known_objects
from vd.evaluate.senses import EnvironmentSenses
from vd.kernels.task.observations import teacher_observation_slices
from vd.quaternions import canonical, relative_rotation, rotation_distance
from vd.sensors.cfg import DepthCameraCfg
from vd.tracking.symmetry import nearest_goal, symmetries_of_worlds
from vd.vision.cfg import NoiseCfg, StudentCfg
from vd.vision.saved import SavedStudent
from vd.vision.sight import Frame, Sight
from vd.vision.sites import Sites

PRETRAINED, RENDERED = 0, 2
"""Stages of the training: those of encoders that cannot act, and of depth cameras."""
CLOUDS = 256
"""Clouds through the network at once: their features take one or two gigabytes."""


class StudentView:
    """What students see in every environment of an environment, and what only their training knows.

    Args:
        env: The environment.
        network: What of the student concerns its clouds.
        rendered: See by a depth camera; else complete clouds.
        depth: Settings of the camera.
        camera: Pose of its optical frame in the hand's base frame, position [m] and quaternion xyzw; that of
            the hand's camera by default.
        goals: The objects as their goals are shown; as they are by default.
        noise: Noise of training; None where there will be none.
        batch: Clouds of a training batch at most.
        seed: Of noise and camera.
    """

    def __init__(
        self,
        env: Any,
        network: StudentCfg,
        *,
        rendered: bool,
        depth: DepthCameraCfg | None = None,
        camera: Sequence[float] | None = None,
        goals: Sequence[ObjectModel] | None = None,
        noise: NoiseCfg | None = None,
        batch: int = 0,
        seed: int = 0,
    ):
        scene = env.scene
        self.sight = Sight(
            env.hand,
            env.objects,
            network,
            complete=not rendered,
            world_object=scene.world_object,
            world_scale=scene.world_scale,
            goals=goals,
            noise=noise,
            batch=batch,
            seed=seed,
            device=env.device,
        )
        self.senses = EnvironmentSenses(
            env, env.hand.camera.at(camera) if rendered else None, depth, seed=seed
        )
        self._cfg, self._columns = env.cfg.observation, teacher_observation_slices(env.num_fingers)
        self._symmetry = symmetries_of_worlds(env.objects, scene.world_object, env.device)
        self._object_pose = wp.to_torch(env.sim.body_q)[:, scene.object_body]
        self._goal = wp.to_torch(env.goal_quat)

    def frame(self) -> Frame:
        """What there is to see before the next action, and the true ``distance`` to the goal [rad] [N].

        That is the angle to what looks like the goal, if that is nearer.
        """
        frame = self.sight.frame(self.senses.read(), self._object_pose)
        return frame | {"distance": rotation_distance(*self._towards())}

    def observation(self, observed: torch.Tensor) -> torch.Tensor:
        """A teacher's observation [N, O], world frame: of all that looks like the goal the nearest is it.

        The rotation to it is less than half a turn, as at the beginning of every goal of its training.
        """
        orientation, goal = self._towards()
        turn = relative_rotation(orientation, goal)
        kept = canonical(turn)
        goal = torch.where((kept == turn).all(dim=-1, keepdim=True), goal, -goal)
        changed = observed.clone()
        changed[:, self._columns["goal_orientation"]] = canonical(goal) if self._cfg.canonical else goal
        changed[:, self._columns["relative_orientation"]] = kept
        return changed

    def sites(
        self, frame: Mapping[str, torch.Tensor], envs: torch.Tensor | None = None, *, augment: bool
    ) -> Sites:
        """Voxels of frames (:meth:`vd.vision.sight.Sight.sites`)."""
        return self.sight.sites(frame, envs, augment=augment)

    def state_dict(self) -> dict[str, Any]:
        """Random states and what the camera remembers, as NumPy arrays."""
        return {name: array.numpy().copy() for name, array in self._stateful().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        for name, array in self._stateful().items():
            array.assign(state[name])

    def _towards(self) -> tuple[torch.Tensor, torch.Tensor]:
        """True orientation of each environment's object, and the nearest that looks like its goal [N, 4]."""
        orientation = self._object_pose[:, 3:]
        return orientation, nearest_goal(orientation, self._goal, self._symmetry)

    def _stateful(self) -> dict[str, wp.array]:
        camera = self.senses.camera
        return {"noise": self.sight.rng} | ({} if camera is None else camera.stateful())


class StudentActor:
    """The deterministic policy of a student: what it sees, its memory, and the mean of its actions.

    Attributes:
        num_actions: D.
        rendered: Whether it sees by a depth camera.
        predicted: Its distance to the goal before the latest action [rad], shape [N].
        active: Where it acts, shape [N], bool; elsewhere its actions are 0 and cost nothing.
    """

    def __init__(
        self,
        env: Any,
        student: SavedStudent,
        *,
        goals: Goals = "mesh",
        sensor_errors: bool = False,
        seed: int = 0,
    ):
        """Open its eyes in every environment.

        Args:
            env: The environment.
            student: The student.
            goals: What it knows shapes and goals by (:mod:`vd.evaluate.scanned`).
            sensor_errors: Give its camera the errors of a real one, in place of those of its training.
            seed: Of the errors of camera and scans.

        Raises:
            ValueError: It is one of stage 0, which cannot act.
        """
        spec = student.spec
        if spec.stage == PRETRAINED:
            raise ValueError("a student of stage 0 is an encoder, which cannot act; give one of stage 1 or 2")
        self.env, self.num_actions, self._student = env, spec.num_actions, student.network
        self.rendered = spec.stage == RENDERED
        depth = from_dict(DepthCameraCfg, student.depth, where="depth camera of the student")
        if sensor_errors:
            depth = depth.with_errors()
        self._view = StudentView(
            env,
            spec.network,
            rendered=self.rendered,
            depth=depth,
            camera=spec.camera,
            goals=known_objects(env.objects, goals, seed=seed, device=env.device),
            seed=seed,
        )
        self._hidden = self._student.initial_hidden(env.num_envs)
        self._steps = wp.to_torch(env.step_count)
        self.predicted = self._hidden.new_zeros(env.num_envs)
        self.active = torch.ones(env.num_envs, dtype=torch.bool, device=self._hidden.device)

    def act(self, _observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] for what is seen now; the teacher's observation is not looked at.

        The memory of environments that have just been reset starts empty.
        """
        frame = self._view.frame()
        self._hidden.masked_fill_((self._steps == 0)[:, None], 0.0)
        known = self._student.proprioception(frame)
        mean = frame["action"].new_zeros(frame["action"].shape)
        with torch.no_grad():
            for rows in self.active.nonzero().flatten().split(CLOUDS):
                seen = {key: value[rows] for key, value in frame.items()}
                sites = self._view.sites(seen, rows, augment=False)
                output = self._student.act(sites, known[rows], self._hidden[rows])
                self._hidden[rows] = output.hidden
                self.predicted[rows] = output.distance[:, -1]
                mean[rows] = output.mean
        return mean
