"""Stage 0: single looks at shapes without end in hands that hold still, without simulation.

B looks, P points.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from vd.assets_usd.objects.model import ObjectModel
from vd.policy.senses import Senses
from vd.train.student.bank import ShapeBank, centred_points
from vd.train.student.config import StudentTrainCfg
from vd.train.student.sequences import Looks, Sequences, belief_errors
from vd.train.student.shapes import random_matrices, uniform
from vd.train.student.views import Hands, camera_points, goal_points, own_points, posed
from vd.vision.acting import PASSES, ActingStudent
from vd.vision.inputs import Belief, carried
from vd.vision.rotations import matrices_about

CLOUDS = 4
"""Points of a shape, in clouds: one is the goal's, of the others is seen what is to be seen."""
AWAY_M = 0.04
"""Beliefs are off by up to this along each axis [m]."""
AWAY_RAD = 1.2
"""Beliefs are off by up to this angle [rad]: as far as any rotation is from those of a cube, from
which a first look begins (1.1 rad)."""


def turned(rotation: Tensor, most: float) -> Tensor:
    """Rotations [B, 3, 3] turned about any axis by angles that are uniform up to ``most`` [rad]."""
    count = len(rotation)
    axis = torch.randn((count, 3), device=rotation.device)
    angle = most * torch.rand(count, device=rotation.device)
    return matrices_about(axis, angle) @ rotation


def off(truth: Belief) -> Belief:
    """Beliefs that are wrong by up to :data:`AWAY_RAD` and :data:`AWAY_M` [B]."""
    count = len(truth.rotation)
    shift = uniform(-AWAY_M, AWAY_M, count, 3, device=truth.position.device)
    return Belief(turned(truth.rotation, AWAY_RAD), truth.position + shift)


@torch.no_grad()
def sought(acting: ActingStudent, senses: Senses, truth: Belief, rows: Tensor) -> Looks:
    """Looks as of a search: at beliefs that begin at any rotation, and were made better some times.

    By them what is far off comes to be doubted.

    Args:
        acting: The student.
        senses: What was sensed [R].
        truth: Where the objects are, base frame [R].
        rows: Environment of each, int64 [R].
    """
    seen = senses.points.nanmean(dim=1)
    position = torch.where(seen.isfinite(), seen, off(truth).position)
    belief = Belief(random_matrices(len(rows), rows.device), position)
    for _ in range(int(torch.randint(PASSES, ()))):
        _, _, belief = acting.glance(senses, belief, rows)
    sight = acting.build(senses, belief, rows)
    return Looks(sight, acting.build.frames.belief_in(truth, sight.frame))


class MadeSequences:
    """Draws looks at shapes. Each iteration has new ones.

    So a run that goes on is exact.

    Args:
        objects: Objects to learn from, deformed.
        held_out: Objects to measure on, as they are; may be none.
        hands: What hides shapes.
        cfg: Settings.
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
        self.samples = cfg.clouds.updates * cfg.learn.batch
        points = CLOUDS * cfg.clouds.points
        device = hands.eye.device
        self._bank = ShapeBank(objects, cfg.clouds.shapes, points, hands.sides, device)
        self._held_out = None
        if held_out:
            self._held_out = centred_points(held_out, points, device)

    def collect(self, acting: ActingStudent, stopping: Callable[[], bool]) -> bool:
        """Make other shapes."""
        self._bank.renew(self._clouds.shapes)
        return True

    def looks(self, acting: ActingStudent) -> Iterator[Looks]:
        """Looks at them."""
        for _ in range(self._clouds.updates):
            shapes = self._bank.draw(self._learn.batch)
            yield self.draw(acting, shapes, self._clouds.seen_share)

    def sequences(self) -> Iterator[Sequences]:
        """None: nobody acts."""
        yield from ()

    @torch.no_grad()
    def draw(self, acting: ActingStudent, shapes: Tensor, seen_share: float) -> Looks:
        """A look at each of shapes, by a belief that is wrong.

        Args:
            acting: The student.
            shapes: Points [m] and normals [B, P, 6].
            seen_share: Share of looks by a camera; in others surfaces are whole.
        """
        count, size = shapes.shape[:2]
        device = shapes.device
        shapes = shapes[:, torch.randperm(size, device=device)].float()
        goal = goal_points(shapes[..., :3], self._clouds.points, self._clouds.scan_share)
        acting.build.set_goals(goal)
        rotation = random_matrices(count, device)
        position = uniform(*self._hands.box, count, 3, device=device)
        placed = posed(shapes, rotation, position)
        posture = self._hands.holding(placed[..., :3])
        middle = carried(goal.mean(dim=1, keepdim=True), rotation)[:, 0]
        truth = Belief(rotation, position + middle)
        joint_q = self._hands.joints[posture]
        surfaces = placed[:, self._clouds.points :]
        senses = Senses(
            joint_q=joint_q,
            joint_qd=torch.randn_like(joint_q),
            action=uniform(-1.0, 1.0, *joint_q.shape, device=device),
            goal_quat=acting.build.goal_quat(random_matrices(count, device)),
            points=self._seen(surfaces, posture, acting.build.hand_points(joint_q), seen_share),
            fresh=torch.zeros(count, dtype=torch.bool, device=device),
        )
        sight = acting.build(senses, off(truth))
        return Looks(sight, acting.build.frames.belief_in(truth, sight.frame))

    def figures(self) -> dict[str, Any]:
        """Nothing beside the losses."""
        return {}

    @torch.no_grad()
    def measure(self, acting: ActingStudent) -> dict[str, Tensor]:
        """Errors at objects that are not learned from, by a camera, after the passes of a first look."""
        if self._held_out is None:
            return {}
        views = 1 + self._learn.batch // len(self._held_out)
        looks = self.draw(acting, self._held_out.repeat(views, 1, 1), seen_share=1.0)
        sight = looks.sight
        for _ in range(PASSES):
            sight = replace(sight, belief=acting.network.look(sight).belief)
        turn, shift = belief_errors(sight.belief, looks.truth)
        return {
            "validation/rotation_error": turn.median(),
            "validation/position_error_mm": 1e3 * shift.median(),
        }

    def state_dict(self) -> dict[str, Any]:
        """Nothing: all is drawn anew."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""

    def _seen(self, surfaces: Tensor, posture: Tensor, hand: Tensor, seen_share: float) -> Tensor:
        """Points that a camera sees of surfaces [B, P, 6] and hands [B, H, 3], or whole surfaces.

        NaN for what is not seen [B, K + H, 3].
        """
        wanted = self._clouds.points
        seen = camera_points(self._hands, posture, surfaces, wanted, apart=False)
        own = own_points(self._hands, posture, surfaces[..., :3], hand)
        whole = surfaces[:, :wanted, :3]
        whole = whole + self._clouds.noise_m * torch.randn_like(whole)
        nothing = torch.full_like(own, torch.nan)
        by_camera = torch.rand((len(surfaces), 1, 1), device=surfaces.device)
        return torch.where(
            by_camera < seen_share,
            torch.cat([seen, own], dim=1),
            torch.cat([whole, nothing], dim=1),
        )
