"""How the object is turned from the goal, by pooling that turns with a cloud.

A vector is a weighted sum of a cloud's points about their centre. Its weights depend on what stays as it is
when the cloud is turned, so vectors turn with the cloud, whatever the weights are (cf. tensor field networks,
Thomas 2018; vector neurons, Deng 2021). Products of the vectors of two clouds of one shape then hold the
rotation from one to the other, for shapes seen in training and for others.

Global pooling of a convolution has to learn this from nothing: a rotation from the goal is a product of two
unknown ones, of which neither cloud alone says anything, so there is no gradient to begin with
(docs/results/student.md). G clouds, P points, K vectors.
"""

import torch
from torch import nn

from vd.student.cfg import TurnCfg
from vd.student.sites import Sites

RADIUS_M = 0.05
"""Points are given in units of this, about the radius of an object."""
SMALL = 1e-2
"""Vectors are scaled to length 1, those that are not much longer than this less: noise stays small."""
GOAL, HAND = 0, 1
"""Columns of the marks of voxels."""


def marks(sites: Sites) -> torch.Tensor:
    """Marks of voxels [M, 2]: whether they hold points of the goal, and of the hand's own model."""
    if sites.marks is None:
        raise ValueError("the network reads marks of voxels; give the voxeliser the ends of the groups")
    return sites.marks


def item_and_goal(sites: Sites, goal: Sites | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Which voxels are the object's, and which the goal's (of ``goal``, where that is given), bool [M].

    A voxel is the object's that holds no point of the goal, nor of the hand's own model. Of a camera's points
    those of the hand that lie between that model's samples are left out too, with all that touches it.
    """
    wanted = marks(sites if goal is None else goal)[:, GOAL] > 0
    free = (marks(sites) == 0).all(dim=1)
    if sites.complete:
        return free, wanted
    return free & ~sites.touching(free, marks(sites)[:, HAND] > 0), wanted


def padded(sites: Sites, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Coordinates of some voxels, a row for each cloud.

    Args:
        sites: Voxels of B clouds.
        chosen: Which, bool [M].

    Returns:
        Coordinates of their centres [voxels], zeros where a cloud has fewer, shape [B, P, 3], and 1 where
        there is one, shape [B, P, 1].
    """
    rows = sites.coordinates[chosen]
    cloud = rows[:, 0].long()
    counts = torch.bincount(cloud, minlength=sites.clouds)
    place = torch.arange(len(cloud), device=cloud.device) - (counts.cumsum(0) - counts)[cloud]
    points = torch.zeros((sites.clouds, max(1, int(counts.max())), 3), device=cloud.device)
    present = torch.zeros_like(points[..., :1])
    points[cloud, place] = rows[:, 1:] + 0.5
    present[cloud, place] = 1.0
    return points, present


def unit(values: torch.Tensor) -> torch.Tensor:
    """Values [.., C] scaled to length 1 at most."""
    return values * torch.rsqrt(values.square().sum(dim=-1, keepdim=True) + SMALL * SMALL)


class ShapeVectors(nn.Module):
    """K vectors, and K symmetric tensors without trace, that turn with a cloud.

    Each round weighs points by their distance from the centre and by how they lie to the vectors and tensors
    of the round before. Tensors see what looks the same from both sides, where vectors vanish.
    """

    def __init__(self, cfg: TurnCfg):
        super().__init__()
        widths = [2] + [2 + 3 * cfg.vectors] * (cfg.rounds - 1)
        self.weigh = nn.ModuleList(
            nn.Sequential(
                nn.Linear(width, cfg.hidden),
                nn.GELU(),
                nn.Linear(cfg.hidden, cfg.hidden),
                nn.GELU(),
                nn.Linear(cfg.hidden, cfg.vectors),
            )
            for width in widths
        )

    def forward(self, points: torch.Tensor, present: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Vectors [G, K, 3] and tensors [G, K, 3, 3] of points [G, P, 3], present or not [G, P, 1]."""
        share = present / present.sum(dim=1, keepdim=True).clamp(min=1.0)
        centred = (points - (points * share).sum(dim=1, keepdim=True)) * present
        square = centred.square().sum(dim=-1, keepdim=True)
        identity = torch.eye(3, device=points.device, dtype=points.dtype).flatten()
        spread = (centred[..., :, None] * centred[..., None, :]).flatten(-2) - square / 3.0 * identity
        both = torch.cat([centred, spread], dim=-1)
        far = torch.cat([square.sqrt(), square], dim=-1)
        seen, vectors, tensors = far, points, points
        for weigh in self.weigh:
            pooled = (weigh(seen) * share).transpose(1, 2) @ both
            vectors, tensors = unit(pooled[..., :3]), unit(pooled[..., 3:])
            along = centred @ vectors.transpose(1, 2)
            seen = torch.cat([far, along, along.square(), spread @ tensors.transpose(1, 2)], dim=-1)
        return vectors, tensors.unflatten(-1, (3, 3))


class TurnEncoder(nn.Module):
    """An embedding of how the object of each cloud is turned from the goal.

    Pairs of vectors make frames, of the object and of the goal by the same weights; two frames of one shape
    differ by the rotation that is looked for. The embedding is made of these rotations, one for each pair, of
    their weighted mean, and of the lengths of the vectors: where a shape looks the same from several sides
    they are short, and the rotations disagree. Then products of tensors still tell how its axes lie.
    """

    def __init__(self, cfg: TurnCfg, voxel_m: float, embedding: int):
        super().__init__()
        self.scale = voxel_m / RADIUS_M
        self.shape = ShapeVectors(cfg)
        self.pairs = nn.Linear(cfg.vectors, 2 * cfg.pairs, bias=False)
        self.tensors = nn.Linear(cfg.vectors, cfg.pairs, bias=False)
        lengths = 4 * cfg.pairs
        self.trust = nn.Sequential(
            nn.Linear(lengths, cfg.hidden), nn.GELU(), nn.Linear(cfg.hidden, cfg.pairs)
        )
        width = 9 * (2 * cfg.pairs + 1) + lengths
        self.hidden = nn.Sequential(nn.Linear(width, embedding), nn.GELU())
        self.out = nn.Linear(width + embedding, embedding)

    def forward(self, sites: Sites, goal: Sites | None = None) -> torch.Tensor:
        """Embeddings [B, E] of the clouds of ``sites``, the goal's voxels among them or in ``goal``."""
        item, wanted = item_and_goal(sites, goal)
        with torch.autocast(sites.device.type, enabled=False):
            now, length, spread = self._frames(sites, item)
            aim, aim_length, aim_spread = self._frames(sites if goal is None else goal, wanted)
            turns = now @ aim.transpose(-1, -2)
            lengths = torch.cat([length, aim_length], dim=1).clamp(min=SMALL).log()
            trust = self.trust(lengths).softmax(dim=1)
            mean = (trust[..., None, None] * turns).sum(dim=1)
            both = (spread @ aim_spread).flatten(1)
            known = torch.cat([turns.flatten(1), mean.flatten(1), lengths, both], dim=1)
            return self.out(torch.cat([known, self.hidden(known)], dim=1))

    def _frames(self, sites: Sites, chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Frames as matrices [B, pairs, 3, 3], lengths of their vectors [B, 2 pairs], tensors like frames."""
        points, present = padded(sites, chosen)
        dtype = self.out.weight.dtype
        vectors, tensors = self.shape(self.scale * points.to(dtype), present.to(dtype))
        first, second = self.pairs(vectors.transpose(1, 2)).transpose(1, 2).chunk(2, dim=1)
        one = unit(first)
        second = second - (second * one).sum(dim=-1, keepdim=True) * one
        two = unit(second)
        matrix = torch.stack((one, two, torch.linalg.cross(one, two)), dim=-1)
        lengths = torch.cat([first.norm(dim=-1), second.norm(dim=-1)], dim=1)
        return matrix, lengths, self.tensors(tensors.movedim(1, -1)).movedim(-1, 1)
