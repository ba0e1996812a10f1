"""Stages 1 and 2: the student acts in simulation, and the teacher says what it would have done (DAgger).

In stage 1 nothing is rendered: where objects are believed to be is drawn about the truth, so to act
costs hardly more than the simulation; to see is learned from complete clouds, of some of the steps.
In stage 2 the student sees by a depth camera. Where an episode begins it is told about where the
object is, and follows it from there. T steps, N environments, D joints, K points.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from vd.evaluate.camera_actor import sensed, sensed_with
from vd.geometry.quaternions import poses_in
from vd.policy.actor import TrainedPolicy
from vd.policy.senses import Senses
from vd.sensors.depth_camera import DepthCamera
from vd.train.metrics import GoalWindow, StepMeans
from vd.train.student.config import SimulatedCfg, StudentTrainCfg
from vd.train.student.made import off, sought
from vd.train.student.sequences import Looks, Sequences, belief_errors
from vd.train.student.views import goal_points
from vd.train.vec_env import ReorientVecEnv
from vd.vision.acting import ActingStudent
from vd.vision.inputs import Belief, StudentInput, carried, each, joined
from vd.vision.rotations import matrices_about, quaternion_matrices

KEPT = 0.9
"""Of an error of a belief, in the next step (ours): they last most of a second. Not tuned."""


class BeliefErrors:
    """Errors of what is believed, drawn so that they last as those of looks do.

    Args:
        envs: N.
        cfg: How large they are at most.
        device: Torch device.

    Attributes:
        state: Errors of rotations and places in their deviations, and these as shares of the
            largest [N, 7].
    """

    def __init__(self, envs: int, cfg: SimulatedCfg, device: torch.device):
        self._cfg = cfg
        self.state = torch.randn((envs, 7), device=device)
        self.state[:, 6].uniform_()

    def about(self, truth: Belief, fresh: Tensor) -> Belief:
        """Beliefs of the next step, for true ones; where an episode begins, bool [N], others begin."""
        drawn = torch.randn_like(self.state)
        later = KEPT * self.state + math.sqrt(1.0 - KEPT**2) * drawn
        later[:, 6] = self.state[:, 6]
        drawn[:, 6].uniform_()
        self.state = torch.where(fresh[:, None], drawn, later)
        turn = self._cfg.belief_rad * self.state[:, 6:] * self.state[:, :3]
        shift = self._cfg.belief_m * self.state[:, 6:] * self.state[:, 3:6]
        rotation = matrices_about(turn, turn.norm(dim=1)) @ truth.rotation
        return Belief(rotation, truth.position + shift)


class SimulatedSequences:
    """Lets a student act in environments, and labels what it comes to.

    Args:
        env: The environments, without noise of what the teacher observes.
        teacher: What labels.
        surfaces: Points of the objects' surfaces in their frames, in no order, unscaled [m] [O, P, 3]:
            first those of the goal, then those that are seen.
        cfg: Settings.
        camera: A depth camera in every environment; None: complete surfaces are told.

    Attributes:
        goals: Clouds of the environments' goals [m] [N, K, 3].
        blank: For how many more steps each camera shows nothing [N].
    """

    def __init__(
        self,
        env: ReorientVecEnv,
        teacher: TrainedPolicy,
        surfaces: Tensor,
        cfg: StudentTrainCfg,
        camera: DepthCamera | None = None,
    ):
        self.env = env
        self._teacher = teacher
        self._camera = camera
        self._cfg = cfg
        self.samples = cfg.learn.window * env.num_envs
        env.env.acts_in_frame = False  # who sees by a camera acts in the world
        place = surfaces.device
        scene = env.env.scene
        scale = torch.tensor(np.asarray(scene.world_scale), device=place).float()
        self._scale = scale[:, None, None]
        self._object = torch.tensor(np.asarray(scene.world_object), device=place)
        points = cfg.clouds.points
        goals = goal_points(surfaces[self._object], points, cfg.clouds.scan_share)
        self.goals = self._scale * goals
        self.shapes = surfaces[:, points:]
        """Points of each object that a look is drawn of, unscaled [m] [O, P, 3]."""
        self._all = wp.ones(env.num_envs, dtype=wp.int32, device=env.env.device)
        self._base = torch.tensor(env.env.hand.mount, dtype=torch.float32, device=place)
        self._pose = wp.to_torch(env.env.sim.body_q)[:, scene.object_body]
        self.blank = torch.zeros(env.num_envs, dtype=torch.int32, device=place)
        self._errors = BeliefErrors(env.num_envs, cfg.simulated, place)
        self._looks: Looks
        self._done: Sequences
        self._means = StepMeans()
        length = math.ceil(2 * env.max_episode_length / cfg.learn.window)
        self._window = GoalWindow(length)

    @torch.no_grad()
    def collect(self, acting: ActingStudent, stopping: Callable[[], bool]) -> bool:
        """Act for T steps; false if it was cut short."""
        window = self._cfg.learn.window
        looks = []
        steps = []
        hidden = acting.hidden
        for _ in range(window):
            if stopping():
                self._means.clear()
                return False
            pose = poses_in(self._base, self._pose)
            place = acting.build.belief_of(pose)
            senses = self.senses()
            sight, told, belief = self._sighted(acting, senses, place)
            truth = acting.build.frames.belief_in(place, sight.frame)
            if self._camera is None:
                looks.append(self._complete(acting, senses, pose, place))
            else:
                followed, lost = self._learned().tensor_split(2)
                some = itemgetter(followed)
                looks.append(Looks(each(sight, some), each(truth, some)))
                others = itemgetter(lost)
                looks.append(sought(acting, each(senses, others), each(place, others), lost))
            decision = acting.decide(told, sight.frame)
            label = self.labels()
            named = acting.build.frames.joints_in(label, sight.frame)
            steps.append((told, named, senses.fresh))
            turn, shift = belief_errors(belief, truth)
            wrong = (decision.action - label).abs()
            _, _, _, extras = self.env.step(decision.action)
            self._choose_frames()
            self._means.add(
                {
                    "student/rotation_error": turn.mean(),
                    "student/position_error_mm": 1e3 * shift.mean(),
                    "student/action_error": wrong.mean(),
                    **extras["log"],
                }
            )
        self.env.env.check()
        sights = joined([look.sight for look in looks])
        self._looks = Looks(sights, joined([look.truth for look in looks]))
        told, labels, fresh = map(torch.stack, zip(*steps, strict=True))
        self._done = Sequences(
            told=told,
            hidden=hidden.masked_fill(fresh[0, :, None], 0.0),
            done=torch.cat([fresh[1:], torch.zeros_like(fresh[:1])]),
            label=labels,
        )
        return True

    def _sighted(
        self, acting: ActingStudent, senses: Senses, place: Belief
    ) -> tuple[StudentInput, Tensor, Belief]:
        """What there is to read, what is told, and where the objects are believed to be, in frames.

        Without a camera that is drawn about their true places (base frame); with one it is seen.
        """
        if self._camera is None:
            acting.forget(senses.fresh)
            belief = self._errors.about(place, senses.fresh)
            sight = acting.build(senses, belief, clouds=False)
            return sight, acting.network.told(sight, sight.belief), sight.belief
        sight, look = acting.look(senses, off(place))
        return sight, acting.network.told(sight, look.belief), look.belief

    def _learned(self) -> Tensor:
        """Environments whose looks of a step are learned from, drawn at random, int64 [R]."""
        order = torch.randperm(self.env.num_envs, device=self.blank.device)
        return order[: math.ceil(self._cfg.simulated.looks / self._cfg.learn.window)]

    def _complete(
        self, acting: ActingStudent, senses: Senses, pose: Tensor, place: Belief
    ) -> Looks:
        """Looks of some environments at complete surfaces.

        Args:
            acting: The student.
            senses: What is sensed of all.
            pose: Poses of all objects in the base frame [N, 7].
            place: What is to be believed of them, base frame [N].
        """
        rows = self._learned()
        some = itemgetter(rows)
        truth = each(place, some)
        sensed_there = replace(each(senses, some), points=self._surfaces(pose[rows], rows))
        sight = acting.build(sensed_there, off(truth), rows)
        return Looks(sight, acting.build.frames.belief_in(truth, sight.frame))

    def looks(self, acting: ActingStudent) -> Iterator[Looks]:
        """Looks of all steps, in an order at random."""
        count = len(self._looks.truth.position)
        order = torch.randperm(count, device=self.blank.device)
        for rows in order.split(self._cfg.learn.batch):
            taken = itemgetter(rows)
            yield Looks(each(self._looks.sight, taken), each(self._looks.truth, taken))

    def sequences(self) -> Iterator[Sequences]:
        """What was done, all of an environment at once."""
        done = self._done
        for _ in range(self._cfg.simulated.epochs):
            order = torch.randperm(self.env.num_envs, device=self.blank.device)
            for rows in order.split(self._cfg.learn.sequences):
                yield Sequences(
                    told=done.told[:, rows],
                    hidden=done.hidden[rows],
                    done=done.done[:, rows],
                    label=done.label[:, rows],
                )

    def senses(self) -> Senses:
        """What is sensed now; without a camera no points."""
        env = self.env.env
        if self._camera is None:
            return sensed_with(env, self._pose.new_empty((env.num_envs, 0, 3)))
        senses = sensed(env, self._camera)
        settings = self._cfg.simulated
        draw = torch.rand(self.blank.shape, device=self.blank.device)
        spans = torch.randint_like(self.blank, 1, settings.blank_steps + 1)
        begins = (self.blank == 0) & (draw < settings.blank_probability)
        self.blank = torch.where(begins, spans, (self.blank - 1).clamp(min=0))
        points = senses.points.masked_fill((self.blank > 0)[:, None, None], torch.nan)
        return sensed_with(env, points)

    def labels(self) -> Tensor:
        """What the teacher does now, clipped as the environment clips actions [N, D]."""
        env = self.env.env
        action = self._teacher.act(wp.to_torch(env.observation))
        if env.symmetry_frames is not None:
            in_frames = wp.from_torch(action.contiguous())
            action = wp.to_torch(env.symmetry_frames.world_action(in_frames))
        return action.clamp(-1.0, 1.0)

    def _choose_frames(self) -> None:
        """Let the teacher choose its symmetry frames anew, as the student does in every step."""
        frames = self.env.env.symmetry_frames
        if frames is not None:
            frames.choose(self._all, self._all)
            frames.observe()

    def figures(self) -> dict[str, Any]:
        """How goals ended, and errors while acting."""
        processes = 1
        if torch.distributed.is_initialized():
            processes = torch.distributed.get_world_size()
        means = self._means.read(processes)
        return {**self._window.add(means), **means, **self.env.end_iteration()}

    def measure(self, acting: ActingStudent) -> dict[str, Tensor]:
        """Nothing: policies are judged by vd-eval."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """The camera, its blank spans, and how goals ended."""
        camera = {} if self._camera is None else self._camera.stateful()
        return {
            "blank": self.blank,
            "errors": self._errors.state,
            "window": self._window.state_dict(),
            "camera": {name: array.numpy() for name, array in camera.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.blank.copy_(state["blank"])
        self._errors.state.copy_(state["errors"])
        self._window.load_state_dict(state["window"])
        if self._camera is not None:
            for name, array in self._camera.stateful().items():
                array.assign(state["camera"][name])

    def close(self) -> None:
        """Release the environments."""
        self.env.env.close()

    def _surfaces(self, pose: Tensor, rows: Tensor) -> Tensor:
        """Points all over the objects of environments ``rows`` at poses [R, 7], with noise [R, K, 3]."""
        clouds = self._cfg.clouds
        order = torch.randperm(self.shapes.shape[1], device=pose.device)[: clouds.points]
        shapes = self._scale[rows] * self.shapes[self._object[rows]][:, order]
        points = carried(shapes, quaternion_matrices(pose[:, 3:]), pose[:, None, :3])
        return points + clouds.noise_m * torch.randn_like(points)
