"""How a goal's cloud has to be turned to lie on what a camera sees of an object, learned.

A transformer reads patches of both clouds together, and predicts by how much the goal is still to
be turned.
From far off that is ambiguous, from near it is not: so many starts are improved by several passes,
and laid onto what is seen (:mod:`.icp`). What fits best is believed, and followed.

B clouds, P points of a cloud, T tokens, E the width; N objects, H hypotheses. Clouds are in metres,
in axes that goal and object share (the world's); a rotation turns the goal onto the object: seen ~
R goal + offset.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
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
PAIRS_AT_ONCE = 4096
"""Pairs of clouds compared at a time: what the tokens of more take counts in gigabytes."""
PASSES = 2
"""Passes by which each start of a first look is improved. Of 208 made looks at validation meshes,
goals half whole and half scans, 57 % are then within 0.4 rad, with one pass 51, with four 54."""
STEPS = 4
"""Steps of Gauss and Newton by which an improved hypothesis is laid onto what is seen. With none
5.4 points fewer (2.6 to 8.8) of 1664 validation episodes stop at the goal, with 2 2.0 (0.7 to 3.3);
8 are no better."""
GOAL, SEEN = 0, 1
"""Kinds of clouds, in the order in which they are given."""


@dataclass(frozen=True)
class Residual:
    """What is predicted of pairs of clouds."""

    rotation: torch.Tensor
    """By how much the goal is still to be turned, matrices [B, 3, 3]."""
    offset: torch.Tensor
    """Where the goal's mean lies on the object, from the mean of what is seen [m] [B, 3]."""


class Patches(nn.Module):
    """Tokens of a cloud: the neighbourhoods of its first T points, and where they are."""

    def __init__(self, cfg: AlignmentCfg):
        super().__init__()
        self.cfg, inner = cfg, 2 * cfg.patch
        self.points = nn.Sequential(nn.Linear(3, cfg.patch), nn.ReLU(), nn.Linear(cfg.patch, inner))
        self.patch = nn.Linear(inner, cfg.width)
        self.place = nn.Linear(3 * (1 + 2 * len(WAVES)), cfg.width)

    @torch.no_grad()
    def neighbours(self, cloud: torch.Tensor) -> torch.Tensor:
        """Points of each patch of clouds [B, P, 3], indices [B, T, K].

        They stay when a cloud is turned.
        """
        apart = torch.cdist(cloud[:, : self.cfg.tokens], cloud)
        return apart.topk(self.cfg.neighbours, largest=False, sorted=False).indices

    def forward(self, cloud: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
        """Tokens [B, T, E] of clouds about their means [m] [B, P, 3], in no order, and their neighbours."""
        centres = cloud[:, : self.cfg.tokens]
        rows = torch.arange(cloud.shape[0], device=cloud.device)[:, None, None]
        read = self.points((cloud[rows, near] - centres[:, :, None]) / PATCH_M)
        place = centres / CLOUD_M
        waves = [wave(place * scale) for scale in WAVES for wave in (torch.sin, torch.cos)]
        return self.patch(read.amax(dim=2)) + self.place(torch.cat([place, *waves], dim=-1))


class Layer(nn.Module):
    """Attention and two products, each added to what comes in."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norms = nn.ModuleList([nn.LayerNorm(width), nn.LayerNorm(width)])
        self.mix, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.inner = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, tokens: torch.Tensor, first: int | None = None) -> torch.Tensor:
        """Tokens [B, T, E] that have read each other; the ``first`` ones alone, or all."""
        mixed = self.mix(self.norms[0](tokens)).unflatten(-1, (3, self.heads, -1))
        query, key, value = mixed.permute(2, 0, 3, 1, 4)
        read = functional.scaled_dot_product_attention(query[:, :, :first], key, value)
        tokens = tokens[:, :first] + self.out(read.transpose(1, 2).flatten(2))
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
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(
                    nn.Linear(cfg.width, 2 * cfg.width), nn.GELU(), nn.Linear(2 * cfg.width, n)
                )
                for name, n in {"rotation": 6, "offset": 3}.items()
            }
        )

    def neighbours(self, cloud: torch.Tensor) -> torch.Tensor:
        """Points of each patch of clouds [B, P, 3], indices [B, T, K]."""
        return self.patches.neighbours(cloud)

    def encode(self, cloud: torch.Tensor, kind: int, near: torch.Tensor) -> torch.Tensor:
        """Tokens [B, T, E] of clouds about their means [m] [B, P, 3], of goals or of what is seen."""
        return self.patches(cloud, near) + self.kinds[kind]

    def compare(self, goal: torch.Tensor, seen: torch.Tensor) -> Residual:
        """What is predicted from the tokens of goals and of what is seen, [B, T, E] each."""
        tokens = torch.cat([self.summary.expand(goal.shape[0], -1, -1), goal, seen], dim=1)
        *before, last = self.layers
        for layer in before:
            tokens = layer(tokens)
        summary = self.norm(last(tokens, first=1)[:, 0])
        found = {name: head(summary).float() for name, head in self.heads.items()}
        return Residual(matrices(found["rotation"]), CLOUD_M * found["offset"])

    def forward(
        self, goal: torch.Tensor, seen: torch.Tensor, near: Sequence[torch.Tensor] | None = None
    ) -> Residual:
        """What is predicted of clouds about their means [m] [B, P, 3].

        Their :meth:`neighbours` if known.
        """
        near = near or [self.neighbours(cloud) for cloud in (goal, seen)]
        return self.compare(self.encode(goal, GOAL, near[0]), self.encode(seen, SEEN, near[1]))


@dataclass(frozen=True)
class Alignment:
    """Where the goal's cloud lies on the object."""

    rotation: torch.Tensor
    """From the goal to the object, matrices [N, 3, 3]."""
    position: torch.Tensor
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

    def __init__(self, network: AlignmentNetwork, goal: torch.Tensor):
        self.network, self._starts = network, cube_rotations(goal.device)
        self._goal = goal - goal.mean(dim=1, keepdim=True)
        self._near, self._normals = network.neighbours(self._goal), normals(self._goal)
        self._found = torch.eye(3, device=goal.device).repeat(len(goal), 1, 1)
        self._known = torch.zeros(len(goal), dtype=torch.bool, device=goal.device)

    def reset(self, rows: torch.Tensor) -> None:
        """Forget what is known of objects, a mask or indices."""
        self._known[rows] = False

    @torch.inference_mode()
    def look(self, seen: torch.Tensor, rows: torch.Tensor | None = None) -> Alignment:
        """Compare once.

        Args:
            seen: What is seen of the objects [m] [R, P', 3], points in no order.
            rows: Which objects, each once [R]; all by default.

        Returns:
            Tensors of inference mode: clone them before changing them or learning from them.
        """
        rows = torch.arange(len(self._goal), device=seen.device) if rows is None else rows
        mean = seen.mean(dim=1)
        seen = seen - mean[:, None]
        tokens = self.network.encode(seen, SEEN, self.network.neighbours(seen))
        new = ~self._known[rows]
        if bool(new.any()):
            self._found[rows[new]] = self._first(rows[new], tokens[new], seen[new])
            self._known[rows] = True
        found, offset, _ = self._laid(
            rows, seen, *self._improve(rows, tokens, self._found[rows, None])
        )
        self._found[rows] = found[:, 0]
        return Alignment(found[:, 0], mean + offset[:, 0])

    def _first(self, rows: torch.Tensor, tokens: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        """The best that starts come to, rotations [R, 3, 3]."""
        found = self._starts.expand(len(rows), -1, -1, -1)
        for _ in range(PASSES):
            found, offset = self._improve(rows, tokens, found)
        found, _, misfit = self._laid(rows, seen, found, offset)
        return found[torch.arange(len(rows), device=rows.device), misfit.argmin(dim=1)]

    def _laid(
        self, rows: torch.Tensor, seen: torch.Tensor, rotations: torch.Tensor, offsets: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Hypotheses [R, H, 3, 3] and offsets [R, H, 3] laid onto what is seen, and their misfits [m]."""
        shape, pair = rotations.shape[:2], torch.arange(len(rows), device=rows.device)
        pair, parts = pair.repeat_interleave(shape[1]), []
        for some in torch.arange(len(pair), device=rows.device).split(PAIRS_AT_ONCE):
            goal = rows[pair[some]]
            clouds = self._goal[goal], self._normals[goal], seen[pair[some]]
            parts.append(
                refine(*clouds, rotations.flatten(0, 1)[some], offsets.flatten(0, 1)[some], STEPS)
            )
        found, offset, misfit = (torch.cat(v).unflatten(0, shape) for v in zip(*parts, strict=True))
        return found, offset, misfit

    def _improve(
        self, rows: torch.Tensor, seen: torch.Tensor, rotations: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """One pass over hypotheses [R, H, 3, 3]: better ones, and their offsets [R, H, 3]."""
        shape, flat = rotations.shape[:2], rotations.flatten(0, 1)
        pair = torch.arange(len(rows), device=rows.device).repeat_interleave(shape[1])
        parts = []
        for some in torch.arange(len(pair), device=rows.device).split(PAIRS_AT_ONCE):
            goal = rows[pair[some]]
            turned = self._goal[goal] @ flat[some].transpose(-1, -2)
            tokens = self.network.encode(turned, GOAL, self._near[goal])
            parts.append(self.network.compare(tokens, seen[pair[some]]))
        better = torch.cat([part.rotation for part in parts]) @ flat
        better = matrices(first_columns(better))  # still rotations after many
        return better.unflatten(0, shape), torch.cat([part.offset for part in parts]).unflatten(
            0, shape
        )
