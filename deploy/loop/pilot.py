"""Policies as the loop flies them: from what is sensed to an action and the distance to the goal."""

from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch

from vd.assets_usd.hand_data import CameraModel, HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.config import from_dict
from vd.deploy.loop.mirror import Mirror, TeacherSight
from vd.deploy.loop.observation import Sensed, seen_points, senses_of
from vd.evaluate.agents import is_saved_student, is_tracking_policy
from vd.evaluate.student import PRETRAINED, RENDERED
from vd.paper import PAPER
from vd.policy import TrainedPolicy
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_cloud import CameraCloud
from vd.stopping import StoppingRule
from vd.tracking.policy import TrackingPolicy
from vd.tracking.tracker import Tracker
from vd.vision.saved import SavedStudent
from vd.vision.sight import Frame, Sight


@dataclass(frozen=True)
class Decision:
    """What a policy says of a moment."""

    action: np.ndarray
    """Mean action [D]."""
    distance: float
    """Distance to the goal by which it is stopped [rad]: a prediction, or the truth."""


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
        seed: Of the choice of camera points.

    Attributes:
        camera: Where its camera has to be; None: it sees complete clouds, which only a twin has.

    Raises:
        ValueError: It is one of stage 0, which cannot act.
    """

    def __init__(
        self,
        student: SavedStudent,
        hand: HandModel,
        item: ObjectModel,
        *,
        tolerance_rad: float = PAPER.success.rotation_rad,
        seed: int = 0,
    ):
        spec = student.spec
        if spec.stage == PRETRAINED:
            raise ValueError("a student of stage 0 is an encoder, which cannot act; give one of stage 1 or 2")
        self.rule, self._network = spec.rule_for(tolerance_rad), student.network
        depth = from_dict(DepthCameraCfg, student.depth, where="depth camera of the student")
        self._cloud = partial(CameraCloud, points=depth.points, crop_m=depth.crop_m, seed=seed)
        self._eye: CameraCloud | None = None
        self.camera = student_camera(student, hand)
        self.sight = Sight(hand, [item], spec.network, complete=self.camera is None)
        if self.camera is not None:
            self.look_by(self.camera)
        self._hidden = self._network.initial_hidden(1)

    def look_by(self, camera: CameraModel) -> None:
        """See by a camera with this lens at this place, in place of the one of the training."""
        self.camera, self._eye = camera, self._cloud(camera)

    def begin(self) -> None:
        """A flight begins: the memory starts empty."""
        self.new_goal()

    def new_goal(self) -> None:
        """A new goal: the memory starts empty, as in training."""
        self._hidden = self._network.initial_hidden(1)

    def frame(self, sensed: Sensed) -> Frame:
        """What it sees and senses.

        Raises:
            ValueError: There is no image, or for complete clouds no pose of the object.
        """
        points = torch.empty((1, 0, 3)) if self._eye is None else seen_points(self._eye, sensed.depth)
        pose = sensed.object_pose
        known = None if pose is None else torch.tensor(pose, dtype=torch.float32)[None]
        return self.sight.frame(senses_of(sensed, points), known)

    def decide(self, sensed: Sensed) -> Decision:
        """Mean action and predicted distance."""
        with torch.inference_mode():
            seen = self.frame(sensed)
            known = self._network.proprioception(seen)
            output = self._network.act(self.sight.sites(seen), known, self._hidden)
        self._hidden = output.hidden
        return Decision(output.mean[0].numpy().copy(), float(output.distance[0, -1]))


class TrackingPilot:
    """A tracking policy: finds the object in the camera's images, and lets its teacher act.

    Args:
        policy: The policy.
        hand: The hand.
        item: The object.
        tolerance_rad: How near to the goal it is to stop [rad].
        seed: Of the choice of camera points.

    Attributes:
        camera: Where its camera has to be.

    Raises:
        ValueError: It is for another hand, or has no views to select.
    """

    def __init__(
        self,
        policy: TrackingPolicy,
        hand: HandModel,
        item: ObjectModel,
        *,
        tolerance_rad: float = PAPER.success.rotation_rad,
        seed: int = 0,
    ):
        self.rule, depth = policy.spec.rule_for(tolerance_rad), policy.spec.depth
        self._cloud = partial(CameraCloud, points=depth.points, crop_m=depth.crop_m, seed=seed)
        self._tracker_of = partial(Tracker, policy, hand, [item])
        self._fresh = torch.ones(1, dtype=torch.bool)
        self.look_by(hand.camera.at(policy.spec.camera))

    def look_by(self, camera: CameraModel) -> None:
        """See by a camera with this lens at this place, in place of the one of the policy's file."""
        self.camera, self._eye, self._tracker = camera, self._cloud(camera), self._tracker_of(camera)

    def begin(self) -> None:
        """A flight begins: the object is looked for anew, which takes several times as long as a step."""
        self.new_goal()
        self._fresh.fill_(True)

    def new_goal(self) -> None:
        """A new goal; the object is followed on."""

    def decide(self, sensed: Sensed) -> Decision:
        """Mean action, and the angle that was found."""
        points = seen_points(self._eye, sensed.depth)
        senses = senses_of(sensed, points, fresh=self._fresh)
        decided = self._tracker.step(senses)
        self._fresh.fill_(False)
        return Decision(decided.action[0].numpy().copy(), float(decided.angle[0]))


class TeacherPilot:
    """A teacher on a twin: it reads the twin's true state, which no real hand tells.

    Args:
        policy: The teacher.
        mirror: A world of its training.
        tolerance_rad: How near to the goal it is to stop [rad].
    """

    def __init__(
        self,
        policy: TrainedPolicy,
        mirror: Mirror,
        tolerance_rad: float = PAPER.success.rotation_rad,
    ):
        self.rule = StoppingRule(tolerance_rad)
        self._sight = TeacherSight(policy, mirror)

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


def camera_and_depth(policy: Any, hand: HandModel) -> tuple[CameraModel, DepthCameraCfg]:
    """The camera of a policy and what it sees: the hand's and all, for one that has none."""
    if is_tracking_policy(policy):
        return hand.camera.at(policy.spec.camera), policy.spec.depth
    camera = student_camera(policy, hand) if is_saved_student(policy) else None
    if camera is None:
        return hand.camera, DepthCameraCfg()
    return camera, from_dict(DepthCameraCfg, policy.depth, where="depth camera of the student")


def student_camera(student: SavedStudent, hand: HandModel) -> CameraModel | None:
    """The camera that a student was trained with: the hand's, or where its training put it."""
    return hand.camera.at(student.spec.camera) if student.spec.stage == RENDERED else None
