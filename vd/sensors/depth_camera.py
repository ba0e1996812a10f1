"""A depth camera in every world: image and cloud from the simulator's poses, on its device.

World frame: z up, table top at z = 0. The optical frame has x right, y down, z forward. Depth is
measured along the optical axis [m]; 0 means no value: nothing within the camera's range, or lost by
the sensor, as real depth cameras report it. Quaternions are xyzw.
"""

import math
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CameraModel, compose
from vd.kernels.launch import count_kernel, launch
from vd.kernels.rng import init_rng_kernel
from vd.kernels.sensor.depth_cloud import next_frame_kernel
from vd.kernels.sensor.depth_sensor import (
    DepthSensorParams,
    delay_poses_kernel,
    forget_poses_kernel,
    measure_depth_kernel,
)
from vd.kernels.sensor.raycast import (
    NO_HIT,
    cast_rays_kernel,
    finish_depth_kernel,
    place_camera_kernel,
    place_meshes_kernel,
)
from vd.paper import PAPER
from vd.sensors.cfg import BASELINE_M, FOCAL_PX, DepthCameraCfg, DepthSensorCfg
from vd.sensors.depth_cloud import DepthCloud, make_views
from vd.sensors.surfaces import SurfaceSet, scene_surfaces
from vd.sim.scene import Scene

WARP_LANES = 32
"""Threads that share a tile or a row of pixels on a GPU. The CPU runs one after the other
anyway.
"""


class DepthCamera:
    """N depth cameras of H x W pixels, one a world, over S shapes and a table.

    ``capture()`` launches kernels only, so that it can be part of a CUDA graph; results lie in
    ``depth``, ``points`` and ``count``. Extrinsics, intrinsics, sensor and latency are arrays with
    one entry a world and may be changed between captures.
    """

    def __init__(
        self,
        surfaces: SurfaceSet,
        camera: CameraModel,
        body_q: wp.array,
        *,
        cfg: DepthCameraCfg | None = None,
        camera_body: int = -1,
        frame_s: float = 1.0 / PAPER.scene.control_hz,
        seed: int = 0,
    ):
        """Allocate images and clouds.

        Args:
            surfaces: What can be seen.
            camera: The camera before it is randomised; its pose is in the frame of ``camera_body``.
            body_q: Body poses in the world frame, shape [N, B]; read at each capture.
            cfg: Settings.
            camera_body: Body that carries the cameras, an index within a world; -1 for the world.
            frame_s: Time between captures [s], to which latencies relate.
            seed: Of viewpoints, latencies and sensor errors.

        Raises:
            ValueError: For a setting that cannot work, naming field and remedy.
        """
        self.cfg = cfg = cfg or DepthCameraCfg()
        cfg.validate()
        self.camera = camera
        self.surfaces = surfaces
        self.body_q = body_q
        self.device = device = str(body_q.device)
        self.num_envs = n = surfaces.num_envs
        self._camera_body = camera_body
        self.height = camera.height
        self.width = camera.width
        self._cloud = cloud = DepthCloud(
            camera.height, camera.width, n, points=cfg.points, crop_m=cfg.crop_m, device=device
        )
        self.points = cloud.points
        """Points within the crop, in the frame of the camera's body (the hand's base) [m], shape
        [N, K]. Rows beyond ``count`` are NaN, which the voxels ignore."""
        self.count = cloud.count
        """Points of each cloud, shape [N]."""
        self.available = cloud.available
        """Pixels within the crop, of which the points were chosen, shape [N]."""
        shapes = surfaces.num_shapes
        image = (camera.height, camera.width)
        self._table = _table_box()
        self._lanes = 1 if device == "cpu" else WARP_LANES
        generator = np.random.default_rng(seed)

        def empty(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        generator.standard_normal(n)  # keeps the viewpoints that a seed has had
        self.views = make_views(camera, n, device)
        """Focal lengths, principal point [pixel] and range [m] of each camera, shape [N]."""
        believed = camera_places(camera, n, cfg.place_range, np.random.default_rng([seed, 1]))
        self.extrinsics = wp.array(
            _extrinsics(believed, generator, cfg), dtype=wp.transform, device=device
        )
        """Optical frame of each camera in the frame of the body that carries it, shape [N]."""
        self._believed = self._as_believed(believed)
        self.sensors = wp.array(
            [_sensor(cfg.sensor, camera)] * n, dtype=DepthSensorParams, device=device
        )
        """Sensor settings of each camera; used if any was on at the start, shape [N]."""
        delay = generator.uniform(*cfg.latency_s, size=n) / frame_s
        self.delay = wp.array(delay, dtype=float, device=device)
        """Age of each camera's images [frame], shape [N]; at most that of ``cfg.latency_s``."""
        self.table = wp.ones(n, dtype=wp.int32, device=device)
        """Whether each world's table is there, shape [N]."""
        self.camera_q = empty(n, dtype=wp.transform)
        """Optical frames in the world frame at the last capture, shape [N]."""
        self._believed_q = (
            self.camera_q if self._believed is self.extrinsics else empty(n, dtype=wp.transform)
        )
        self.true_depth = empty(n, *image)
        """Depth without sensor errors [m], shape [N, H, W]."""
        self.depth = empty(n, *image) if cfg.sensor.enabled else self.true_depth
        """Measured depth [m], 0 for none; the same array as ``true_depth`` if the sensor is
        perfect.
        """
        self.rng = wp.empty(n, dtype=wp.uint32, device=device)
        """Random state of each world, shape [N]."""
        launch(init_rng_kernel, n, [seed], [self.rng])

        self._rotation = empty(n, shapes, dtype=wp.mat33)
        self._position = empty(n, shapes, dtype=wp.vec3)
        self._depth_bits = self.true_depth.view(wp.int32)
        self._history: wp.array | None = None
        if cfg.latency_s[1] > 0.0:
            self._remember_poses(math.ceil(cfg.latency_s[1] / frame_s) + 1)

    def _as_believed(self, places: np.ndarray) -> wp.array:
        """Extrinsics as calibrated [N]: places before noise [N, 7]; without noise the same array."""
        if not (self.cfg.position_noise_m > 0.0 or self.cfg.rotation_noise_rad > 0.0):
            return self.extrinsics
        return wp.array(places, dtype=wp.transform, device=self.device)

    def _remember_poses(self, slots: int) -> None:
        """Allocate the body poses of the last ``slots`` frames, of which late images are made."""
        self._frame = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._late_q = wp.clone(self.body_q)
        shape = (slots, *self.body_q.shape)
        self._history = wp.zeros(shape, dtype=wp.transform, device=self.device)
        self.reset()

    @classmethod
    def of_scene(
        cls,
        scene: Scene,
        body_q: wp.array,
        cfg: DepthCameraCfg | None = None,
        camera: CameraModel | None = None,
        **settings: Any,
    ) -> "DepthCamera":
        """The camera of the hand's USD, or another on its base, in every world of a scene.

        The rest is as for the class; the scene's model needs no visual shapes.
        """
        body = int(scene.link_body[0])
        camera = camera or scene.hand.camera
        return cls(scene_surfaces(scene), camera, body_q, cfg=cfg, camera_body=body, **settings)

    def reset(self, mask: wp.array | None = None) -> None:
        """Forget the past of worlds, so that no late image shows what was before their reset.

        Args:
            mask: 1 where a world was reset, shape [N] int32; all by default.
        """
        if self._history is None:
            return
        if mask is None:
            mask = wp.ones(self.num_envs, dtype=wp.int32, device=self.device)
        launch(forget_poses_kernel, self.body_q.shape, [mask, self.body_q], [self._history])

    def stateful(self) -> dict[str, wp.array]:
        """What another camera of the same settings and seed needs to go on as this one would."""
        state = {
            "rng": self.rng,
            "extrinsics": self.extrinsics,
            "delay": self.delay,
            "table": self.table,
        }
        if self._history is not None:
            state |= {"history": self._history, "frame": self._frame}
        return state

    def capture(self) -> None:
        """Take an image in every world and make its cloud. Launches only.

        Nothing reaches the host.
        """
        n = self.num_envs
        surfaces = self.surfaces
        body_q = self._late_poses()
        launch(
            place_camera_kernel, n, [self._camera_body, self.extrinsics, body_q], [self.camera_q]
        )
        launch(
            place_meshes_kernel,
            self._rotation.shape,
            [surfaces.shape_body, self.camera_q, body_q],
            [self._rotation, self._position],
        )
        self.true_depth.fill_(NO_HIT)
        launch(
            cast_rays_kernel,
            (n, len(surfaces.slot_shape)),
            [
                self.views,
                surfaces.points,
                surfaces.triangles,
                surfaces.mesh_first,
                surfaces.slot_shape,
                surfaces.slot_index,
                surfaces.shape_mesh,
                surfaces.shape_scale,
                self._rotation,
                self._position,
            ],
            [self._depth_bits],
        )
        launch(
            finish_depth_kernel,
            (n, self.height, self._lanes),
            [self.views, *self._table, self._lanes, self.table, self.camera_q],
            [self.true_depth],
        )
        if self.depth is not self.true_depth:
            launch(
                measure_depth_kernel,
                self.depth.shape,
                [self.sensors, self.true_depth, self.rng],
                [self.depth],
            )
        if self.cfg.points:
            if self._believed is not self.extrinsics:
                believed = [self._camera_body, self._believed, body_q]
                launch(place_camera_kernel, n, believed, [self._believed_q])
            self._cloud.make(self.depth, self.views, self._believed_q, self._believed, self.rng)
        launch(next_frame_kernel, n, [], [self.rng])

    def _late_poses(self) -> wp.array:
        """Body poses that this capture shows."""
        if self._history is None:
            return self.body_q
        launch(
            delay_poses_kernel,
            self.body_q.shape,
            [self._frame, self.delay, self.body_q],
            [self._history, self._late_q],
        )
        launch(count_kernel, 1, [], [self._frame])
        return self._late_q


def _table_box() -> tuple[wp.vec3, wp.vec3]:
    """Lower and upper corner of the paper's table in the world frame [m]."""
    x, y, z = PAPER.scene.table_size_m
    top = PAPER.scene.table_top_m
    return wp.vec3(-0.5 * x, -0.5 * y, top - z), wp.vec3(0.5 * x, 0.5 * y, top)


def camera_places(
    camera: CameraModel, count: int, most: tuple[float, float], generator: np.random.Generator
) -> np.ndarray:
    """Poses of cameras about a given one, in the base frame [count, 7].

    Args:
        camera: The given one.
        count: How many.
        most: Up to how far along [m], and turned about [rad], each of its axes, evenly.
        generator: What draws.
    """
    moved = generator.uniform(-1.0, 1.0, (2, count, 3))
    turn = Rotation.from_rotvec(most[1] * moved[1])
    change = np.concatenate([most[0] * moved[0], turn.as_quat()], axis=1)
    return compose(np.concatenate([camera.position, camera.quaternion]), change)


def _extrinsics(
    believed: np.ndarray, generator: np.random.Generator, cfg: DepthCameraCfg
) -> np.ndarray:
    """Poses of the optical frames [N, 7], the turn about the camera's own axes."""
    shape = len(believed), 3
    turn = Rotation.from_rotvec(cfg.rotation_noise_rad * generator.standard_normal(shape))
    position = believed[:, :3] + cfg.position_noise_m * generator.standard_normal(shape)
    orientation = Rotation.from_quat(believed[:, 3:]) * turn
    return np.concatenate([position, orientation.as_quat()], axis=1)


def _sensor(cfg: DepthSensorCfg, camera: CameraModel) -> DepthSensorParams:
    params = DepthSensorParams()
    params.depth_disparity = FOCAL_PX * BASELINE_M
    params.disparity_std = cfg.disparity_std_px
    params.disparity_step = cfg.disparity_step_px
    params.shadow = camera.fx * BASELINE_M if cfg.shadow else 0.0
    params.edge_jump = cfg.edge_jump_m if cfg.uses_edges else 0.0
    params.edge_dropout = cfg.edge_dropout
    params.flying = cfg.flying
    params.dropout = cfg.dropout
    params.min_range = cfg.min_range_m
    params.max_range = camera.far
    return params
