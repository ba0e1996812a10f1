"""The student: a network that turns what a camera sees, joints and a goal's cloud into an action.

One sparse tensor holds what the camera sees, the hand's own points by its joints, and the goal's
cloud, each kind in channels of its own. The goal's cloud is laid where the object is believed to
be, so what is wrong with the belief shows as a shift between two surfaces, wherever the object is.
The network predicts for each voxel of the goal by how much it is to move, and how sure that is; the
rigid motion that fits these shifts best makes the belief better.

What it then believes is told its memory and its head as numbers: how far the fingertips are from
the goal's cloud laid there, how far that extends, and the wanted rotation. A GRU carries over steps
what one look does not show.

Seeing learns from single looks and acting from sequences of what was told: no gradient flows from
one to the other. So to learn to act is cheap, and each gets as many optimiser steps as it needs.

N environments, T steps, R looks, V voxels of goals in all of them, A actions, F fingertips, S told
numbers, G the memory. The frames of :mod:`vd.vision.inputs`; metres, radians.
"""

from dataclasses import dataclass
from itertools import pairwise, product

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from vd.kernels.task.shapes import EXTENT_CENTRE_M, SHAPE_UNIT_M
from vd.vision.cfg import StudentCfg
from vd.vision.inputs import Belief, StudentInput, carried, either
from vd.vision.rotations import first_columns, matrices
from vd.vision.sparse import ResidualBlock, SparseTensor, StridedConv, global_pool, voxelise

KINDS = 3
"""Kinds of points: of the camera, of the hand, of the goal."""
PLACE_M = 0.1
"""Unit of places and offsets [m]: about the size of the scene."""
BELIEVED = 9
"""Numbers of a belief: two columns of a rotation, and a place."""
SHIFT_M = 0.01
"""Unit of the deviation of shifts [m]."""
LOG_SCALE = (-3.0, 3.0)
"""Least and largest logarithm of that deviation: from 0.5 mm to 20 cm."""
LEAST_M = 1e-4
"""Goals are as if they were this wide at least [m], for what cannot be told."""
DIRECTIONS = tuple(way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way))
"""Directions in which it is told how far the surface extends: to the neighbours of a cell."""


@dataclass(frozen=True)
class Flow:
    """By how much the goal's voxels are to move to lie on the object, predicted."""

    start: Tensor
    """Where they are laid, from the believed place [m] [V, 3]."""
    shift: Tensor
    """By how much they are to move [m] [V, 3]."""
    log_scale: Tensor
    """Logarithm of the deviation of that, of a Laplace distribution [cm] [V]."""
    look: Tensor
    """The look to which each belongs, int64 [V]."""


@dataclass(frozen=True)
class Look:
    """What R looks show, without memory."""

    belief: Belief
    """The better belief [R]."""
    doubt: Tensor
    """Mean of the logarithm of the deviation of shifts [cm] [R]."""
    voxels: Tensor
    """How many voxels hold points of the camera and none of the hand [R]."""
    flow: Flow
    """What the belief is made better by."""


@dataclass(frozen=True)
class Decision:
    """What a student decides; leading axes [N] or [T, N]."""

    action: Tensor
    """The action, not clipped [.., A]."""
    hidden: Tensor
    """Memory after the last step [N, G]."""


@torch.no_grad()
def rigid_motion(flow: Flow, looks: int) -> tuple[Tensor, Tensor]:
    """The rigid motion of each look that fits its shifts best, by weighted least squares (Kabsch 1976).

    Voxels weigh by the inverse square of their deviation. About a line on which all of them lie
    nothing is turned. No gradient flows.

    Returns:
        Rotations [R, 3, 3], and translations [m] [R, 3]: q ~ R p + t.
    """
    lengths = torch.bincount(flow.look, minlength=looks)

    def total(values: Tensor) -> Tensor:
        return torch.segment_reduce(values, "sum", lengths=lengths, unsafe=True)

    weight = torch.exp(-2.0 * flow.log_scale)
    weight = weight / total(weight)[flow.look]
    end = flow.start + flow.shift
    from_middle = total(weight[:, None] * flow.start)
    to_middle = total(weight[:, None] * end)
    start = flow.start - from_middle[flow.look]
    end = end - to_middle[flow.look]
    products = weight[:, None, None] * end[:, :, None] * start[:, None, :]
    covariance = total(products.flatten(1)).unflatten(1, (3, 3))
    still = LEAST_M**2 * torch.eye(3, device=covariance.device)
    left, _, right = torch.linalg.svd(covariance + still)
    signs = torch.ones_like(to_middle)
    signs[:, 2] = torch.linalg.det(left @ right).sign()
    rotation = left @ (signs[:, :, None] * right)
    return rotation, to_middle - carried(from_middle[:, None], rotation)[:, 0]


class VoxelStage(nn.Module):
    """A convolution of stride 2, BN and residual blocks on the coarser cells.

    Args:
        inputs: C_in.
        outputs: C_out.
        blocks: Residual blocks.
    """

    def __init__(self, inputs: int, outputs: int, blocks: int):
        super().__init__()
        self.conv = StridedConv(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs)
        self.blocks = nn.Sequential(*(ResidualBlock(outputs) for _ in range(blocks)))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features of the coarser cells."""
        x = self.conv(x)
        normed = SparseTensor(self.norm(x.features), x.sites)
        return self.blocks(normed)


class Student(nn.Module):
    """From what is seen and sensed to the action, with memory (the paper's Figure 7).

    :meth:`look` sees, :meth:`forward` decides by what was told of looks.

    Its stages multiply in their weights' precision: ``stages.bfloat16()`` is for a robot's
    computer, ``half`` for learning. Geometry is computed in single precision; so call it outside
    of autocast.

    Args:
        cfg: Its sizes.
        num_actions: A.
        num_tips: F.

    Attributes:
        half: The stages multiply in bfloat16 while weights stay in single precision.
    """

    def __init__(self, cfg: StudentCfg, num_actions: int, num_tips: int):
        super().__init__()
        cfg.validate()
        self.cfg = cfg
        self.num_actions = num_actions
        self.num_tips = num_tips
        self.half = False
        widths = (4 * KINDS + 3, *cfg.channels)
        self.stages = nn.Sequential()
        for inputs, outputs in pairwise(widths):
            self.stages.append(VoxelStage(inputs, outputs, cfg.blocks))
        pooled = 2 * widths[-1]
        self.flow = nn.Sequential(
            nn.Linear(sum(widths[1:]) + pooled + 6, cfg.flow),
            nn.GELU(),
            nn.Linear(cfg.flow, cfg.flow),
            nn.GELU(),
            nn.Linear(cfg.flow, 4),
        )
        ways = torch.tensor(DIRECTIONS)
        self.register_buffer("directions", normalize(ways, dim=1), persistent=False)
        told = 3 * num_actions + BELIEVED + 3 * num_tips + 2 * len(ways)
        self.senses = nn.Sequential(
            nn.Linear(told, cfg.senses),
            nn.GELU(),
            nn.Linear(cfg.senses, cfg.senses),
            nn.LayerNorm(cfg.senses),
        )
        self.memory = nn.GRU(cfg.senses, cfg.memory)
        self.head = nn.Sequential(
            nn.Linear(cfg.memory + cfg.senses, cfg.head),
            nn.GELU(),
            nn.Linear(cfg.head, cfg.head),
            nn.GELU(),
        )
        self.action = nn.Linear(cfg.head, num_actions)

    def first_hidden(self, envs: int) -> Tensor:
        """The memory where an episode begins: zeros [N, G]."""
        return self.action.weight.new_zeros((envs, self.cfg.memory))

    def look(self, sight: StudentInput) -> Look:
        """What R looks show, and a better belief. Waits for the device."""
        believed = sight.belief
        place = believed.position[:, None]
        laid = carried(sight.goal, believed.rotation)
        kinds = [sight.camera - place, sight.hand - place, laid]
        within = list(map(self._within_reach, kinds))
        voxels = voxelise(within, self.cfg.voxel_m)
        levels = self._convolve(voxels)
        pooled = global_pool(levels[-1]).to(place.dtype)
        flow = self._flow(voxels, levels, pooled)
        looks = len(place)
        turn, shift = rigid_motion(flow, looks)
        camera = voxels.features[:, 0]
        hand = voxels.features[:, 4]
        beside = camera * (1.0 - hand)
        lengths = voxels.sites.lengths
        seen = torch.segment_reduce(beside, "sum", lengths=lengths, unsafe=True)
        turned = turn @ believed.rotation
        rotation = matrices(first_columns(turned))  # still a rotation after many steps
        position = believed.position + shift
        better = either(seen == 0.0, believed, Belief(rotation, position))
        of_look = torch.bincount(flow.look, minlength=looks)
        doubt = torch.segment_reduce(flow.log_scale, "mean", lengths=of_look, unsafe=True)
        return Look(better, doubt, seen, flow)

    def _convolve(self, voxels: SparseTensor) -> list[SparseTensor]:
        """Features of the cells of each stage."""
        cells = voxels.sites.coordinates[:, 1:]
        middles = self.cfg.voxel_m / PLACE_M * (cells + 0.5)
        features = torch.cat([voxels.features, middles], dim=1)
        x = SparseTensor(features.to(next(self.stages.parameters()).dtype), voxels.sites)
        levels = []
        with torch.autocast(features.device.type, torch.bfloat16, enabled=self.half):
            for stage in self.stages:
                x = stage(x)
                levels.append(x)
        return levels

    def _flow(self, voxels: SparseTensor, levels: list[SparseTensor], pooled: Tensor) -> Flow:
        """The shifts of the goal's voxels, from the cells of all stages that hold them."""
        sites = voxels.sites
        goal = (voxels.features[:, 8] > 0.0).nonzero()[:, 0]
        keys = sites.keys[goal]
        cells = sites.coordinates[goal]
        look = cells[:, 0].long()
        offset = voxels.features[goal, 9:12]
        start = self.cfg.voxel_m * (cells[:, 1:] + 0.5 + offset)
        columns = [start / PLACE_M, offset, pooled[look]]
        for level in levels:
            cell = keys & ~(level.sites.step**3 - 1)
            row = torch.searchsorted(level.sites.keys, cell)
            columns.append(level.features[row].to(start.dtype))
        predicted = self.flow(torch.cat(columns, dim=1))
        return Flow(
            start=start,
            shift=PLACE_M * predicted[:, :3],
            log_scale=predicted[:, 3].clamp(*LOG_SCALE),
            look=look,
        )

    def forward(self, told: Tensor, hidden: Tensor, done: Tensor | None = None) -> Decision:
        """Decide in a sequence of steps.

        Args:
            told: What was told in each step [T, N, S].
            hidden: Memory before the first step [N, G].
            done: Where step t was the last of an episode, bool [T, N]: t + 1 begins without memory.
        """
        sensed = self.senses(told)
        remembered, hidden = self._remember(sensed, hidden, done)
        decided = self.head(torch.cat([remembered, sensed], dim=-1))
        return Decision(self.action(decided), hidden)

    def decide(self, told: Tensor, hidden: Tensor) -> Decision:
        """Decide in one step of N hands, leading axes [N]."""
        step = self(told[None], hidden)
        return Decision(step.action[0], step.hidden)

    def act(self, sight: StudentInput, hidden: Tensor) -> tuple[Look, Decision]:
        """Look, and decide: one step of N hands, leading axes [N]."""
        look = self.look(sight)
        return look, self.decide(self.told(sight, look.belief), hidden)

    def _within_reach(self, points: Tensor) -> Tensor:
        """Points [.., 3] about the object's place; NaN for those that are out of reach."""
        far = points.norm(dim=-1, keepdim=True) > self.cfg.reach_m
        return points.masked_fill(far, torch.nan)

    def told(self, sight: StudentInput, belief: Belief) -> Tensor:
        """What memory and head are told where an object is believed to be [R, 3 A + 9 + 3 F + 52].

        Joints and the last action; from the goal to the object as two columns, its place, and its
        surface: the way from each fingertip to the nearest point, and how far it extends from its
        middle in :data:`DIRECTIONS`, as it lies and as it is to lie.
        """
        turn = belief.rotation @ sight.goal_rotation.mT
        laid = carried(sight.goal, belief.rotation)
        wanted = carried(sight.goal, sight.goal_rotation)
        tips = sight.tips - belief.position[..., None, :]
        nearest = torch.cdist(tips, laid).argmin(dim=-1, keepdim=True)
        way = laid.gather(-2, nearest.expand_as(tips)) - tips
        told = [sight.proprioception, first_columns(turn), belief.position / PLACE_M]
        told.append(way.flatten(-2) / SHAPE_UNIT_M)
        for cloud in (laid, wanted):
            extent = (cloud @ self.directions.T).amax(dim=-2)
            told.append((extent - EXTENT_CENTRE_M) / SHAPE_UNIT_M)
        return torch.cat(told, dim=-1)

    def _remember(
        self, inputs: Tensor, hidden: Tensor, done: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The GRU over [T, N, ..], its memory cleared where episodes ended: [T, N, G], [N, G]."""
        outputs = []
        state = hidden[None]
        for step in range(len(inputs)):
            output, state = self.memory(inputs[step : step + 1], state)
            outputs.append(output)
            if done is not None:
                state = state.masked_fill(done[step, :, None], 0.0)
        return torch.cat(outputs), state[0]
