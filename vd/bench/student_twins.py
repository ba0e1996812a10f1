"""The student's encoder on other convolutions, for its benchmark.

A product for each offset with scattered sums, dense grids, and spconv's layers if installed. What is
compared is the time of the same layers on the same cloud; the last two have random weights of their own.
"""

import copy
from typing import Any

import torch
from torch import nn

from vd.paper import PAPER
from vd.student.cfg import EncoderCfg
from vd.student.network import VoxelEncoder, input_width, voxel_features
from vd.student.sites import Sites
from vd.student.sparse import SparseConv3d


class ScatteredConv3d(SparseConv3d):
    """The same sums the other way: for each offset gather its inputs, multiply, and add to its outputs."""

    def forward(self, features: torch.Tensor, sites: Sites) -> torch.Tensor:
        """As :class:`SparseConv3d`."""
        table = sites.strided if self.stride == 2 else sites.neighbours
        pairs = getattr(table, "pairs", None)
        if pairs is None:
            rows = [(column < len(sites)).nonzero().flatten() for column in table.t()]
            pairs = [(row, table[row, k].long()) for k, row in enumerate(rows)]
            table.pairs = pairs  # kept with the map, as its users share it
        output = features.new_zeros((table.shape[0], self.weight.shape[2]))
        for k, (row, source) in enumerate(pairs):
            output.index_add_(0, row, features.index_select(0, source) @ self.weight[k])
        return output


def scattered(encoder: VoxelEncoder) -> VoxelEncoder:
    """A copy of an encoder with :class:`ScatteredConv3d`."""
    twin = copy.deepcopy(encoder)
    for module in twin.modules():
        if isinstance(module, SparseConv3d):
            module.__class__ = ScatteredConv3d
    return twin


def voxels_per_cell(cfg: EncoderCfg) -> int:
    """Voxels on a side of a cell of the last stage."""
    return int(2 ** (len(cfg.channels) + cfg.pooled_stages))


class DenseEncoder(nn.Module):
    """``conv3d`` over the bounding box of one cloud, empty cells included."""

    def __init__(self, cfg: EncoderCfg):
        super().__init__()
        self.cfg = cfg
        widths = (input_width(cfg), *cfg.channels)
        self.stages = nn.ModuleList()
        for i, (inner, outer) in enumerate(zip(widths, cfg.channels, strict=False)):
            layers: list[nn.Module] = [
                nn.Conv3d(inner, outer, 3, stride=2, padding=1, bias=False),
                nn.BatchNorm3d(outer),
            ]
            if i < cfg.pooled_stages:
                layers.append(nn.MaxPool3d(2))
            self.stages.append(nn.Sequential(*layers, *(_DenseBlock(outer) for _ in range(cfg.blocks))))

    def forward(self, sites: Sites) -> torch.Tensor:
        """Pooled features [1, 2 C] of the one cloud of ``sites``."""
        cells = sites.coordinates[:, 1:].long()
        side = voxels_per_cell(self.cfg)
        corner = cells.amin(dim=0).div(side, rounding_mode="floor") * side
        x, y, z = (cells - corner).T
        size = [-(-(int(axis.max()) + 1) // side) * side for axis in (x, y, z)]
        features = voxel_features(sites, self.cfg, PAPER.cloud.voxel_m)
        grid = torch.zeros(1, features.shape[1], *size, device=sites.device)
        grid[0, :, x, y, z] = features.T
        for stage in self.stages:
            grid = stage(grid)
        return torch.cat([grid.amax(dim=(2, 3, 4)), grid.mean(dim=(2, 3, 4))], dim=1)


class _DenseBlock(nn.Module):
    """BN, ReLU, convolution, twice, added to the input."""

    def __init__(self, channels: int):
        super().__init__()
        self.layers = nn.Sequential()
        for _ in range(2):
            self.layers.append(nn.BatchNorm3d(channels))
            self.layers.append(nn.ReLU())
            self.layers.append(nn.Conv3d(channels, channels, 3, padding=1, bias=False))

    def forward(self, grid: torch.Tensor) -> torch.Tensor:
        """A grid [1, C, X, Y, Z] to another of the same shape."""
        return grid + self.layers(grid)


class SpconvEncoder(nn.Module):
    """spconv's layers. Its strided convolution writes every cell that a kernel touches, so it has more sites.

    Raises:
        ImportError: spconv is not installed.
    """

    def __init__(self, cfg: EncoderCfg):
        super().__init__()
        import spconv.pytorch as spconv

        self.cfg = cfg
        self.tensor = spconv.SparseConvTensor
        widths = (input_width(cfg), *cfg.channels)
        self.stages = nn.ModuleList()
        for i, (inner, outer) in enumerate(zip(widths, cfg.channels, strict=False)):
            stage = nn.ModuleDict(
                {
                    "conv": spconv.SparseConv3d(inner, outer, 3, 2, 1, bias=False),
                    "norm": nn.BatchNorm1d(outer),
                }
            )
            if i < cfg.pooled_stages:
                stage["pool"] = spconv.SparseMaxPool3d(2, 2)
            stage["blocks"] = nn.ModuleList(
                nn.ModuleList(
                    nn.ModuleList(
                        [
                            nn.BatchNorm1d(outer),
                            # One key a stage: its convolutions share their map, as ours do.
                            spconv.SubMConv3d(outer, outer, 3, padding=1, bias=False, indice_key=f"stage{i}"),
                        ]
                    )
                    for _ in range(2)
                )
                for _ in range(cfg.blocks)
            )
            self.stages.append(stage)

    def forward(self, sites: Sites) -> torch.Tensor:
        """Pooled features [1, 2 C] of the one cloud of ``sites``."""
        rows = sites.coordinates
        side = voxels_per_cell(self.cfg)
        corner = rows[:, 1:].amin(dim=0).div(side, rounding_mode="floor") * side
        cells = rows[:, 1:] - corner
        size = [-(-(int(n) + 1) // side) * side for n in cells.amax(dim=0)]
        indices = torch.cat([rows[:, :1], cells], dim=1)
        values = voxel_features(sites, self.cfg, PAPER.cloud.voxel_m)
        grid = self.tensor(values, indices, size, 1)
        for stage in self.stages:
            grid = stage["conv"](grid)
            grid = grid.replace_feature(stage["norm"](grid.features))
            if "pool" in stage:
                grid = stage["pool"](grid)
            for block in stage["blocks"]:
                inner = grid
                for norm, conv in block:
                    inner = conv(inner.replace_feature(torch.relu(norm(inner.features))))
                grid = grid.replace_feature(grid.features + inner.features)
        features: Any = grid.features
        return torch.cat([features.amax(dim=0), features.mean(dim=0)])[None]
