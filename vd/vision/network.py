"""The student's network: sparse encoder, memory, policy and distance heads.

T steps, N environments, B = T N or N clouds, D actions, E the embedding, G the memory, H distance heads.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn

from vd.paper import PAPER
from vd.vision.cfg import EncoderCfg, StudentCfg
from vd.vision.sites import Sites
from vd.vision.sparse import SparseConv3d, SparseMaxPool3d, global_pool

POSITION_SCALE_M = 0.1
"""Positions of voxels are given in units of this: about the size of the scene."""
VELOCITY_SCALE = PAPER.observation.velocity_scale
"""Factor on joint velocities, as in the teacher's observation."""
INPUT_WIDTHS = {"constant": 1, "position": 3, "marks": 2}
"""Features of a voxel by the name of the input."""
BROAD = 2.0
"""Bias with which a bounded standard deviation starts in the upper part of its (logarithmic) range."""


@dataclass(frozen=True)
class StudentOutput:
    """What the network says of a step, leading shape [N] or [T, N]; in the precision of its weights."""

    mean: torch.Tensor
    """Mean of the actions, not clipped [.., D]."""
    log_std: torch.Tensor
    """Logarithm of their standard deviation [.., D]."""
    distance: torch.Tensor
    """Predicted angle to the goal by each distance head [rad], in the order of the configuration: the last
    one is the one to stop by [.., H]."""
    hidden: torch.Tensor
    """Memory after the last step [N, G]."""


def voxel_features(sites: Sites, cfg: EncoderCfg, voxel_m: float) -> torch.Tensor:
    """What an encoder reads of each voxel [M, C].

    Raises:
        ValueError: Marks are read, but the voxeliser was not asked for them.
    """
    parts = []
    for name in cfg.inputs:
        if name == "constant":
            parts.append(torch.full((len(sites), 1), PAPER.cloud.feature, device=sites.device))
        elif name == "position":
            parts.append(voxel_m / POSITION_SCALE_M * (sites.coordinates[:, 1:] + 0.5))
        else:
            parts.append(sites.marks)
    return torch.cat(parts, dim=1)


class ResidualBlock(nn.Module):
    """BN, ReLU, convolution, twice, added to the input (He et al. 2016), on the cells of one level."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm1 = nn.BatchNorm1d(channels)
        self.conv1 = SparseConv3d(channels, channels)
        self.norm2 = nn.BatchNorm1d(channels)
        self.conv2 = SparseConv3d(channels, channels)

    def forward(self, features: torch.Tensor, sites: Sites) -> torch.Tensor:
        """Features [M, C] of the same cells."""
        inner = self.conv1(torch.relu(self.norm1(features)), sites)
        return features + self.conv2(torch.relu(self.norm2(inner)), sites)


class EncoderStage(nn.Module):
    """A convolution of stride 2, BN, max pooling if asked for, and residual blocks."""

    def __init__(self, in_channels: int, channels: int, blocks: int, *, pooled: bool):
        super().__init__()
        self.conv = SparseConv3d(in_channels, channels, stride=2)
        self.norm = nn.BatchNorm1d(channels)
        self.pool = SparseMaxPool3d() if pooled else None
        self.blocks = nn.ModuleList(ResidualBlock(channels) for _ in range(blocks))

    def forward(self, features: torch.Tensor, sites: Sites) -> tuple[torch.Tensor, Sites]:
        """Features of the coarser cells, and these."""
        features, sites = self.norm(self.conv(features, sites)), sites.coarser
        if self.pool is not None:
            features, sites = self.pool(features, sites), sites.coarser
        for block in self.blocks:
            features = block(features, sites)
        return features, sites


class VoxelEncoder(nn.Module):
    """Occupied voxels to one embedding of each cloud: stages, global max and mean, two linear layers.

    ``encoder.bfloat16()`` halves the time on a processor that multiplies in that precision.
    """

    def __init__(self, cfg: EncoderCfg, voxel_m: float = PAPER.cloud.voxel_m):
        super().__init__()
        self.cfg, self.voxel_m = cfg, voxel_m
        widths = (sum(INPUT_WIDTHS[name] for name in cfg.inputs), *cfg.channels)
        self.stages = nn.ModuleList(
            EncoderStage(inner, outer, cfg.blocks, pooled=i < cfg.pooled_stages)
            for i, (inner, outer) in enumerate(zip(widths, cfg.channels, strict=False))
        )
        self.final = nn.Linear(2 * cfg.channels[-1], cfg.embedding)
        self.projector = nn.Linear(cfg.embedding, cfg.embedding)

    def forward(self, sites: Sites) -> torch.Tensor:
        """Embeddings [B, E] of the clouds of ``sites``, which has level 0."""
        features = voxel_features(sites, self.cfg, self.voxel_m).to(self.final.weight.dtype)
        for stage in self.stages:
            features, sites = stage(features, sites)
        pooled = global_pool(features, sites).to(self.final.weight.dtype)
        return torch.relu(self.projector(self.final(pooled)))


class Student(nn.Module):
    """From voxels and the previous action to the next, with memory.

    One step: :meth:`encode`, then :meth:`forward` with T = 1, or :meth:`act` for both. In training all
    clouds of a sequence are encoded in one batch, then :meth:`forward` runs over their embeddings.
    """

    def __init__(self, cfg: StudentCfg, num_actions: int):
        """Build with random weights.

        Args:
            cfg: Sizes and variants.
            num_actions: D.

        Raises:
            ValueError: For sizes that make no network.
        """
        super().__init__()
        cfg.validate()
        self.cfg = cfg
        self.num_actions = num_actions
        self.num_proprioception = num_actions * len(cfg.proprioception)
        width = cfg.encoder.embedding
        self.encoder = VoxelEncoder(cfg.encoder, cfg.voxel_m)
        self.action_layers = nn.Sequential(
            nn.Linear(self.num_proprioception, cfg.action_hidden),
            nn.GELU(),
            nn.Linear(cfg.action_hidden, cfg.action_hidden),
        )
        self.merge_action = nn.Linear(width + cfg.action_hidden, width)
        self.memory = nn.GRU(width, cfg.memory)
        self.head = nn.Sequential(nn.Linear(cfg.memory, cfg.head_hidden), nn.GELU())
        self.mean = nn.Linear(cfg.head_hidden, num_actions)
        self.log_std = nn.Linear(cfg.head_hidden, num_actions)
        if cfg.std_range is not None:
            # Broad at first, as without bounds: the likelihood weighs the error of random means by 1 / std^2.
            nn.init.constant_(self.log_std.bias, BROAD)
        self.distance = nn.ModuleDict(
            {
                place: nn.Sequential(
                    nn.Linear(width if place == "before" else cfg.memory, cfg.distance_hidden),
                    nn.GELU(),
                    nn.Linear(cfg.distance_hidden, 1),
                )
                for place in cfg.distance
            }
        )

    def proprioception(self, frame: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """What the student knows of itself [.., S].

        Args:
            frame: ``action`` [.., D], the (smoothed) action before the step, and as far as the configuration
                names them ``position`` [rad] and ``velocity`` [rad/s] of the joints [.., D].
        """
        names = self.cfg.proprioception
        return torch.cat([frame[n] * VELOCITY_SCALE if n == "velocity" else frame[n] for n in names], dim=-1)

    def initial_hidden(self, envs: int) -> torch.Tensor:
        """The memory at the start of an episode: zeros [N, G]."""
        return self.mean.weight.new_zeros((envs, self.cfg.memory))

    def encode(self, sites: Sites) -> torch.Tensor:
        """Embeddings [B, E] of clouds, of scene and goal together."""
        # The encoder may be of lower precision than the rest.
        return self.encoder(sites).to(self.mean.weight.dtype)

    def forward(
        self,
        embedding: torch.Tensor,
        proprioception: torch.Tensor,
        hidden: torch.Tensor,
        done: torch.Tensor | None = None,
    ) -> StudentOutput:
        """Run the memory over a sequence and read the heads.

        Args:
            embedding: From :meth:`encode`, shape [T, N, E].
            proprioception: From :meth:`proprioception`, before each step, shape [T, N, S].
            hidden: Memory before the first step, shape [N, G].
            done: Where an episode ended with step t, so that step t + 1 starts without memory, shape [T, N].
        """
        inputs = torch.cat([embedding, self.action_layers(proprioception)], dim=-1)
        remembered, hidden = self._remember(self.merge_action(inputs), hidden, done)
        features = self.head(remembered)
        places = {"before": embedding, "after": remembered}
        distance = [head(places[place]) for place, head in self.distance.items()]
        log_std = self.log_std(features)
        if self.cfg.std_range is not None:
            low, high = (math.log(bound) for bound in self.cfg.std_range)
            log_std = low + (high - low) * torch.sigmoid(log_std)
        # Autocast may have computed in half precision; losses and the next step should not have to.
        precision = self.mean.weight.dtype
        parts = (self.mean(features), log_std, torch.cat(distance, dim=-1), hidden)
        return StudentOutput(*(part.to(precision) for part in parts))

    def act(self, sites: Sites, proprioception: torch.Tensor, hidden: torch.Tensor) -> StudentOutput:
        """One step of N clouds: ``proprioception`` [N, S] and ``hidden`` [N, G] give leading shape [N]."""
        output = self(self.encode(sites)[None], proprioception[None], hidden)
        return StudentOutput(output.mean[0], output.log_std[0], output.distance[0], output.hidden)

    def _remember(
        self, inputs: torch.Tensor, hidden: torch.Tensor, done: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The GRU over [T, N, E], its memory cleared where environments ended."""
        if done is None:
            outputs, state = self.memory(inputs, hidden[None])
            return outputs, state[0]
        # An environment's steps are cut into runs at its ends, and all runs go through the GRU side by side.
        ended = done.bool()
        steps, envs = ended.shape
        begins = torch.cat([torch.ones_like(ended[:1]), ended[:-1]])
        run = begins.T.flatten().cumsum(0).view(envs, steps).T - 1
        step = torch.arange(steps, device=inputs.device)[:, None]
        since = step - torch.where(begins, step, 0).cummax(dim=0).values
        runs = int(run[-1, -1]) + 1  # waits for the device
        place = (since * runs + run).flatten()
        beside = inputs.new_zeros((steps * runs, inputs.shape[-1])).index_copy(0, place, inputs.flatten(0, 1))
        first = hidden.new_zeros((runs, hidden.shape[-1])).index_copy(0, run[0], hidden)
        outputs, _ = self.memory(beside.view(steps, runs, -1), first[None])
        remembered = outputs.flatten(0, 1).index_select(0, place).view(steps, envs, -1)
        return remembered, remembered[-1].masked_fill(ended[-1, :, None], 0.0)
