"""``vd-bench student``: a camera policy's latency on a robot's computer.

It is that of a whole control step, batch 1, on the CPU: depth image and joint positions to action.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.assets_usd.hand_data import BASE_IN_WORLD
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.model import ObjectModel
from vd.bench.depth import bench_scene
from vd.clouds import HandKinematics, SceneClouds
from vd.evaluate.agents import open_policy
from vd.senses import Senses
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sensors.depth_cloud import CameraCloud
from vd.sim.scene import Scene
from vd.tracking.policy import TrackingPolicy
from vd.tracking.tracker import Tracker
from vd.vision.cfg import PRESETS
from vd.vision.network import Student
from vd.vision.saved import SavedStudent
from vd.vision.voxels import Voxeliser

Parts = dict[str, Callable[[], None]]
"""Parts of a control step, in order."""
WARM_UP = 5
"""Calls before timing: allocators have grown, kernels are loaded."""


@dataclass(frozen=True)
class LatencyRow:
    """One control step of one policy on the CPU."""

    network: str
    """Preset, or the policy."""
    parameters: int
    """Numbers in the network."""
    threads: int
    """Threads of torch; our kernels use one."""
    median_ms: float
    """Depth image and joint positions to action."""
    p99_ms: float
    """The same, the 99th percentile."""
    cpu_ms: float
    """The same, processor time of all threads, median: other programs on the machine do not lengthen it."""
    parts_ms: dict[str, float]
    """Medians of its parts."""
    parts_cpu_ms: dict[str, float]
    """The same, processor time of all threads."""


def take_turns(functions: dict[str, Callable[[], Any]], calls: int) -> dict[str, np.ndarray]:
    """Wall and processor time [ms] of ``calls`` calls of each function, called in turn; each [calls, 2]."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in functions}
    for call in range(calls + WARM_UP):
        for name, function in functions.items():
            wall, busy = time.perf_counter(), time.process_time()
            function()
            if call >= WARM_UP:
                times[name].append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - busy)))
    return {name: np.array(values) for name, values in times.items()}


class StudentStep:
    """What a robot's computer does for a student in a control step, from image and joints to an action."""

    def __init__(self, net: Student, scene: Scene, image: np.ndarray, joint_q: np.ndarray):
        links, self._image, self._net = np.arange(len(scene.hand.link_names)), image, net
        self._camera = CameraCloud(scene.hand.camera)
        self._joint_q = wp.array(joint_q[None], dtype=float, device="cpu")
        self._kinematics = HandKinematics(scene.hand, link_body=links, base=BASE_IN_WORLD, device="cpu")
        self._body_q = wp.zeros((1, len(links) + 1), dtype=wp.transform, device="cpu")
        self._goal = wp.array([[0.0, 0.0, 0.0, 1.0]], dtype=wp.quat, device="cpu")
        self._clouds = SceneClouds(
            scene.hand,
            scene.objects,
            link_body=links,
            object_body=len(links),
            world_object=scene.world_object,
            world_scale=scene.world_scale,
            device="cpu",
        )
        size = self._clouds.item.start + self._camera.cloud.points.shape[1]
        self._points = wp.empty((1, size), dtype=wp.vec3, device="cpu")
        self._marks = self._clouds.ends if net.cfg.marked else ()
        self._voxelise = Voxeliser(net.cfg.voxel_m)
        self._known, self._hidden = torch.zeros(1, net.num_proprioception), net.initial_hidden(1)
        self.parts: Parts = {"points": self._see, "voxels": self._cells, "maps and network": self._act}

    def _see(self) -> None:
        points, _ = self._camera.make(self._image)
        wp.copy(self._points[:, self._clouds.item.start :], points)
        self._kinematics.write(self._joint_q, self._body_q)
        self._clouds.write(self._points, self._body_q, self._goal, with_object=False)

    def _cells(self) -> None:
        self._sites = self._voxelise(self._points, ends=self._marks)

    def _act(self) -> None:
        self._hidden = self._net.act(self._sites, self._known, self._hidden).hidden


class TrackingStep:
    """The same for a tracking policy."""

    def __init__(self, policy: TrackingPolicy, scene: Scene, image: np.ndarray, joint_q: np.ndarray):
        camera, depth = scene.hand.camera.at(policy.spec.camera), policy.spec.depth
        self._image, self._fresh = image, torch.ones(1, dtype=torch.bool)
        self._camera = CameraCloud(camera, points=depth.points, crop_m=depth.crop_m)
        self._tracker = Tracker(policy, scene.hand, scene.objects, camera)
        self._joint_q = torch.tensor(joint_q, dtype=torch.float32)[None]
        self.parts: Parts = {"points": self._see, "object and action": self._act}

    def _see(self) -> None:
        self._points = wp.to_torch(self._camera.make(self._image)[0])

    def _act(self) -> None:
        q = self._joint_q
        still, goal = torch.zeros_like(q), torch.tensor([[0.0, 0.0, 0.0, 1.0]])
        senses = Senses(q, still, still, goal, self._points, fresh=self._fresh)
        self._tracker.step(senses)
        self._fresh.fill_(False)


def open_network(name: str, hand: str) -> tuple[Student | TrackingPolicy, str]:
    """A preset for a hand, with random weights; or a camera policy, installed or in a file, and its own hand.

    Raises:
        FileNotFoundError: There is neither.
        ValueError: It sees no clouds.
    """
    if name in PRESETS:
        return Student(PRESETS[name], load_hand(hand).num_joints).eval(), hand
    saved = open_policy(name, "cpu")
    if isinstance(saved, TrackingPolicy):
        return saved, saved.hand
    if not isinstance(saved, SavedStudent):
        raise ValueError(f"--networks {name}: a teacher has no clouds; give a preset or a camera policy")
    return saved.network.eval(), str(saved.task["hand"])


def measure_latency(
    objects: list[ObjectModel],
    network: str,
    *,
    hand: str = "dclaw4",
    threads: int = 2,
    calls: int = 300,
    seed: int = 0,
) -> LatencyRow:
    """Measure one policy on the CPU.

    Args:
        objects: The first of them lies on the table.
        network: Preset, or a camera policy: the name of an installed one or a file.
        hand: Hand of a preset; a policy has its own.
        threads: Threads of torch.
        calls: Control steps to time.
        seed: Of poses and weights.
    """
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    policy, hand = open_network(network, hand)
    scene, state = bench_scene(objects, 1, hand, "cpu", seed)
    camera = DepthCamera.of_scene(scene, state.body_q.reshape((1, -1)), DepthCameraCfg(points=0))
    camera.capture()
    image, joint_q = camera.depth.numpy()[0], state.joint_q.numpy()[: scene.hand.num_joints]
    step: StudentStep | TrackingStep
    if isinstance(policy, TrackingPolicy):
        net: torch.nn.Module = policy.teacher.network
        step = TrackingStep(policy, scene, image, joint_q)
    else:
        net = policy
        step = StudentStep(policy, scene, image, joint_q)

    def whole() -> None:
        for part in step.parts.values():
            part()

    with torch.inference_mode():
        whole()
        parts = take_turns(step.parts, calls)
        times = take_turns({"whole": whole}, calls)["whole"]
    return LatencyRow(
        network=network,
        parameters=sum(parameter.numel() for parameter in net.parameters()),
        threads=threads,
        median_ms=float(np.median(times[:, 0])),
        p99_ms=float(np.percentile(times[:, 0], 99)),
        cpu_ms=float(np.median(times[:, 1])),
        parts_ms={name: float(np.median(part[:, 0])) for name, part in parts.items()},
        parts_cpu_ms={name: float(np.median(part[:, 1])) for name, part in parts.items()},
    )
