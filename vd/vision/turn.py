"""How the object is turned from the goal, by pooling that turns with a cloud.

A vector is a weighted sum of a cloud's points about their centre. Its weights depend on what stays as it is
when the cloud is turned, so vectors turn with the cloud, whatever the weights are (cf. tensor field networks,
Thomas 2018; vector neurons, Deng 2021). Products of the vectors of two clouds of one shape then hold the
rotation from one to the other, for shapes seen in training and for others.

Global pooling of a convolution has to learn this from nothing: a rotation from the goal is a product of two
unknown ones, of which neither cloud alone says anything, so there is no gradient to begin with
(docs/lessons.md). G clouds, P points, K vectors.
"""

from dataclasses import dataclass

import torch
from torch import nn

from vd.vision.cfg import TurnCfg
from vd.vision.match import VALUES, Matches, PointMatch
from vd.vision.sites import Sites

RADIUS_M = 0.05
"""Points are given in units of this, about the radius of an object."""
FAR, WHOSE = 3, 2
"""Values that are known of a point at first: its distance from the centre, the square, and whether it is of a
goal, which no side of is hidden; the column of the last."""
SMALL = 1e-2
"""Vectors are scaled to length 1, those that are not much longer than this less: noise stays small."""


def unit(values: torch.Tensor) -> torch.Tensor:
    """Values [.., C] scaled to length 1 at most."""
    return values * torch.rsqrt(values.square().sum(dim=-1, keepdim=True) + SMALL * SMALL)


@dataclass(frozen=True)
class Shape:
    """A cloud as it is pooled: what turns with it, and what does not."""

    points: torch.Tensor
    """Points about their centre, zeros where there is none [G, P, 3]."""
    centre: torch.Tensor
    """Their centre [G, 1, 3]."""
    present: torch.Tensor
    """1 where there is a point [G, P, 1]."""
    vectors: torch.Tensor
    """Weighted sums of them, at most of length 1 [G, K, 3]."""
    tensors: torch.Tensor
    """Weighted sums of their products, symmetric and without trace [G, K, 3, 3]."""
    seen: torch.Tensor
    """How far each point is, and how it lies to vectors and tensors: what does not turn [G, P, F]."""


class ShapeVectors(nn.Module):
    """K vectors, and K symmetric tensors without trace, that turn with a cloud.

    Each round weighs points by their distance from the centre and by how they lie to the vectors and tensors
    of the round before. Tensors see what looks the same from both sides, where vectors vanish.
    """

    def __init__(self, cfg: TurnCfg):
        super().__init__()
        self.values = FAR + 3 * cfg.vectors
        widths = [FAR] + [self.values] * (cfg.rounds - 1)
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
        for layers in self.weigh:
            nn.init.zeros_(layers[0].weight[:, WHOSE])  # object and goal alike, until they are told apart

    def forward(self, points: torch.Tensor, present: torch.Tensor, *, whole: bool) -> Shape:
        """Pool points.

        Args:
            points: Points [G, P, 3].
            present: 1 where there is one, else 0 [G, P, 1].
            whole: Whether they are of a goal, which is never cut off.
        """
        share = present / present.sum(dim=1, keepdim=True).clamp(min=1.0)
        centre = (points * share).sum(dim=1, keepdim=True)
        centred = (points - centre) * present
        square = centred.square().sum(dim=-1, keepdim=True)
        identity = torch.eye(3, device=points.device, dtype=points.dtype).flatten()
        spread = (centred[..., :, None] * centred[..., None, :]).flatten(-2) - square / 3.0 * identity
        both = torch.cat([centred, spread], dim=-1)
        far = torch.cat([square.sqrt(), square, torch.full_like(square, float(whole))], dim=-1)
        seen, vectors, tensors = far, points, points
        for weigh in self.weigh:
            pooled = (weigh(seen) * share).transpose(1, 2) @ both
            vectors, tensors = unit(pooled[..., :3]), unit(pooled[..., 3:])
            along = centred @ vectors.transpose(1, 2)
            seen = torch.cat([far, along, along.square(), spread @ tensors.transpose(1, 2)], dim=-1)
        return Shape(centred, centre, present, vectors, tensors.unflatten(-1, (3, 3)), seen)


class TurnEncoder(nn.Module):
    """An embedding of how the object of each cloud is turned from the goal.

    Pairs of vectors make frames, of the object and of the goal by the same weights; two frames of one shape
    differ by the rotation that is looked for. The embedding is made of these rotations, one for each pair, of
    their weighted mean, and of the lengths of the vectors: where a shape looks the same from several sides
    they are short, and the rotations disagree. Then products of tensors still tell how its axes lie. What
    points that find each other say (:mod:`vd.vision.match`) goes beside these.
    """

    def __init__(self, cfg: TurnCfg, voxel_m: float, embedding: int):
        super().__init__()
        self.scale, self.points = voxel_m / RADIUS_M, cfg.points
        self.shape = ShapeVectors(cfg)
        self.pairs = nn.Linear(cfg.vectors, 2 * cfg.pairs, bias=False)
        self.tensors = nn.Linear(cfg.vectors, cfg.pairs, bias=False)
        lengths = 4 * cfg.pairs
        self.trust = nn.Sequential(
            nn.Linear(lengths, cfg.hidden), nn.GELU(), nn.Linear(cfg.hidden, cfg.pairs)
        )
        self.match = PointMatch(cfg, self.shape.values) if cfg.match else None
        width = 9 * (2 * cfg.pairs + 1) + lengths + (VALUES if cfg.match else 0)
        self.hidden = nn.Sequential(nn.Linear(width, embedding), nn.GELU())
        self.out = nn.Linear(width + embedding, embedding)

    def forward(self, sites: Sites, goal: Sites | None = None) -> tuple[torch.Tensor, Matches | None]:
        """Embeddings [B, E] of the clouds of ``sites``, the goal's voxels among them or in ``goal``.

        Returns:
            Embeddings, and the points that found each other.
        """
        whole = sites if goal is None else goal
        with torch.autocast(sites.device.type, enabled=False):
            one = self._shape(sites, sites.item, whole=False)
            other = self._shape(whole, whole.goal, whole=True)
            (now, length, spread), (aim, aim_length, aim_spread) = self._frames(one), self._frames(other)
            turns = now @ aim.transpose(-1, -2)
            lengths = torch.cat([length, aim_length], dim=1).clamp(min=SMALL).log()
            trust = self.trust(lengths).softmax(dim=1)
            mean = (trust[..., None, None] * turns).sum(dim=1)
            both = (spread @ aim_spread).flatten(1)
            parts, matches = [turns.flatten(1), mean.flatten(1), lengths, both], None
            if self.match is not None:
                pair = ((one.points, other.points), (one.seen, other.seen), (one.present, other.present))
                values, found = self.match(*pair)
                parts.append(values)
                seen, found = RADIUS_M * (one.points + one.centre), RADIUS_M * (found + other.centre)
                matches = Matches(seen, found, one.present)
            known = torch.cat(parts, dim=1)
            return self.out(torch.cat([known, self.hidden(known)], dim=1)), matches

    def _shape(self, sites: Sites, chosen: torch.Tensor, *, whole: bool) -> Shape:
        """The shape of some voxels of each cloud."""
        points, present = sites.places(chosen, self.points)
        dtype = self.out.weight.dtype
        return self.shape(self.scale * points.to(dtype), present.to(dtype), whole=whole)

    def _frames(self, shape: Shape) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Frames as matrices [B, pairs, 3, 3], lengths of their vectors [B, 2 pairs], tensors like frames."""
        first, second = self.pairs(shape.vectors.transpose(1, 2)).transpose(1, 2).chunk(2, dim=1)
        one = unit(first)
        second = second - (second * one).sum(dim=-1, keepdim=True) * one
        two = unit(second)
        matrix = torch.stack((one, two, torch.linalg.cross(one, two)), dim=-1)
        lengths = torch.cat([first.norm(dim=-1), second.norm(dim=-1)], dim=1)
        return matrix, lengths, self.tensors(shape.tensors.movedim(1, -1)).movedim(-1, 1)
