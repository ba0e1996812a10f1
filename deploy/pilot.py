"""Policies as the loop flies them: from what is sensed to an action and the distance to the goal."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
import torch

from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.config import from_dict
from vd.deploy.mirror import Mirror, TeacherSight
from vd.deploy.observation import Sensed, StudentSight
from vd.evaluate.agents import trained_task
from vd.evaluate.second_view import GoalClock, SecondView, StudentSecondView
from vd.evaluate.student import PRETRAINED, RENDERED
from vd.paper import PAPER
from vd.policy import TrainedPolicy
from vd.sensors.cfg import DepthCameraCfg
from vd.student.saved import SavedStudent
from vd.student.stopping import StoppingRule


@dataclass(frozen=True)
class Decision:
    """What a policy says of a moment."""

    action: np.ndarray
    """Mean action [D]."""
    distance: float
    """Distance to the goal by which it is stopped [rad]: a student's prediction, or the truth."""


class Pilot(Protocol):
    """A policy in the loop."""

    rule: StoppingRule
    """When it has arrived."""

    def begin(self) -> None:
        """A flight begins: nothing is known from before."""

    def new_goal(self) -> None:
        """A new goal: memory starts empty, as in training."""

    def decide(self, sensed: Sensed) -> Decision:
        """What to do now."""


class StudentPilot:
    """A student: sees clouds, remembers, and predicts its distance.

    Args:
        student: The student.
        hand: The hand.
        item: The object.
        tolerance_rad: How near to the goal it is to stop [rad].
        critic: What its teacher's critic expects (:func:`vd.evaluate.agents.open_critic`), to look twice at
            goals (:mod:`vd.evaluate.second_view`).
        seed: Of the choice of camera points.

    Attributes:
        camera: Where its camera has to be; None: it sees complete clouds, which only a twin has.

    Raises:
        ValueError: It is one of stage 0, which cannot act, or has no second view and is to take one.
    """

    def __init__(
        self,
        student: SavedStudent,
        hand: HandModel,
        item: ObjectModel,
        *,
        tolerance_rad: float = PAPER.success.rotation_rad,
        critic: Callable[[torch.Tensor], torch.Tensor] | None = None,
        seed: int = 0,
    ):
        spec = student.spec
        if spec.stage == PRETRAINED:
            raise ValueError("a student of stage 0 is an encoder, which cannot act; give one of stage 1 or 2")
        self.rule, self._network = spec.rule_for(tolerance_rad), student.network
        self.camera = student_camera(student, hand)
        depth = None
        if self.camera is not None:
            depth = from_dict(DepthCameraCfg, student.depth, where="depth camera of the student")
        self._make_sight = partial(StudentSight, hand, item, spec.network, depth=depth, seed=seed)
        self.sight = self._make_sight(camera=self.camera)
        self._hidden = self._network.initial_hidden(1)
        task = trained_task(student)
        self._clock = GoalClock(torch.zeros(1, dtype=torch.int32), task.sim.control_hz)
        self._second = None
        if critic is not None:
            self._network = deepcopy(self._network)  # its views are changed
            self._second = StudentSecondView(self._clock, self._network.state, task, critic)

    def look_by(self, camera: CameraModel) -> None:
        """See by a camera with this lens at this place, in place of the one of the training."""
        self.camera = camera
        self.sight = self._make_sight(camera=camera)

    def begin(self) -> None:
        """A flight begins: the object is looked for anew, which takes several times as long as a step."""
        self.new_goal()
        self.sight.begin()

    def new_goal(self) -> None:
        """A new goal: the memory starts empty, as in training; the object is followed on."""
        self._hidden = self._network.initial_hidden(1)
        self._clock.steps.zero_()

    def decide(self, sensed: Sensed) -> Decision:
        """Mean action and predicted distance."""
        with torch.inference_mode():
            points = self.sight.points(sensed)
            sites = self.sight.sites(points)
            senses = self._network.senses(self.sight.frame(sensed, points, sites))
            if self._second is not None:
                self._second.begin_step()
            output = self._network.act(sites[0], senses, self._hidden, *sites[1:])
        self._hidden = output.hidden
        self._clock.steps.add_(1)
        return Decision(output.mean[0].numpy().copy(), float(output.distance[0, -1]))


class TeacherPilot:
    """A teacher on a twin: it reads the twin's true state, which no real hand tells.

    Args:
        policy: The teacher.
        mirror: A world of its training.
        tolerance_rad: How near to the goal it is to stop [rad].
        second_view: Look twice at goals (:mod:`vd.evaluate.second_view`), in a mirror that has other views.

    Raises:
        ValueError: It is to look twice, and has no critic, or its mirror no other view.
    """

    def __init__(
        self,
        policy: TrainedPolicy,
        mirror: Mirror,
        tolerance_rad: float = PAPER.success.rotation_rad,
        *,
        second_view: bool = False,
    ):
        self.rule = StoppingRule(tolerance_rad)
        self._sight = TeacherSight(SecondView(mirror.env, policy) if second_view else policy, mirror)

    def begin(self) -> None:
        """A teacher remembers nothing; its goal is a new one."""
        self.new_goal()

    def new_goal(self) -> None:
        """The time of the goal is counted anew, for a teacher that sees it."""
        self._sight.mirror.begin()

    def decide(self, sensed: Sensed) -> Decision:
        """Mean action and true distance."""
        action = self._sight.act(sensed)
        return Decision(action, float(self._sight.mirror.env.rotation_error.numpy()[0]))


class StillPilot:
    """Does nothing; to try everything but a policy.

    Args:
        num_actions: D.
    """

    def __init__(self, num_actions: int):
        self.rule, self._action = StoppingRule(), np.zeros(num_actions)

    def begin(self) -> None:
        """Nothing to forget."""

    def new_goal(self) -> None:
        """Nothing to forget."""

    def decide(self, sensed: Sensed) -> Decision:
        """No action; the distance is not known."""
        return Decision(self._action, float("nan"))


def student_camera(student: SavedStudent, hand: HandModel) -> CameraModel | None:
    """The camera that a student was trained with: the hand's, or where its training put it."""
    spec = student.spec
    if spec.stage != RENDERED:
        return None
    if spec.camera is None:
        return hand.camera
    place = np.array(spec.camera)
    return replace(hand.camera, position=place[:3], quaternion=place[3:] / np.linalg.norm(place[3:]))
