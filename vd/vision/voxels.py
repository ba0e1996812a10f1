"""Voxels of point clouds, with the noise of training."""

import torch
import warp as wp

from vd.kernels.rng import init_rng_kernel
from vd.kernels.sparse.voxels import CloudNoise, draw_noise, voxelise
from vd.paper import PAPER
from vd.vision.cfg import NoiseCfg
from vd.vision.sites import Sites


class Voxeliser:
    """Points to voxels, with noise in training that every cloud draws for itself."""

    def __init__(
        self,
        voxel_m: float = PAPER.cloud.voxel_m,
        *,
        noise: NoiseCfg | None = None,
        clouds: int = 0,
        seed: int = 0,
        device: str = "cpu",
    ):
        """Prepare the noise.

        Args:
            voxel_m: Side of a voxel [m].
            noise: Noise of training; None where there will be none.
            clouds: Clouds of a training batch at most: each has a random stream.
            seed: Seed of the streams.
            device: Warp device.

        Raises:
            ValueError: For noise that cannot be drawn.
        """
        self.voxel_m = voxel_m
        self.device = device
        self._noise: wp.array | None = None
        self._ends: dict[tuple[int, ...], wp.array] = {}
        self.rng = wp.empty(clouds, dtype=wp.uint32, device=device)
        """Random stream of each cloud of a batch, shape [clouds]."""
        if noise is not None:
            noise.validate()
            values = CloudNoise()
            values.jitter_probability, values.jitter_std = noise.jitter_probability, noise.jitter_std_m
            values.dropout_probability = noise.dropout_probability
            values.dropout_ratio = wp.vec2(*noise.dropout_ratio)
            self._noise = wp.array([values], dtype=CloudNoise, device=device)
            wp.launch(init_rng_kernel, dim=clouds, inputs=[seed], outputs=[self.rng], device=device)

    def __call__(
        self, points: wp.array | torch.Tensor, *, augment: bool = False, ends: tuple[int, ...] = ()
    ) -> Sites:
        """Voxels of clouds.

        Args:
            points: Points [m], shape [B, P] of vectors, or [B, P, 3] as a tensor; those not finite count
                for nothing.
            augment: Add noise, as in training.
            ends: Columns at which groups of points end, one group after the other from the first column on.
                Voxels are marked by the groups of which they hold points (``marks`` of the result).

        Raises:
            ValueError: Noise is asked for where none was prepared, or for more clouds than were.
        """
        if isinstance(points, torch.Tensor):
            points = wp.from_torch(points, dtype=wp.vec3)
        clouds = points.shape[0]
        draw = None
        if augment:
            if self._noise is None or clouds > self.rng.shape[0]:
                raise ValueError(
                    f"no noise for {clouds} clouds: make the voxeliser with noise and as many clouds"
                )
            draw = draw_noise(self._noise, self.rng[:clouds])
        if not ends:
            return Sites(voxelise(points, self.voxel_m, draw)[0], clouds)
        if ends not in self._ends:
            self._ends[ends] = wp.array(ends, dtype=wp.int32, device=self.device)
        keys, marks = voxelise(points, self.voxel_m, draw, self._ends[ends])
        return Sites(keys, clouds, marks=wp.to_torch(marks))
