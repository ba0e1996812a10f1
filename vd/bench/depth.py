"""``vd-bench depth``: depth images and clouds per second, beside Newton's camera on the same scene.

Hands of 16 links in random poses around the reset, a different object in each block of environments near the
table. Rates count images, each from new poses: Newton's include the refit of its hierarchies, which moving
bodies need, ours the placing of meshes. That both show the same is a matter of tests.
"""

from typing import Any

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CameraModel
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.model import ObjectModel
from vd.bench.sim import seconds_per_call
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sim.cfg import SimCfg
from vd.sim.scene import Scene, build_scene

JOINT_SPREAD_RAD = 0.3
"""Standard deviation of the joints around the reset: fingers around, over and beside the object."""
OBJECT_HEIGHT_M = 0.05
"""Height of the objects' centres: about that of an object on the table."""
OBJECT_SPREAD_M = 0.01
"""Standard deviation of the objects' positions, along each axis."""
LEAST_TIME_S = 1.0
"""Each rate is the mean over about this time, after a warm-up."""

NEWTON_FROM_OPTICAL = Rotation.from_euler("x", 180, degrees=True)
"""Newton's cameras look along -z with +y up; the optical frame along +z with +y down."""


def captured(function: Any, device: str) -> Any:
    """``function`` as the launch of one graph."""
    with wp.ScopedCapture(device=device) as capture:
        function()
    return lambda: wp.capture_launch(capture.graph)


def bench_scene(
    objects: list[ObjectModel], envs: int, hand: str, device: str, seed: int
) -> tuple[Scene, Any]:
    """A scene with visual shapes, and a Newton state with random poses; of few environments fewer objects."""
    scene = build_scene(
        hand=load_hand(hand),
        objects=objects[:envs],
        num_envs=envs,
        cfg=SimCfg(),
        device=device,
        visuals=True,
    )
    state = scene.model.state()
    pose(scene, state, np.random.default_rng(seed))
    return scene, state


def pose(scene: Scene, state: Any, generator: np.random.Generator) -> None:
    """Give every world of a state random joints and a random pose of its object."""
    n, d = scene.num_envs, scene.hand.num_joints
    joints = scene.hand.start + JOINT_SPREAD_RAD * generator.standard_normal((n, d))
    position = OBJECT_SPREAD_M * generator.standard_normal((n, 3)) + [0.0, 0.0, OBJECT_HEIGHT_M]
    quat = Rotation.random(n, random_state=generator).as_quat()
    joints = np.clip(joints, scene.hand.lower, scene.hand.upper)
    state.joint_q.assign(np.concatenate([joints, position, quat], axis=1).astype(np.float32).ravel())
    newton.eval_fk(scene.model, state.joint_q, state.joint_qd, state)


class NewtonCamera:
    """Newton's ray-traced camera with the hand's viewpoint in every world, forward depth only."""

    def __init__(self, scene: Scene, camera_q: np.ndarray):
        """Prepare rays and image, for optical frames in the world frame, shape [N, 7]."""
        self.model, camera = scene.model, scene.hand.camera
        device = self.model.device
        self.sensor = SensorCamera(self.model, load_textures=False)
        self.rays = newton_rays(camera, str(device))
        turned = (Rotation.from_quat(camera_q[:, 3:]) * NEWTON_FROM_OPTICAL).as_quat()
        poses = np.concatenate([camera_q[:, :3], turned], axis=1).astype(np.float32)
        self.poses = wp.array(poses, dtype=wp.transformf, device=device)
        self.depth = self.sensor.allocate_image_depth_forward(len(poses), camera.width, camera.height)

    def refit(self, state: Any) -> None:
        """Follow the bodies with the hierarchies."""
        self.model.bvh_refit_shapes(state)

    def render(self, state: Any) -> None:
        """Draw, without a refit."""
        self.sensor.update(state, self.poses, self.rays, forward_depth_image=self.depth)


def newton_rays(camera: CameraModel, device: str) -> wp.array:
    """Rays of a camera with a centred principal point, in Newton's form."""
    return SensorCamera.compute_camera_rays_pinhole(
        camera.width,
        camera.height,
        focal_length=camera.fx,
        horizontal_aperture=float(camera.width),
        vertical_aperture=camera.height * camera.fx / camera.fy,
        device=device,
    )


def rate(envs: int, function: Any, device: str) -> float:
    """Images per second of a function that takes one in every world; waits for the device."""
    function()
    once = seconds_per_call(function, 1, device)
    calls = max(1, min(100, round(LEAST_TIME_S / once)))
    return envs / seconds_per_call(function, calls, device)


def measure(objects: list[ObjectModel], envs: int, device: str, *, hand: str, seed: int) -> dict[str, Any]:
    """Images per second of so many environments.

    Returns:
        ``envs``; ``newton``: of Newton's ``SensorCamera``, forward depth only; ``images``: ours, depth alone;
        ``clouds``: ours with a cloud of each image; ``points`` of a cloud, mean over environments.
    """
    scene, state = bench_scene(objects, envs, hand, device, seed)
    body_q = state.body_q.reshape((envs, -1))
    row: dict[str, Any] = {"envs": envs}
    for name, cfg in (("images", DepthCameraCfg(points=0)), ("clouds", DepthCameraCfg())):
        ours = DepthCamera.of_scene(scene, body_q, cfg)
        ours.capture()
        row[name] = rate(envs, captured(ours.capture, device), device)
    row["points"] = float(ours.count.numpy().mean())
    theirs = NewtonCamera(scene, ours.camera_q.numpy())

    def frame() -> None:
        theirs.refit(state)
        theirs.render(state)

    return row | {"newton": rate(envs, frame, device)}
