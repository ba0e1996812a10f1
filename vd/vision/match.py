"""The rotation between two clouds of a shape from points that find each other, of which one may be cut off.

Sums over a cloud (:mod:`vd.vision.turn`) are those of another shape where a side is hidden; what a point is
like, and where it lies to the others, is kept by more of them. Each point of the object looks for its like
among the goal's (cf. deep closest point, Wang 2019); of two sets of matched points the product of their
spreads holds the rotation from one to the other (Kabsch 1976), whichever part the first set is of.
G clouds, P points of the object, Q of the goal, F values that stay as they are when a cloud is turned.
"""

from dataclasses import dataclass

import torch
from torch import nn

from vd.vision.cfg import TurnCfg

TINY = 1e-3
"""Added to the size of a spread that is divided by."""
ABSENT = -1e4
"""Likeness of a point that is not there."""
POLAR_STEPS = 8
"""Steps of Newton and Schulz from a matrix of norm 1 to the nearest rotation."""
VALUES = 3 * 9 + 2
"""Values of a match: rotation, spread scaled and not, its size and orientation."""


@dataclass(frozen=True)
class Matches:
    """Voxels of objects, and where each is thought to be on the goal; the hand's base frame [m]."""

    points: torch.Tensor
    """Centres of the object's voxels [G, P, 3]."""
    found: torch.Tensor
    """Where the same points are in the goal's cloud [G, P, 3]."""
    present: torch.Tensor
    """1 where there is a voxel [G, P, 1]."""


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """The rotation (or reflection) nearest to matrices [G, 3, 3] of norm 1 at most; of flat ones, about."""
    for _ in range(POLAR_STEPS):
        matrix = 1.5 * matrix - 0.5 * matrix @ matrix.transpose(1, 2) @ matrix
    return matrix


class PointMatch(nn.Module):
    """How an object is turned from its goal, from points that find each other.

    Args:
        cfg: Sizes.
        values: F.
    """

    def __init__(self, cfg: TurnCfg, values: int) -> None:
        super().__init__()
        self.features = cfg.match
        self.describe = nn.Sequential(
            nn.Linear(values, 2 * cfg.match),
            nn.GELU(),
            nn.Linear(2 * cfg.match, 2 * cfg.match),
            nn.GELU(),
            nn.Linear(2 * cfg.match, cfg.match + 1),
        )

    def forward(
        self,
        points: tuple[torch.Tensor, torch.Tensor],
        seen: tuple[torch.Tensor, torch.Tensor],
        present: tuple[torch.Tensor, torch.Tensor],
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What the matched points say.

        Args:
            points: Points of the object and of the goal about their centres, [G, P, 3] and [G, Q, 3].
            seen: What does not turn with them [G, P, F], [G, Q, F].
            present: 1 where there is a point [G, P, 1], [G, Q, 1].

        Returns:
            Values [G, VALUES], and where among the goal's points each of the object's is [G, P, 3].
        """
        mine, theirs = (self.describe(values) for values in seen)
        weight = (mine[..., -1:] + ABSENT * (1.0 - present[0])).softmax(dim=1) * present[0]
        likeness = mine[..., :-1] @ theirs[..., :-1].transpose(1, 2) * self.features**-0.5
        likeness = likeness + ABSENT * (1.0 - present[1]).transpose(1, 2)
        found = likeness.softmax(dim=2) @ points[1]
        spread = self._spread(points[0], found, weight)
        size = spread.flatten(1).norm(dim=1)[:, None, None]
        scaled = spread / (size + TINY)
        turned = (torch.linalg.cross(scaled[:, 0], scaled[:, 1]) * scaled[:, 2]).sum(dim=1, keepdim=True)
        parts = (orthogonal(scaled), scaled, spread, size.clamp(min=TINY).log())
        return torch.cat([*(part.flatten(1) for part in parts), turned], dim=1), found

    @staticmethod
    def _spread(points: torch.Tensor, found: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """Weighted products of points and of what they found, both about their centres [G, 3, 3]."""
        own = points - (weight * points).sum(dim=1, keepdim=True)
        other = found - (weight * found).sum(dim=1, keepdim=True)
        return (weight * own).transpose(1, 2) @ other
