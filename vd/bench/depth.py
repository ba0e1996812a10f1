"""``vd-bench depth``: depth images and clouds per second.

Hands in random poses around the reset, a different object in each block of environments near the
table. Rates count images, each with the placing of meshes.
"""

from typing import Any

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

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


def captured(function: Any, device: str) -> Any:
    """``function`` as the launch of one graph."""
    with wp.ScopedCapture(device=device) as capture:
        function()
    return lambda: wp.capture_launch(capture.graph)


def bench_scene(
    objects: list[ObjectModel],
    envs: int,
    hand: str,
    device: str,
    seed: int,
    *,
    visuals: bool = False,
) -> tuple[Scene, Any]:
    """A scene, and a Newton state with random poses; of few environments fewer objects."""
    scene = build_scene(
        hand=load_hand(hand),
        objects=objects[:envs],
        num_envs=envs,
        cfg=SimCfg(),
        device=device,
        visuals=visuals,
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
    state.joint_q.assign(
        np.concatenate([joints, position, quat], axis=1).astype(np.float32).ravel()
    )
    newton.eval_fk(scene.model, state.joint_q, state.joint_qd, state)


def rate(envs: int, function: Any, device: str) -> float:
    """Images per second of a function that takes one in every world; waits for the device."""
    function()
    once = seconds_per_call(function, 1, device)
    calls = max(1, min(100, round(LEAST_TIME_S / once)))
    return envs / seconds_per_call(function, calls, device)


def measure(
    objects: list[ObjectModel], envs: int, device: str, *, hand: str, seed: int
) -> dict[str, Any]:
    """Images per second of so many environments.

    Returns:
        ``envs``; ``images``: depth alone; ``clouds``: with a cloud of each image; ``points`` of a
        cloud, mean over environments.
    """
    scene, state = bench_scene(objects, envs, hand, device, seed)
    body_q = state.body_q.reshape((envs, -1))
    row: dict[str, Any] = {"envs": envs}
    for name, cfg in (("images", DepthCameraCfg(points=0)), ("clouds", DepthCameraCfg())):
        ours = DepthCamera.of_scene(scene, body_q, cfg)
        ours.capture()
        row[name] = rate(envs, captured(ours.capture, device), device)
    return row | {"points": float(ours.count.numpy().mean())}
