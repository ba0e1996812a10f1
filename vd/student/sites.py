"""Occupied cells of a batch of voxelised clouds, and the maps that sparse layers read, each built once."""

from collections.abc import Sequence
from functools import cached_property

import torch
import warp as wp

from vd.kernels.coordinate_maps import (
    beside,
    coarsen,
    level_counts,
    neighbour_table,
    strided_table,
    window_table,
)
from vd.kernels.voxels import cloud_offsets, coordinates


class Sites:
    """M occupied cells of B clouds on one level of a grid; the cells of level l are 2^l voxels wide.

    Rows are sorted by cloud. Maps and coarser levels are built when first asked for and kept, so that
    all layers of a level, forward and backward, share them. Only the first coarser level waits for the
    device, to learn the sizes of all.

    Attributes:
        keys: Sorted keys of the cells (:mod:`vd.kernels.voxels`), shape [M].
        clouds: B.
        level: l.
        marks: What the cells hold, columns of 0 and 1, shape [M, C], where that was asked for.
        complete: Whether all that bears no mark is of the object; a camera sees the hand too.
    """

    marks: torch.Tensor | None = None
    complete: bool = False

    def __init__(self, keys: wp.array, clouds: int, level: int = 0, *, sizes: Sequence[int] = ()):
        """Take the cells.

        Args:
            keys: Sorted keys of the cells, each once, shape [M].
            clouds: B.
            level: l.
            sizes: Numbers of cells of the coarser levels, as far as they are known.
        """
        self.keys = keys
        self.clouds = clouds
        self.level = level
        self._sizes = sizes

    def fresh(self) -> "Sites":
        """The same cells without maps, as they come from the voxeliser."""
        same = Sites(self.keys, self.clouds, self.level)
        same.marks, same.complete = self.marks, self.complete
        return same

    def __len__(self) -> int:
        return int(self.keys.shape[0])

    @property
    def device(self) -> torch.device:
        """Where features of these cells belong."""
        return torch.device(wp.device_to_torch(self.keys.device))

    @cached_property
    def offsets(self) -> torch.Tensor:
        """First row of each cloud, and M, shape [B + 1], int32."""
        return wp.to_torch(cloud_offsets(self.keys, self.clouds, self.level))

    @cached_property
    def coordinates(self) -> torch.Tensor:
        """Rows (cloud, x, y, z): each cell covers voxels from 2^l (x, y, z) on, shape [M, 4], int32."""
        return wp.to_torch(coordinates(self.keys, self.level))

    def touching(self, chosen: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """Those of the chosen cells that touch, by a corner at least, or are one of the others; level 0.

        Args:
            chosen: Which cells are asked about, bool [M].
            others: Which they may touch, bool [M].

        Returns:
            Bool [M].
        """
        keys = wp.to_torch(self.keys)
        some, rest = (wp.from_torch(keys[which]) for which in (chosen, others))
        touches = torch.zeros_like(chosen)
        touches[chosen] = wp.to_torch(beside(some, rest)).bool()
        return touches

    @cached_property
    def _coarser(self) -> tuple["Sites", wp.array]:
        size, *sizes = self._sizes or level_counts(self.keys)
        keys, place = coarsen(self.keys, size)
        return Sites(keys, self.clouds, self.level + 1, sizes=sizes), place

    @property
    def coarser(self) -> "Sites":
        """Cells of the next level that hold any of these: floor(c / 2)."""
        return self._coarser[0]

    @cached_property
    def neighbours(self) -> torch.Tensor:
        """Rows that a submanifold 3x3x3 kernel reads for each cell, M for none, shape [M, 27], int32."""
        return wp.to_torch(neighbour_table(self.keys, self.level))

    @cached_property
    def strided(self) -> torch.Tensor:
        """Rows that a 3x3x3 kernel of stride 2 reads for each coarser cell, M for none.

        Shape [coarser M, 27], int32.
        """
        return wp.to_torch(strided_table(self.keys, self.coarser.keys, self.level))

    @cached_property
    def strided_back(self) -> torch.Tensor:
        """Coarser rows that read each cell so, by the same offsets, coarser M for none, [M, 27], int32."""
        return wp.to_torch(strided_table(self.keys, self.coarser.keys, self.level, reverse=True))

    @cached_property
    def windows(self) -> torch.Tensor:
        """Rows in the 2x2x2 window of each coarser cell, M for none, shape [coarser M, 8], int32."""
        coarser, place = self._coarser
        return wp.to_torch(window_table(self.keys, place, len(coarser)))
