"""Point clouds from depth images: those of simulated cameras, or of a real one."""

import math

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import CameraModel, compose
from vd.kernels.launch import launch
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


def make_views(camera: CameraModel, count: int, device: str) -> wp.array:
    """The intrinsics of so many equal cameras."""
    view = View()
    view.fx = camera.fx
    view.fy = camera.fy
    view.cx = camera.cx
    view.cy = camera.cy
    view.near = camera.near
    view.far = camera.far
    return wp.array([view] * count, dtype=View, device=device)


class DepthCloud:
    """Crops N depth images by height over the table, and chooses K points of each in the base."""

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
        """Allocate N clouds of at most K ``points``, of world heights within ``crop_m`` [m]."""
        self.crop_m = crop_m
        self._tile_rows = math.ceil(height / int(TILE_ROWS))
        self._tile_columns = math.ceil(width / int(TILE_COLUMNS))
        tiles = self._tile_rows * self._tile_columns

        def empty(*shape: int, dtype: type = int) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.points = empty(num_envs, points, dtype=wp.vec3)
        """Points in the frame of the camera's body (the base) [m], NaN beyond ``count``, shape [N,
        K].
        """
        self.count = empty(num_envs)
        """Points of each cloud, shape [N]."""
        self.available = empty(num_envs)
        """Pixels within the crop, of which the points were chosen, shape [N]."""
        self._tile_pixels = empty(num_envs, tiles, dtype=wp.uint32)
        self._tile_first = empty(num_envs, tiles)
        self._row_count, self._row_first = (empty(num_envs, self._tile_rows) for _ in range(2))

    def make(
        self,
        depth: wp.array,
        views: wp.array,
        camera_q: wp.array,
        extrinsics: wp.array,
        rng: wp.array,
    ) -> None:
        """Make the clouds of images. Launches only.

        Args:
            depth: Depth along the optical axis [m], 0 for none, shape [N, H, W].
            views: Intrinsics, shape [N].
            camera_q: Optical frames in the world frame, shape [N].
            extrinsics: Optical frames in the frame in which the points are wanted, shape [N].
            rng: Random state of each world, shape [N]; not advanced.
        """
        marked = [self._tile_pixels, self._tile_first]
        launch(
            crop_pixels_kernel,
            self._row_count.shape,
            [views, *self.crop_m, self._tile_columns, camera_q, depth],
            [*marked, self._row_count],
        )
        launch(
            count_points_kernel,
            len(self.count),
            [self.points.shape[1], self._row_count],
            [self._row_first, self.available, self.count],
        )
        launch(
            choose_points_kernel,
            self.points.shape,
            [
                views,
                self._tile_columns,
                extrinsics,
                rng,
                depth,
                *marked,
                self._row_first,
                self.available,
            ],
            [self.points],
        )


class CameraCloud:
    """The cloud of one real camera's images, by the kernels that make those of simulated ones."""

    def __init__(
        self,
        camera: CameraModel,
        mount: np.ndarray,
        *,
        points: int = PAPER.camera.points,
        crop_m: tuple[float, float] = PAPER.camera.crop_m,
        device: str = "cpu",
        seed: int = 0,
    ):
        """Prepare a cloud of at most K ``points`` within heights ``crop_m`` [m].

        ``seed`` is of their choice.

        The camera's pose is that in the hand's base, whose own in the world is ``mount`` [7].
        """
        self.cloud = DepthCloud(
            camera.height, camera.width, 1, points=points, crop_m=crop_m, device=device
        )
        self.depth = wp.zeros((1, camera.height, camera.width), dtype=float, device=device)
        """The image [m], 0 for none, shape [1, H, W]."""
        self._views = make_views(camera, 1, device)
        extrinsics = np.concatenate([camera.position, camera.quaternion])
        in_world = compose(mount, extrinsics)
        self._extrinsics = wp.array(extrinsics[None], dtype=wp.transform, device=device)
        self._camera_q = wp.array(in_world[None], dtype=wp.transform, device=device)
        self._rng = wp.empty(1, dtype=wp.uint32, device=device)
        launch(init_rng_kernel, 1, [seed], [self._rng])

    def seen(self, depth: np.ndarray) -> wp.array:
        """The points of an image as :class:`vd.policy.senses.Senses` has them [1, K].

        The next call changes them.

        Args:
            depth: Depth along the optical axis [m], 0 for none, shape [H, W].

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
        launch(next_frame_kernel, 1, [], [self._rng])
        points = self.cloud.points
        if not self.cloud.count.numpy()[0]:  # the false point of an empty cloud counts for nothing
            points.fill_(math.nan)
        return points
