"""Beliefs that rival each other after a first look, followed side by side for a while.

One look tells little: from some sides a mug and its mirror image look alike. What is seen in the next
steps does, so each step adds to how much each belief is doubted. A doubt is the mean logarithm of the
scale of the errors that the network expects of voxels; sums of it compare as log likelihoods do.

N hands, K beliefs of each.
"""

import torch
from torch import Tensor

from vd.vision.inputs import Belief
from vd.vision.rotations import turn_angle

RIVALS = 4
"""Beliefs that are followed of each hand (ours). Chosen on 57 episodes of YCB objects: with one 28 % of
goals were reached by true distance, with four 46, with eight 42, each for ten steps."""
WATCHED = 30
"""Control steps for which they are (ours); those count in which something is seen. On the same: ten
46 %, thirty 54, the whole episode 53; 49 since some are given up (LEAD)."""
LEAD = 2.0
"""A belief that was doubted by so much more than another, in all steps together, is given up (ours):
each look costs a robot 10 to 15 ms. Half and twice were not tried."""
APART_RAD = 0.5
"""Beliefs that are less far from each other than this are one (ours). Not tuned."""


class Rivals:
    """Beliefs of N hands, and how much each was doubted.

    Args:
        hands: N.
        device: Where they are.

    Attributes:
        belief: The beliefs [N, K].
        doubt: What each was doubted in all steps together [N, K].
        left: Steps for which those of each hand are still to be followed, int64 [N].
    """

    def __init__(self, hands: int, device: torch.device):
        rotation = torch.eye(3, device=device).repeat(hands, RIVALS, 1, 1)
        self.belief = Belief(rotation, torch.zeros((hands, RIVALS, 3), device=device))
        self.doubt = torch.zeros((hands, RIVALS), device=device)
        self.left = torch.zeros(hands, dtype=torch.int64, device=device)

    def begin(self, rows: Tensor, belief: Belief, doubt: Tensor) -> None:
        """Keep what is doubted least and is apart of what a search found.

        Args:
            rows: Hands, int64 [R].
            belief: S beliefs of each, one hand after the other [R S].
            doubt: How much each is doubted [R S].
        """
        row = torch.arange(len(rows), device=rows.device)
        rotation = belief.rotation.view(len(rows), -1, 3, 3)
        position = belief.position.view(len(rows), -1, 3)
        doubt = doubt.view(len(rows), -1)
        for rival in range(RIVALS):
            best = doubt.argmin(dim=1)
            chosen = rotation[row, best]
            self.belief.rotation[rows, rival] = chosen
            self.belief.position[rows, rival] = position[row, best]
            self.doubt[rows, rival] = doubt[row, best]
            near = turn_angle(rotation.mT @ chosen[:, None]) < APART_RAD
            doubt = doubt.masked_fill(near, torch.inf)
        self.left[rows] = WATCHED

    def likely(self, rows: Tensor, watched: Tensor) -> Tensor:
        """By which beliefs hands ``rows`` [R] are to look now, bool [R, K].

        By those that may still be right where they are ``watched`` [R]. Others are never looked at
        again, and where one is left it is followed no longer. Elsewhere by the best.
        """
        doubt = self.doubt[rows]
        behind = doubt > doubt.amin(dim=1, keepdim=True) + LEAD
        self.doubt[rows] = torch.where(watched[:, None] & behind, torch.inf, doubt)
        alone = (~behind).sum(dim=1) == 1
        left = self.left[rows]
        self.left[rows] = torch.where(watched, (left - 1).masked_fill(alone, 0), left)
        best = torch.nn.functional.one_hot(doubt.argmin(dim=1), RIVALS).bool()
        return torch.where(watched[:, None], ~behind, best)

    def of(self, hands: Tensor, rivals: Tensor) -> Belief:
        """Beliefs of hands [Q]."""
        return Belief(self.belief.rotation[hands, rivals], self.belief.position[hands, rivals])

    def take(self, hands: Tensor, rivals: Tensor, belief: Belief, doubt: Tensor) -> None:
        """Take what a step made of beliefs [Q], and how much it doubts them [Q]."""
        self.belief.rotation[hands, rivals] = belief.rotation
        self.belief.position[hands, rivals] = belief.position
        self.doubt[hands, rivals] += doubt

    def best(self, rows: Tensor) -> Tensor:
        """Which belief of each of hands ``rows`` [R] is doubted least, int64 [R]."""
        return self.doubt[rows].argmin(dim=1)
