"""Stage 0: shapes without end in hands that hold still, without simulation.

Beliefs begin wrong, by some centimetres and an angle that grows to any as the student learns. What
it makes of them is what it believes in the next step, as at work. T steps, B sequences, P points.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from operator import itemgetter
from typing import Any

import torch
from torch import Tensor

from vd.assets_usd.objects.model import ObjectModel
from vd.policy.senses import Senses
from vd.train.student.bank import ShapeBank, centred_points
from vd.train.student.config import StudentTrainCfg
from vd.train.student.sequences import Sequences, inputs_of, last_errors
from vd.train.student.shapes import random_matrices, uniform
from vd.train.student.views import Hands, camera_points, goal_points, posed
from vd.vision.acting import ActingStudent
from vd.vision.rotations import matrices_about
from vd.vision.student import Belief, carried, each

CLOUDS = 4
"""Points of a shape, in clouds: one is the goal's, of the others is seen what is to be seen."""
SHIFT_M = 0.04
"""First beliefs are off by up to this along each axis [m]."""
TURN_RAD, MOVE_M = 0.25, 0.003
"""Largest turn of an object in a step, as of teachers, and standard deviation of its motion."""
FIRST_TURN_RAD = 0.6
"""Beliefs are first off by up to this [rad]: among larger errors small ones are not learned. Of four
meshes pi taught no rotation in 900 steps, this did; half and twice were not tried."""
LEFT = 0.5
"""Share of the error that may be left after a sequence for the largest to grow. Not tuned."""
WIDER = 1.05
"""By what factor it grows. Not tuned."""


def turned(rotation: Tensor, most: float) -> Tensor:
    """Rotations [B, 3, 3] turned about any axis by angles that are uniform up to ``most`` [rad]."""
    count = len(rotation)
    axis = torch.randn((count, 3), device=rotation.device)
    angle = most * torch.rand(count, device=rotation.device)
    return matrices_about(axis, angle) @ rotation


class MadeSequences:
    """Draws sequences of shapes. Each iteration has new ones, so that a run that goes on is exact.

    Args:
        objects: Objects to learn from, deformed.
        held_out: Objects to measure on, as they are; may be none.
        hands: What hides shapes.
        cfg: Settings.

    Attributes:
        most_rad: Beliefs are off by up to this angle at first.
    """

    env = None

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        held_out: Sequence[ObjectModel],
        hands: Hands,
        cfg: StudentTrainCfg,
    ):
        self._hands = hands
        self._learn = cfg.learn
        self._clouds = cfg.clouds
        self.samples = cfg.clouds.updates * cfg.learn.batch * cfg.learn.window
        points = CLOUDS * cfg.clouds.points
        device = hands.eye.device
        self._bank = ShapeBank(objects, cfg.clouds.shapes, points, device)
        self.most_rad = FIRST_TURN_RAD
        self._held_out = None
        if held_out:
            self._held_out = centred_points(held_out, points, device)

    def minibatches(
        self, acting: ActingStudent, stopping: Callable[[], bool]
    ) -> Iterator[Sequences]:
        """Sequences of new shapes."""
        self._bank.renew(self._clouds.shapes)
        left = []
        for _ in range(self._clouds.updates):
            if stopping():
                return
            sequences = self.draw(acting, self._bank.draw(self._learn.batch), self.most_rad)
            left.append(last_errors(acting.belief, sequences)[0].mean())
            yield sequences
        if torch.stack(left).mean() < LEFT * 0.5 * self.most_rad:
            self.most_rad = min(math.pi, WIDER * self.most_rad)

    @torch.no_grad()
    def draw(self, acting: ActingStudent, shapes: Tensor, most_rad: float = math.pi) -> Sequences:
        """Sequences of shapes, points [m] and normals [B, P, 6], with the student's own beliefs.

        The first are off by up to ``most_rad``.
        """
        steps = self._learn.window
        count = len(shapes)
        device = shapes.device
        order = torch.randperm(shapes.shape[1], device=device)
        shapes = shapes[:, order].float()
        goal = goal_points(shapes[..., :3], self._clouds.points, self._clouds.scan_share)
        acting.build.set_goals(goal)
        place = self._motion(count)
        begin = posed(shapes, place.rotation[0], place.position[0])
        posture = self._hands.holding(begin[..., :3])
        points = self._seen(shapes[:, self._clouds.points :], place, posture)
        middle = carried(goal.mean(dim=1, keepdim=True), place.rotation)[..., 0, :]
        truth = Belief(place.rotation, place.position + middle)

        wanted = turned(truth.rotation[0], most_rad)
        # At work the object is first believed to be turned as it is wanted.
        as_wanted = torch.rand((count, 1, 1), device=device) < 0.5
        acting.belief = Belief(
            rotation=torch.where(as_wanted, wanted, turned(truth.rotation[0], most_rad)),
            position=truth.position[0] + uniform(-SHIFT_M, SHIFT_M, count, 3, device=device),
        )
        acting.hidden = acting.network.first_hidden(count)
        hidden = acting.hidden
        joint_q = self._hands.joints[posture].expand(steps, -1, -1)
        motors = steps, count, acting.network.num_actions
        senses = Senses(
            joint_q=joint_q,
            joint_qd=torch.randn_like(joint_q),
            action=uniform(-1.0, 1.0, *motors, device=device),
            goal_quat=acting.build.goal_quat(wanted).expand(steps, -1, -1),
            points=points,
            fresh=torch.zeros((steps, count), dtype=torch.bool, device=device),
        )
        rotations = []
        positions = []
        for step in range(steps):
            rotations.append(acting.belief.rotation)
            positions.append(acting.belief.position)
            now = each(senses, itemgetter(step))
            acting.decide(acting.look(now))
        belief = Belief(torch.stack(rotations), torch.stack(positions))
        rows = torch.arange(count, device=device)
        sight = inputs_of(acting.build, senses, belief, rows)
        return Sequences(sight, truth, hidden, done=senses.fresh)

    def figures(self) -> dict[str, Any]:
        """By how much beliefs are off at first."""
        return {"learn/most_rad": self.most_rad}

    @torch.no_grad()
    def measure(self, acting: ActingStudent) -> dict[str, Tensor]:
        """Errors after a sequence of objects that are not learned from."""
        if self._held_out is None:
            return {}
        views = 1 + self._learn.batch // len(self._held_out)
        sequences = self.draw(acting, self._held_out.repeat(views, 1, 1))
        turn, shift = last_errors(acting.belief, sequences)
        return {
            "validation/rotation_error": turn.median(),
            "validation/position_error_mm": 1e3 * shift.median(),
        }

    def state_dict(self) -> dict[str, Any]:
        """The largest error; all else is drawn anew."""
        return {"most_rad": self.most_rad}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over :meth:`state_dict`."""
        self.most_rad = state["most_rad"]

    def close(self) -> None:
        """Nothing."""

    def _motion(self, count: int) -> Belief:
        """Where shapes are in each step, base frame [T, B]."""
        device = self._hands.eye.device
        rotation = random_matrices(count, device)
        position = uniform(*self._hands.box, count, 3, device=device)
        rotations = []
        positions = []
        for _ in range(self._learn.window):
            rotations.append(rotation)
            positions.append(position)
            rotation = turned(rotation, TURN_RAD)
            position = position + MOVE_M * torch.randn_like(position)
        return Belief(torch.stack(rotations), torch.stack(positions))

    def _seen(self, shapes: Tensor, place: Belief, posture: Tensor) -> Tensor:
        """Points that a camera sees of shapes [B, P, 6] in each step, or whole surfaces [T, B, K, 3]."""
        steps, count = place.position.shape[:2]
        wanted = self._clouds.points
        device = shapes.device
        surfaces = posed(shapes, place.rotation, place.position).flatten(0, 1)
        seen = camera_points(self._hands, posture.repeat(steps), surfaces, wanted)
        whole = surfaces[:, :wanted, :3]
        whole = whole + self._clouds.noise_m * torch.randn_like(whole)
        by_camera = torch.rand((count, 1, 1), device=device) < self._clouds.seen_share
        points = torch.where(by_camera.repeat(steps, 1, 1), seen, whole)
        blank = torch.rand((steps * count, 1, 1), device=device) < self._clouds.blank_share
        return points.masked_fill(blank, torch.nan).unflatten(0, (steps, count))
