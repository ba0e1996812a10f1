"""Occupied cells of a batch of voxelised clouds, and the maps that sparse layers read, each built once."""

from collections.abc import Sequence
from functools import cached_property

import torch
import warp as wp

from vd.kernels.sparse.coordinate_maps import (
    HashTable,
    coarsen,
    hash_table,
    level_counts,
    neighbour_table,
    strided_table,
    window_table,
)
from vd.kernels.sparse.voxels import cloud_offsets, coordinates


class Sites:
    """M occupied cells of B clouds on one level of a grid; the cells of level l are 2^l voxels wide.

    Rows are sorted by cloud. Maps and coarser levels are built when first asked for and kept, so that
    all layers of a level, forward and backward, share them. Only the first coarser level waits for the
    device, to learn the sizes of all.

    Attributes:
        keys: Sorted keys of the cells (:mod:`vd.kernels.sparse.voxels`), shape [M].
        clouds: B.
        level: l.
    """

    def __init__(
        self,
        keys: wp.array,
        clouds: int,
        level: int = 0,
        *,
        marks: torch.Tensor | None = None,
        sizes: Sequence[int] = (),
    ):
        """Take the cells.

        Args:
            keys: Sorted keys of the cells, each once, shape [M].
            clouds: B.
            level: l.
            marks: Whether the cells hold points of the goal, and of the hand's own model, columns of 0 and 1,
                shape [M, 2], where that was asked for.
            sizes: Numbers of cells of the coarser levels, as far as they are known.
        """
        self.keys = keys
        self.clouds = clouds
        self.level = level
        self._marks, self._sizes = marks, sizes

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

    @property
    def marks(self) -> torch.Tensor:
        """Whether voxels hold points of the goal, and of the hand's own model, shape [M, 2].

        Raises:
            ValueError: The voxeliser was not asked for them.
        """
        if self._marks is None:
            raise ValueError("the network reads marks of voxels; give the voxeliser the ends of the groups")
        return self._marks

    @cached_property
    def _slots(self) -> HashTable:
        return hash_table(self.keys)

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
        return wp.to_torch(neighbour_table(self.keys, self.level, self._slots))

    @cached_property
    def strided(self) -> torch.Tensor:
        """Rows that a 3x3x3 kernel of stride 2 reads for each coarser cell, M for none.

        Shape [coarser M, 27], int32.
        """
        return wp.to_torch(strided_table(*self._strides))

    @cached_property
    def strided_back(self) -> torch.Tensor:
        """Coarser rows that read each cell so, by the same offsets, coarser M for none, [M, 27], int32."""
        return wp.to_torch(strided_table(*self._strides, reverse=True))

    @property
    def _strides(self) -> tuple[wp.array, wp.array, int, HashTable]:
        return self.keys, self.coarser.keys, self.level, self.coarser._slots

    @cached_property
    def windows(self) -> torch.Tensor:
        """Rows in the 2x2x2 window of each coarser cell, M for none, shape [coarser M, 8], int32."""
        coarser, place = self._coarser
        return wp.to_torch(window_table(self.keys, place, len(coarser)))
