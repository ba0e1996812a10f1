"""``vd-bench student``: the student's latency on a robot's computer, and clouds per second in training.

Latency is that of a whole control step, batch 1, on the CPU: depth image and joint positions to action.
Its encoder is timed beside dense convolutions, and spconv's if installed, on the same voxels; the three
take turns, so that whatever else the machine does slows all alike. Training is one minibatch of whole
sequences: points, voxels, maps, forward and backward; simulation and optimiser are not in it.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.model import ObjectModel
from vd.bench.depth import JOINT_SPREAD_RAD, OBJECT_HEIGHT_M, bench_scene
from vd.bench.student_twins import DenseEncoder, SpconvEncoder, scattered
from vd.evaluate.agents import open_policy
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sensors.depth_cloud import CameraCloud
from vd.sim.scene import hand_mount
from vd.student.cfg import PRESETS, NoiseCfg
from vd.student.clouds import HandKinematics, SceneClouds, Voxeliser
from vd.student.network import Student
from vd.student.object_sense import ObjectSense
from vd.student.saved import SavedStudent
from vd.student.sites import Sites

WARM_UP = 5
"""Calls before timing: allocators have grown, kernels are loaded."""
SEQUENCE_STEPS = 80
"""Steps of a training sequence: the paper's."""


@dataclass(frozen=True)
class LatencyRow:
    """One control step of one network on the CPU."""

    network: str
    """Preset, or the student."""
    parameters: int
    """Numbers in the network."""
    precision: str
    """Of the encoder: float32 or bfloat16."""
    threads: int
    """Threads of torch; our kernels use one."""
    points: int
    """Points of the cloud: goal, hand, camera."""
    voxels: int
    """Occupied voxels."""
    sites: tuple[int, ...]
    """Occupied cells of each coarser level."""
    median_ms: float = 0.0
    """Depth image and joint positions to action."""
    p99_ms: float = 0.0
    """The same, the 99th percentile."""
    cpu_ms: float = 0.0
    """The same, processor time of all threads, median: other programs on the machine do not lengthen it."""
    parts_ms: dict[str, float] = field(default_factory=dict)
    """Medians of its parts."""
    parts_cpu_ms: dict[str, float] = field(default_factory=dict)
    """The same, processor time of all threads."""
    encoder_ms: dict[str, float] = field(default_factory=dict)
    """Voxels to pooled features, maps included: ours, the others of ``student_twins``; medians."""
    encoder_cpu_ms: dict[str, float] = field(default_factory=dict)
    """The same, processor time of all threads."""
    missing: str = ""
    """What could not be measured, and why."""


@dataclass(frozen=True)
class TrainingRow:
    """One minibatch of sequences, and one step of as many worlds."""

    network: str
    """Preset."""
    precision: str
    """Of the products: float32 or bfloat16."""
    clouds: int
    """Clouds of the minibatch."""
    voxels: float
    """Voxels of a cloud, mean."""
    clouds_per_s: float
    """Points, voxels, maps, forward and backward."""
    parts_ms: dict[str, float]
    """Its parts."""
    act_clouds_per_s: float
    """The same number of worlds acting one step: points, voxels, maps, forward."""
    memory_gb: float
    """Most memory that torch held at once [GB]; 0 on the CPU, not measured."""


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


class ControlStep:
    """What a robot's computer does in a control step, from a depth image and joint positions to an action."""

    def __init__(self, objects: list[ObjectModel], hand_name: str, net: Student, seed: int):
        """Render the depth image of a scene, and prepare everything that does not change."""
        scene, state = bench_scene(objects, 1, hand_name, "cpu", seed)
        body_q = state.body_q.reshape((1, -1))
        camera = DepthCamera.of_scene(scene, body_q, DepthCameraCfg(points=0))
        camera.capture()
        self.image = camera.depth.numpy()[0]
        self.camera = CameraCloud(scene.hand.camera)
        self.net = net
        self.joint_q = wp.zeros((1, scene.hand.num_joints), dtype=float, device="cpu")
        self.measured_q = state.joint_q.numpy()[None, : scene.hand.num_joints].copy()
        base = body_q.numpy()[0, scene.link_body[0]]
        self.kinematics = HandKinematics(scene.hand, link_body=scene.link_body, base=base, device="cpu")
        self.body_q = wp.zeros((1, scene.bodies_per_world), dtype=wp.transform, device="cpu")
        self.goal = wp.array([[0.0, 0.0, 0.0, 1.0]], dtype=wp.quat, device="cpu")
        worlds: dict[str, Any] = {
            "link_body": scene.link_body,
            "world_object": scene.world_object,
            "world_scale": scene.world_scale,
            "device": "cpu",
        }
        self.clouds = SceneClouds(scene.hand, scene.objects, object_body=scene.object_body, **worlds)
        self.sense: ObjectSense | None = None
        if "object" in net.cfg.senses:
            self.sense = ObjectSense(
                scene.hand,
                scene.objects,
                camera=scene.hand.camera,
                voxel_m=net.cfg.voxel_m,
                aim=net.cfg.aim,
                **worlds,
            )
        self.fresh = torch.ones(1, dtype=torch.bool)
        size = self.clouds.item.start + self.camera.cloud.points.shape[1]
        self.points = wp.empty((1, size), dtype=wp.vec3, device="cpu")
        self.voxelise = Voxeliser(net.cfg.voxel_m)
        self.senses = torch.zeros(1, net.num_senses)
        self.hidden = net.initial_hidden(1)
        self.sites: Sites | None = None

    def camera_points(self) -> None:
        """Depth image to points."""
        points, _ = self.camera.make(self.image)
        wp.copy(self.points[:, self.clouds.item.start :], points)

    def model_points(self) -> None:
        """Joint positions to the points of hand and goal."""
        self.joint_q.assign(self.measured_q)
        self.kinematics.write(self.joint_q, self.body_q)
        self.clouds.write(self.points, self.body_q, self.goal, with_object=False)

    def voxels(self) -> None:
        """Points to voxels."""
        marked = "marks" in self.net.cfg.encoder.inputs
        self.sites = self.voxelise(self.points, ends=self.clouds.ends if marked else ())

    def find(self) -> None:
        """The object among the voxels, followed from step to step."""
        if self.sense is None:
            return
        assert self.sites is not None
        found = self.sense(
            (self.sites,),
            wp.to_torch(self.body_q),
            wp.to_torch(self.goal),
            fresh=self.fresh,
            points=wp.to_torch(self.points)[:, self.clouds.item.start :],
        )
        self.fresh.fill_(False)
        first = self.net.cfg.senses.index("object") * self.net.num_actions
        self.senses[:, first : first + found.shape[1]] = found

    def act(self) -> np.ndarray:
        """Voxels, previous action and memory to the next action [D]."""
        assert self.sites is not None
        output = self.net.act(self.sites, self.senses, self.hidden)
        action, self.hidden = output.mean.clamp(-1.0, 1.0), output.hidden
        self.senses[:, : self.net.num_actions] = action
        return action.numpy()[0]

    def __call__(self) -> np.ndarray:
        """The whole step."""
        self.camera_points()
        self.model_points()
        self.voxels()
        self.find()
        return self.act()


def open_network(name: str, hand: str) -> tuple[Student, str]:
    """A preset for a hand, with random weights; or a student, installed or in a file, and its own hand.

    Raises:
        FileNotFoundError: There is neither.
        ValueError: It is no student.
    """
    if name in PRESETS:
        return Student(PRESETS[name], load_hand(hand).num_joints).eval(), hand
    saved = open_policy(name, "cpu")
    if not isinstance(saved, SavedStudent):
        raise ValueError(f"--networks {name}: a teacher has no clouds; give a preset or a student")
    return saved.network.eval(), str(saved.task["hand"])


def measure_latency(
    objects: list[ObjectModel],
    network: str,
    *,
    hand: str = "dclaw4",
    threads: int = 2,
    half: bool = False,
    calls: int = 300,
    seed: int = 0,
) -> LatencyRow:
    """Measure one network on the CPU.

    Args:
        objects: The first of them lies on the table.
        network: Preset, or a student: the name of an installed one or a file.
        hand: Hand of a preset; a student has its own.
        threads: Threads of torch.
        half: Encoder in bfloat16; the others it is timed beside stay in float32.
        calls: Control steps to time.
        seed: Of poses and weights.
    """
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    net, hand = open_network(network, hand)
    offsets = scattered(net.encoder)
    if half:
        net.encoder.bfloat16()
    with torch.inference_mode():
        step = ControlStep(objects, hand, net, seed)
        step()
        sites = step.sites
        assert sites is not None
        twins: dict[str, torch.nn.Module] = {"dense": DenseEncoder(net.cfg.encoder).eval()}
        missing = ""
        try:
            twins["spconv"] = SpconvEncoder(net.cfg.encoder).eval()
        except ImportError as error:
            missing = f"spconv is not installed ({error})"
        # Fresh sites each time: their maps are part of the work.
        encoders: dict[str, Callable[[], Any]] = {
            "ours": lambda: net.encoder.pooled(sites.fresh()),
            "per offset": lambda: offsets.pooled(sites.fresh()),
        }
        encoders |= {name: partial(twin, sites) for name, twin in twins.items()}
        beside = take_turns(encoders, max(WARM_UP, calls // 10))
        parts = take_turns(
            {
                "camera points": step.camera_points,
                "hand and goal points": step.model_points,
                "voxels": step.voxels,
                "object": step.find,
                "maps and network": step.act,
            },
            calls,
        )
        whole = take_turns({"whole": step}, calls)["whole"]
    levels, level = [], sites
    for _ in range(len(net.cfg.encoder.channels) + net.cfg.encoder.pooled_stages):
        level = level.coarser
        levels.append(len(level))
    return LatencyRow(
        network=network,
        parameters=sum(parameter.numel() for parameter in net.parameters()),
        precision="bfloat16" if half else "float32",
        threads=threads,
        points=step.points.shape[1],
        voxels=len(sites),
        sites=tuple(levels),
        median_ms=float(np.median(whole[:, 0])),
        p99_ms=float(np.percentile(whole[:, 0], 99)),
        cpu_ms=float(np.median(whole[:, 1])),
        parts_ms={name: float(np.median(times[:, 0])) for name, times in parts.items()},
        parts_cpu_ms={name: float(np.median(times[:, 1])) for name, times in parts.items()},
        encoder_ms={name: float(np.median(times[:, 0])) for name, times in beside.items()},
        encoder_cpu_ms={name: float(np.median(times[:, 1])) for name, times in beside.items()},
        missing=missing,
    )


class Scenes:
    """Complete clouds of random scenes without a simulation, as many as wanted at once."""

    def __init__(self, objects: Sequence[ObjectModel], hand_name: str, clouds: int, device: str, seed: int):
        """Draw the scenes."""
        hand = load_hand(hand_name)
        links = len(hand.link_names)
        generator = np.random.default_rng(seed)
        reset = np.tile(PAPER.scene.reset_joint_rad, hand.num_fingers)
        joints = reset + JOINT_SPREAD_RAD * generator.standard_normal((clouds, hand.num_joints))
        poses = np.zeros((clouds, links + 1, 7), np.float32)
        poses[:, links, 2] = OBJECT_HEIGHT_M
        poses[:, links, 3:] = generator.standard_normal((clouds, 4))
        poses[:, links, 3:] /= np.linalg.norm(poses[:, links, 3:], axis=1, keepdims=True)
        goal = np.roll(poses[:, links, 3:], 1, axis=0)
        self.body_q = wp.array(poses, dtype=wp.transform, device=device)
        self.goal = wp.array(goal, dtype=wp.quat, device=device)
        kinematics = HandKinematics(hand, link_body=np.arange(links), base=hand_mount(), device=device)
        limited = np.clip(joints, hand.lower, hand.upper)
        kinematics.write(wp.array(limited, dtype=float, device=device), self.body_q)
        self.clouds = SceneClouds(
            hand,
            objects,
            link_body=np.arange(links),
            object_body=links,
            world_object=np.arange(clouds) % len(objects),
            world_scale=np.ones(clouds),
            device=device,
        )
        self.points = wp.empty((clouds, self.clouds.item.stop), dtype=wp.vec3, device=device)

    def write(self) -> None:
        """Make the points anew."""
        self.clouds.write(self.points, self.body_q, self.goal)


def measure_training(
    objects: Sequence[ObjectModel],
    network: str,
    device: str,
    *,
    hand: str = "dclaw4",
    worlds: int = 40,
    steps: int = SEQUENCE_STEPS,
    half: bool = True,
    calls: int = 5,
    seed: int = 0,
) -> TrainingRow:
    """Measure one minibatch of ``worlds`` sequences of ``steps`` steps.

    Args:
        objects: Objects, mixed over the clouds.
        network: Preset.
        device: Warp device.
        hand: Hand.
        worlds: Sequences.
        steps: Steps of a sequence.
        half: Products in bfloat16.
        calls: Minibatches to time.
        seed: Of poses, weights and noise.
    """
    torch.manual_seed(seed)
    clouds = worlds * steps
    scenes = Scenes(objects, hand, clouds, device, seed)
    place = torch.device(wp.device_to_torch(wp.get_device(device)))
    net = Student(PRESETS[network], load_hand(hand).num_joints).to(place)
    voxelise = Voxeliser(net.cfg.voxel_m, noise=NoiseCfg(), clouds=clouds, seed=seed, device=device)
    senses = torch.zeros(steps, worlds, net.num_senses, device=place)
    on_gpu = place.type == "cuda"
    ends = scenes.clouds.ends if "marks" in net.cfg.encoder.inputs else ()
    marks: dict[str, list[float]] = {}
    sizes: list[int] = []

    def stop(name: str, start: float) -> float:
        if on_gpu:
            torch.cuda.synchronize(place)
        now = time.perf_counter()
        marks.setdefault(name, []).append(1e3 * (now - start))
        return now

    def build(sites: Sites) -> None:
        """All maps that the network will ask for."""
        for i in range(len(net.cfg.encoder.channels)):
            _ = sites.strided, i and sites.strided_back
            sites = sites.coarser
            if i < net.cfg.encoder.pooled_stages:
                _ = sites.windows
                sites = sites.coarser
            _ = sites.neighbours
        _ = sites.offsets

    def prepare(start: float, *, augment: bool) -> tuple[Sites, float]:
        scenes.write()
        start = stop("points", start)
        sites = voxelise(scenes.points, augment=augment, ends=ends)
        start = stop("voxels", start)
        build(sites)
        sizes.append(len(sites))
        return sites, stop("maps", start)

    def minibatch() -> None:
        net.train()
        sites, start = prepare(time.perf_counter(), augment=True)
        with torch.autocast(place.type, dtype=torch.bfloat16, enabled=half):
            output = net(net.encode(sites).unflatten(0, (steps, worlds)), senses, net.initial_hidden(worlds))
            loss = output.mean.square().mean() + output.log_std.mean() + output.distance.square().mean()
        start = stop("forward", start)
        loss.backward()
        stop("backward", start)
        net.zero_grad()

    def act() -> None:
        net.eval()
        with torch.inference_mode(), torch.autocast(place.type, dtype=torch.bfloat16, enabled=half):
            sites, _ = prepare(time.perf_counter(), augment=False)
            net.act(sites, senses[0].repeat(steps, 1), net.initial_hidden(clouds))

    def seconds(function: Callable[[], None]) -> float:
        function()
        marks.clear()
        start = time.perf_counter()
        for _ in range(calls):
            function()
        stop("all", start)
        return (time.perf_counter() - start) / calls

    acting = seconds(act)
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(place)
    training = seconds(minibatch)
    return TrainingRow(
        network=network,
        precision="bfloat16" if half else "float32",
        clouds=clouds,
        voxels=float(np.mean(sizes)) / clouds,
        clouds_per_s=clouds / training,
        parts_ms={name: float(np.mean(times)) for name, times in marks.items() if name != "all"},
        act_clouds_per_s=clouds / acting,
        memory_gb=torch.cuda.max_memory_allocated(place) / 1e9 if on_gpu else 0.0,
    )
