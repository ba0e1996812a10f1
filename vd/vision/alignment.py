"""How a goal's cloud has to be turned to lie on what a camera sees of an object, learned.

A transformer reads patches of both clouds together, and predicts by how much the goal is still to
be turned. From far off that is ambiguous, from near it is not: so many starts are improved by
several passes, and laid onto what is seen (:mod:`.icp`). What fits best is believed, and followed.

B clouds, P points of a cloud, T tokens, E the width; N objects, H hypotheses. Clouds are in metres,
in axes that goal and object share (the world's); a rotation turns the goal onto the object: seen ~
R goal + offset.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from vd.vision.cfg import AlignmentCfg
from vd.vision.icp import CLOUD_M, normals, refine
from vd.vision.rotations import cube_rotations, first_columns, matrices

PATCH_M = 0.03
"""Unit of places within a patch [m]: about its size."""
WAVES = (1.5, 3.0, 6.0, 12.0)
"""Frequencies at which a token knows its place [rad per CLOUD_M]: half a wave is from 17 to 2
cm.
"""
AT_ONCE = 4096
"""Pairs of clouds compared at a time: what the tokens of more take counts in gigabytes."""
PASSES = 2
"""Passes by which each start of a first look is improved. Of 208 made looks at validation meshes,
goals half whole and half scans, 57 % are then within 0.4 rad, with one pass 51, with four 54."""
STEPS = 4
"""Steps of Gauss and Newton by which an improved hypothesis is laid onto what is seen. With none
5.4 points fewer (2.6 to 8.8) of 1664 validation episodes stop at the goal, with 2 2.0 (0.7 to 3.3);
8 are no better."""
GOAL = 0
"""Kind of a goal's cloud."""
SEEN = 1
"""Kind of the cloud of what is seen."""


@dataclass(frozen=True)
class Residual:
    """What is predicted of pairs of clouds."""

    rotation: Tensor
    """By how much the goal is still to be turned, matrices [B, 3, 3]."""
    offset: Tensor
    """Where the goal's mean lies on the object, from the mean of what is seen [m] [B, 3]."""


class Patches(nn.Module):
    """Tokens of a cloud: the neighbourhoods of its first T points, and where they are."""

    def __init__(self, cfg: AlignmentCfg):
        super().__init__()
        self.cfg = cfg
        inner = 2 * cfg.patch
        self.points = nn.Sequential(
            nn.Linear(3, cfg.patch),
            nn.ReLU(),
            nn.Linear(cfg.patch, inner),
        )
        self.patch = nn.Linear(inner, cfg.width)
        known = 3 * (1 + 2 * len(WAVES))
        self.place = nn.Linear(known, cfg.width)

    def forward(self, cloud: Tensor, near: Tensor) -> Tensor:
        """Tokens [B, T, E] of clouds about their means [m] [B, P, 3], in no order, and their neighbours."""
        centres = cloud[:, : self.cfg.tokens]
        rows = torch.arange(cloud.shape[0], device=cloud.device)[:, None, None]
        offsets = cloud[rows, near] - centres[:, :, None]
        read = self.points(offsets / PATCH_M).amax(dim=2)
        place = centres / CLOUD_M
        known = [place]
        for scale in WAVES:
            known.append(torch.sin(place * scale))
            known.append(torch.cos(place * scale))
        places = self.place(torch.cat(known, dim=-1))
        return self.patch(read) + places


def perceptron(width: int, outputs: int) -> nn.Sequential:
    """A hidden layer twice as wide as what comes in, and the layer that reads it."""
    return nn.Sequential(
        nn.Linear(width, 2 * width),
        nn.GELU(),
        nn.Linear(2 * width, outputs),
    )


class Layer(nn.Module):
    """Attention and two products, each added to what comes in."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norms = nn.ModuleList([nn.LayerNorm(width), nn.LayerNorm(width)])
        self.mix = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.inner = perceptron(width, width)

    def forward(self, tokens: Tensor, first: int | None = None) -> Tensor:
        """Tokens [B, T, E] that have read each other; the ``first`` ones alone, or all."""
        mixed = self.mix(self.norms[0](tokens))
        mixed = mixed.unflatten(-1, (3, self.heads, -1))
        query, key, value = mixed.permute(2, 0, 3, 1, 4)
        read = functional.scaled_dot_product_attention(query[:, :, :first], key, value)
        read = read.transpose(1, 2).flatten(2)
        tokens = tokens[:, :first] + self.out(read)
        return tokens + self.inner(self.norms[1](tokens))


class AlignmentNetwork(nn.Module):
    """Compares a goal's cloud with a seen one.

    Args:
        cfg: Its sizes.
    """

    def __init__(self, cfg: AlignmentCfg):
        super().__init__()
        self.cfg = cfg
        self.patches = Patches(cfg)
        self.kinds = nn.Parameter(0.02 * torch.randn(2, cfg.width))
        self.summary = nn.Parameter(0.02 * torch.randn(1, 1, cfg.width))
        self.layers = nn.ModuleList(Layer(cfg.width, cfg.heads) for _ in range(cfg.layers))
        self.norm = nn.LayerNorm(cfg.width)
        self.heads = nn.ModuleDict()
        self.heads["rotation"] = perceptron(cfg.width, 6)
        self.heads["offset"] = perceptron(cfg.width, 3)

    @torch.no_grad()
    def neighbours(self, cloud: Tensor) -> Tensor:
        """Points of each patch of clouds [B, P, 3], indices [B, T, K].

        They stay when a cloud is turned.
        """
        apart = torch.cdist(cloud[:, : self.cfg.tokens], cloud)
        return apart.topk(self.cfg.neighbours, largest=False, sorted=False).indices

    def encode(self, cloud: Tensor, kind: int, near: Tensor) -> Tensor:
        """Tokens [B, T, E] of clouds about their means [m] [B, P, 3], of goals or of what is seen."""
        return self.patches(cloud, near) + self.kinds[kind]

    def compare(self, goal: Tensor, seen: Tensor) -> Residual:
        """What is predicted from the tokens of goals and of what is seen, [B, T, E] each."""
        summary = self.summary.expand(goal.shape[0], -1, -1)
        tokens = torch.cat([summary, goal, seen], dim=1)
        *before, last = self.layers
        for layer in before:
            tokens = layer(tokens)
        summary = self.norm(last(tokens, first=1)[:, 0])
        columns = self.heads["rotation"](summary).float()
        offset = self.heads["offset"](summary).float()
        return Residual(matrices(columns), CLOUD_M * offset)

    def forward(
        self,
        goal: Tensor,
        seen: Tensor,
        near: Sequence[Tensor] | None = None,
    ) -> Residual:
        """What is predicted of clouds about their means [m] [B, P, 3].

        Their :meth:`neighbours` if known.
        """
        of_goal, of_seen = near or [self.neighbours(goal), self.neighbours(seen)]
        goal_tokens = self.encode(goal, GOAL, of_goal)
        seen_tokens = self.encode(seen, SEEN, of_seen)
        return self.compare(goal_tokens, seen_tokens)


@dataclass(frozen=True)
class Alignment:
    """Where the goal's cloud lies on the object."""

    rotation: Tensor
    """From the goal to the object, matrices [N, 3, 3]."""
    position: Tensor
    """Where the goal's mean lies on the object, in the frame of what is seen [m] [N, 3]."""


class Aligner:
    """Finds the rotation from goals to objects, and follows it from look to look.

    A first look begins from the 24 rotations of a cube: none is farther than 1.1 rad from one of
    them. They are improved and laid onto what is seen; the one that fits best is believed. Every
    look, the first too, improves it once more.

    Args:
        network: The trained network.
        goal: Goals' clouds [m] [N, P, 3].
    """

    def __init__(self, network: AlignmentNetwork, goal: Tensor):
        self.network = network
        self._starts = cube_rotations(goal.device)
        self._goal = goal - goal.mean(dim=1, keepdim=True)
        self._near = network.neighbours(self._goal)
        self._normals = normals(self._goal)
        unturned = torch.eye(3, device=goal.device)
        self._rotation = unturned.repeat(len(goal), 1, 1)
        self._known = torch.zeros(len(goal), dtype=torch.bool, device=goal.device)

    def reset(self, rows: Tensor) -> None:
        """Forget what is known of objects, a mask or indices."""
        self._known[rows] = False

    @torch.inference_mode()
    def look(self, seen: Tensor, rows: Tensor | None = None) -> Alignment:
        """Compare once.

        Args:
            seen: What is seen of the objects [m] [R, P', 3], points in no order.
            rows: Which objects, each once [R]; all by default.

        Returns:
            Tensors of inference mode: clone them before changing them or learning from them.
        """
        if rows is None:
            rows = torch.arange(len(self._goal), device=seen.device)
        mean = seen.mean(dim=1)
        seen = seen - mean[:, None]
        tokens = self.network.encode(seen, SEEN, self.network.neighbours(seen))
        new = ~self._known[rows]
        if bool(new.any()):
            unknown = rows[new]
            self._rotation[unknown] = self._first(unknown, tokens[new], seen[new])
            self._known[unknown] = True
        look = torch.arange(len(rows), device=rows.device)
        rotation, offset = self._improved(rows, look, tokens, self._rotation[rows])
        rotation, offset, _ = self._laid(rows, look, seen, rotation, offset)
        self._rotation[rows] = rotation
        return Alignment(rotation, mean + offset)

    def _first(self, rows: Tensor, tokens: Tensor, seen: Tensor) -> Tensor:
        """The best that starts come to, rotations [R, 3, 3]."""
        looks = torch.arange(len(rows), device=rows.device)
        starts = len(self._starts)
        look = looks.repeat_interleave(starts)
        rotation = self._starts.repeat(len(rows), 1, 1)
        for _ in range(PASSES):
            rotation, offset = self._improved(rows, look, tokens, rotation)
        rotation, _, misfit = self._laid(rows, look, seen, rotation, offset)
        best = misfit.unflatten(0, (-1, starts)).argmin(dim=1)
        return rotation[starts * looks + best]

    def _improved(
        self,
        rows: Tensor,
        look: Tensor,
        tokens: Tensor,
        rotation: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """One pass over hypotheses.

        Args:
            rows: Object of each look [R].
            look: Look of each hypothesis [H].
            tokens: Of what is seen in each look [R, T, E].
            rotation: The hypotheses [H, 3, 3].

        Returns:
            Better ones [H, 3, 3], and their offsets [H, 3].
        """
        residuals = []
        offsets = []
        for some, turn in zip(look.split(AT_ONCE), rotation.split(AT_ONCE), strict=True):
            goal = rows[some]
            turned = self._goal[goal] @ turn.mT
            goal_tokens = self.network.encode(turned, GOAL, self._near[goal])
            residual = self.network.compare(goal_tokens, tokens[some])
            residuals.append(residual.rotation)
            offsets.append(residual.offset)
        better = torch.cat(residuals) @ rotation
        better = matrices(first_columns(better))  # still rotations after many
        return better, torch.cat(offsets)

    def _laid(
        self,
        rows: Tensor,
        look: Tensor,
        seen: Tensor,
        rotation: Tensor,
        offset: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Hypotheses laid onto what is seen [R, S, 3], and their misfits [m] [H]; else as above."""
        parts = []
        for some in torch.arange(len(look), device=look.device).split(AT_ONCE):
            pair = look[some]
            goal = rows[pair]
            laid = refine(
                self._goal[goal],
                self._normals[goal],
                seen[pair],
                rotation[some],
                offset[some],
                STEPS,
            )
            parts.append(laid)
        rotation, offset, misfit = map(torch.cat, zip(*parts, strict=True))
        return rotation, offset, misfit
