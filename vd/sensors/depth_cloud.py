"""Point clouds from depth images: those of simulated cameras, or of a real one."""

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import BASE_IN_WORLD, CameraModel, compose
from vd.kernels.rng import init_rng_kernel
from vd.kernels.sensor.depth_cloud import (
    TILE_COLUMNS,
    TILE_ROWS,
    choose_points_kernel,
    count_points_kernel,
    crop_pixels_kernel,
    next_frame_kernel,
)
from vd.kernels.sensor.raycast import View
from vd.paper import PAPER


def make_views(camera: CameraModel, focal_scale: Sequence[float] | np.ndarray, device: str) -> wp.array:
    """The intrinsics of N cameras, whose focal lengths are ``focal_scale`` [N] times the camera's."""
    views = []
    for scale in focal_scale:
        view = View()
        view.fx, view.fy = camera.fx * float(scale), camera.fy * float(scale)
        view.cx, view.cy = camera.cx, camera.cy
        view.near, view.far = camera.near, camera.far
        views.append(view)
    return wp.array(views, dtype=View, device=device)


class DepthCloud:
    """Crops N depth images by height over the table and chooses K points of each, in the base's frame."""

    def __init__(
        self,
        height: int,
        width: int,
        num_envs: int,
        *,
        points: int = PAPER.camera.points,
        crop_m: tuple[float, float] = PAPER.camera.crop_m,
        device: str = "cpu",
    ):
        """Allocate N clouds.

        Args:
            height: Rows of the image.
            width: Columns of the image.
            num_envs: N.
            points: K, points of a cloud at most.
            crop_m: Least and largest height of a point in the world frame [m].
            device: Warp device.
        """
        self.crop_m = crop_m
        self._tile_rows = math.ceil(height / int(TILE_ROWS))
        self._tile_columns = math.ceil(width / int(TILE_COLUMNS))
        tiles = self._tile_rows * self._tile_columns

        def empty(*shape: int, dtype: type = int) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.points = empty(num_envs, points, dtype=wp.vec3)
        """Points in the frame of the camera's body (the base) [m], NaN beyond ``count``, shape [N, K]."""
        self.count = empty(num_envs)
        """Points of each cloud, shape [N]."""
        self.available = empty(num_envs)
        """Pixels within the crop, of which the points were chosen, shape [N]."""
        self._tile_pixels = empty(num_envs, tiles, dtype=wp.uint32)
        self._tile_first = empty(num_envs, tiles)
        self._row_count, self._row_first = (
            empty(num_envs, self._tile_rows),
            empty(num_envs, self._tile_rows),
        )

    def make(
        self, depth: wp.array, views: wp.array, camera_q: wp.array, extrinsics: wp.array, rng: wp.array
    ) -> None:
        """Make the clouds of images. Launches only.

        Args:
            depth: Depth along the optical axis [m], 0 for none, shape [N, H, W].
            views: Intrinsics, shape [N].
            camera_q: Optical frames in the world frame, shape [N].
            extrinsics: Optical frames in the frame in which the points are wanted, shape [N].
            rng: Random state of each world, shape [N]; not advanced.
        """
        worlds, device = len(self.count), depth.device
        wp.launch(
            crop_pixels_kernel,
            dim=(worlds, self._tile_rows),
            inputs=[views, *self.crop_m, self._tile_columns, camera_q, depth],
            outputs=[self._tile_pixels, self._tile_first, self._row_count],
            device=device,
        )
        wp.launch(
            count_points_kernel,
            dim=worlds,
            inputs=[self.points.shape[1], self._row_count],
            outputs=[self._row_first, self.available, self.count],
            device=device,
        )
        wp.launch(
            choose_points_kernel,
            dim=self.points.shape,
            inputs=[
                views,
                self._tile_columns,
                extrinsics,
                rng,
                depth,
                self._tile_pixels,
                self._tile_first,
                self._row_first,
                self.available,
            ],
            outputs=[self.points],
            device=device,
        )


class CameraCloud:
    """The cloud of one real camera's images, by the kernels that make those of simulated ones."""

    def __init__(
        self,
        camera: CameraModel,
        *,
        points: int = PAPER.camera.points,
        crop_m: tuple[float, float] = PAPER.camera.crop_m,
        device: str = "cpu",
        seed: int = 0,
    ):
        """Prepare the cloud.

        Args:
            camera: The camera; its pose is that in the hand's base.
            points: K, points at most.
            crop_m: Least and largest height over the table [m].
            device: Warp device.
            seed: Of the choice of points.
        """
        self.cloud = DepthCloud(camera.height, camera.width, 1, points=points, crop_m=crop_m, device=device)
        self.depth = wp.zeros((1, camera.height, camera.width), dtype=float, device=device)
        """The image [m], 0 for none, shape [1, H, W]."""
        self._views = make_views(camera, [1.0], device)
        extrinsics = np.concatenate([camera.position, camera.quaternion])
        in_world = compose(np.array(BASE_IN_WORLD), extrinsics)
        self._extrinsics = wp.array(extrinsics[None], dtype=wp.transform, device=device)
        self._camera_q = wp.array(in_world[None], dtype=wp.transform, device=device)
        self._rng = wp.empty(1, dtype=wp.uint32, device=device)
        wp.launch(init_rng_kernel, dim=1, inputs=[seed], outputs=[self._rng], device=device)

    def make(self, depth: np.ndarray) -> tuple[wp.array, wp.array]:
        """Make the cloud of an image.

        Args:
            depth: Depth along the optical axis [m], 0 for none, shape [H, W].

        Returns:
            Points in the frame of the hand's base [m], NaN beyond the count, shape [1, K]; the count, [1].

        Raises:
            ValueError: The image has another size than the camera.
        """
        if depth.shape != self.depth.shape[1:]:
            raise ValueError(
                f"the image has shape {depth.shape}, the camera {self.depth.shape[1:]}; "
                "resample it, or read the camera's size and focal length into the hand's USD"
            )
        self.depth.assign(np.asarray(depth, dtype=np.float32)[None])
        self.cloud.make(self.depth, self._views, self._camera_q, self._extrinsics, self._rng)
        wp.launch(next_frame_kernel, dim=1, inputs=[self._rng], device=self._rng.device)
        return self.cloud.points, self.cloud.count
