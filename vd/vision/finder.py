"""Where objects are, by the clouds of their goals alone: what is known of a shape is points of it.

N environments, M seen points at most. Base frame; metres, quaternions xyzw.
"""

import torch
from torch import Tensor

from vd.vision.alignment import Aligner, AlignmentNetwork
from vd.vision.cfg import SEEN_POINTS
from vd.vision.rotations import quaternions

LEAST = 16
"""Of fewer points nothing is told: those that it learned from had twice as many."""
CROWD = 4
"""So many others has a point of a surface beside it, also one in a line of voxels. Points with
fewer are a quarter of what a camera with errors sees; 3 % of them are left, and 7 % of the
surface's go with them.
"""
CROWD_M = 0.0102
"""How near they are [m]: two voxels."""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
"""Multiples of the golden ratio, but for whole numbers, are spread evenly whatever their count."""


class GoalFinder:
    """Finds and follows the object of each environment by a network of alignment.

    The cloud is aligned in its own axes, so that a new goal of the same shape leaves what is known
    as it is.

    Args:
        network: The network.
        goals: Clouds of the goals, in the objects' frames and of true size [m] [N, P, 3].

    Attributes:
        pose: Of the cloud's frame in the base frame [N, 7].
        looks: How often each environment's object was seen since it was begun anew, [N] int32.
        most: Points seen of the object that are looked at.
        share: Which they are, as shares of all that are seen, in order [most].
        seen: Those of the latest look of each environment [m] [N, most, 3].
        seen_now: Where there was one now, bool [N].
    """

    most = SEEN_POINTS

    def __init__(self, network: AlignmentNetwork, goals: Tensor):
        device = goals.device
        envs = len(goals)
        self._mean = goals.mean(dim=1)
        self._aligner = Aligner(network, goals)
        self.share = (GOLDEN * torch.arange(SEEN_POINTS, device=device)) % 1.0
        self.pose = torch.zeros((envs, 7), device=device)
        self.pose[..., 6] = 1.0
        self.looks = torch.zeros(envs, dtype=torch.int32, device=device)
        self.seen = torch.zeros((envs, SEEN_POINTS, 3), device=device)
        self.seen_now = torch.zeros(envs, dtype=torch.bool, device=device)

    def look(self, seen: Tensor, count: Tensor, *, fresh: Tensor) -> None:
        """Look once in every environment.

        Where too little is seen of the object all stays as it is.

        Args:
            seen: Points seen of the object [m], neighbours beside each other [N, M, 3].
            count: How many there are, [N] int32.
            fresh: Where nothing is known from before, bool [N].
        """
        self.looks.masked_fill_(fresh, 0)
        self._aligner.reset(fresh)
        crowded = _crowded(seen, count)
        count = crowded.sum(dim=1)
        self.seen_now = count >= LEAST
        rows = self.seen_now.nonzero().flatten()  # waits for the device
        if not len(rows):
            return
        wanted = (self.share * count[rows, None]).long() + 1
        chosen = torch.searchsorted(crowded[rows].cumsum(dim=1), wanted)
        points = seen[rows].take_along_dim(chosen[..., None], dim=1)
        self.seen[rows] = points
        alignment = self._aligner.look(points, rows)
        middle = alignment.rotation @ self._mean[rows, :, None]
        place = alignment.position - middle.squeeze(-1)
        orientation = quaternions(alignment.rotation)
        self.pose[rows] = torch.cat([place, orientation], dim=1)
        self.looks[rows] += 1


def _crowded(seen: Tensor, count: Tensor) -> Tensor:
    """Which of the first ``count`` points have others beside them: edges of depth fly about alone."""
    neighbours = (torch.cdist(seen, seen) < CROWD_M).sum(dim=-1)
    index = torch.arange(seen.shape[1], device=seen.device)
    return (neighbours > CROWD) & (index < count[:, None])
