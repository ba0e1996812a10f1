"""Compare what a policy saw on a hand with what the simulator shows in the same state, step by step.

Every step of a log is put into a simulated world. Its observation, by the code of the training, is compared
with the one that the loop makes of the same joints: points, voxels, senses and joint goals, the object as the
student finds it, and where images of a twin were kept (--images) the depth image too: the object is then
looked for in both images. With --follow it runs beside the loop.
"""

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    import torch

    from vd.deploy.observation import Sensed
    from vd.hand_log import HandLog

POINT_M = 2e-6
"""Points lie this close: rounding of poses computed in another order [m]."""
SENSE = 1e-6
"""So do senses; and joint goals within the digits of a log."""
GOAL_RAD = 2e-5
FOUND_RAD = 0.15
"""The object is found turned by no more in most steps, a symmetric one up to its symmetry: twice what the
errors of a camera made of it."""
PIXEL_M = 0.005
"""Difference from which a pixel shows something else [m]."""
PIXEL_SHARE = 0.05
"""Share of such pixels that motion explains, between the image and the reading of the state."""
FOLLOW_S = 0.5
"""How often a log is looked at that is still being written."""
OBJECT = "object"
"""Name of the sense by which a student finds its object."""
SILENT_S = 30.0
"""Time without a new step after which a log is taken to be finished."""
BEGIN_S = 300.0
"""Longest wait for a log to begin: a twin that compiles its kernels takes minutes."""
UNKNOWN_POSE = (0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0)
"""Where an object is put whose pose nobody knows: out of the way."""


@dataclass(frozen=True)
class ShadowCfg:
    """Compare what a policy saw on a hand with what the simulator shows in the same state."""

    log: Annotated[Path, tyro.conf.Positional]
    """Folder of the log."""
    policy: str | None = None
    """The student whose clouds are compared; by default the policy of the log, or the lean network."""
    follow: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Wait for the log to begin, and go on as it grows until it ends: beside the loop."""
    every: int = 1
    """Compare each so many steps."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""


@dataclass(frozen=True)
class Difference:
    """One step, on the hand and in the simulator."""

    points_m: float
    """Largest distance of a point of the goal, the hand or the object from its counterpart [m]."""
    voxels: int
    """Voxels of the simulator's cloud."""
    voxels_apart: int
    """Voxels that only one of them has."""
    borders: int
    """Points so close to a border between voxels that rounding decides."""
    sense: float
    """Largest difference of what the policy senses of itself."""
    goal_rad: float
    """Largest difference of the joint goals [rad]; 0 where the policy did not act."""
    pixels: float | None
    """Share of the pixels with depth in both images that show something else; None without an image."""
    found_rad: float | None = None
    """Angle between the object's orientations as found, up to its symmetry [rad]; None where it is not looked
    for, or by a camera whose image was not kept."""

    @property
    def ok(self) -> bool:
        """Whether nothing but rounding tells them apart."""
        return (
            self.points_m <= POINT_M
            and self.voxels_apart <= 2 * self.borders
            and self.sense <= SENSE
            and self.goal_rad <= GOAL_RAD
            and (self.pixels is None or self.pixels <= PIXEL_SHARE)
        )


class Shadow:
    """The simulator beside a log.

    Args:
        log: Its first steps.
        policy: Name of the student; None: that of the log.
    """

    def __init__(self, log: "HandLog", policy: str | None = None):
        from vd.assets_usd.hands import load_hand
        from vd.config import from_dict
        from vd.deploy.action import ActionFilter
        from vd.deploy.flight import STILL, mirror_task
        from vd.deploy.goals import one_object
        from vd.deploy.mirror import Mirror
        from vd.deploy.observation import StudentSight
        from vd.deploy.pilot import student_camera
        from vd.evaluate.agents import is_saved_student, open_policy
        from vd.sensors.cfg import DepthCameraCfg
        from vd.student.cfg import LEAN
        from vd.vision import StudentView

        name = policy or log.run["policy"]
        loaded: Any = None if name == STILL else open_policy(name, "cpu")
        student = loaded if is_saved_student(loaded) else None
        hand_name, item_name = log.run["hand"], log.run["object"]["set"]
        hand, item = load_hand(hand_name), one_object(item_name)
        self._network = LEAN if student is None else student.spec.network
        task = mirror_task(loaded, hand_name, item_name)
        self._mirror = Mirror(task)
        self._actions = ActionFilter(hand, task)
        # The object is looked for in what the student sees: its camera's images, or complete clouds.
        blind = replace(self._network, senses=tuple(n for n in self._network.senses if n != OBJECT))
        whole, rendered, depth, place = self._network, blind, DepthCameraCfg(points=0), None
        self._image_sight: StudentSight | None = None
        camera = None if student is None else student_camera(student, hand)
        if student is not None and camera is not None:
            whole, rendered, place = blind, self._network, student.spec.camera
            depth = from_dict(DepthCameraCfg, student.depth, where="depth camera of the student")
            self._image_sight = StudentSight(hand, item, rendered, camera=camera, depth=depth)
        self._sight = StudentSight(hand, item, whole)
        self._view = StudentView(self._mirror.env, whole, rendered=False)
        self._image_view = StudentView(self._mirror.env, rendered, rendered=True, depth=depth, camera=place)
        self._symmetry = item.symmetry
        self._compared = 0

    def compare(self, log: "HandLog", step: int) -> Difference:
        """One step of the log, on both sides."""
        import torch
        import warp as wp

        sensed = _sensed(log, step)
        self._mirror.take(sensed)
        # The simulator looks for the object anew where an episode begins.
        wp.to_torch(self._mirror.env.step_count).fill_(self._compared)
        self._compared += 1
        seen = self._view.frame()
        points, expected = self._sight.points(sensed), self._view.points(seen)
        ours, theirs = self._sight.sites(points), self._view.sites(seen, augment=False)
        known = self._sight.frame(sensed, points, ours)
        with torch.inference_mode():
            apart = (points - expected).norm(dim=-1)
        image = log.image(step)
        pixels, found_rad = None, self._found_apart(known, seen, sensed.goal_quat)
        if image is not None:
            shown = self._image_view.frame()
            pixels = self._pixels(image)
            if (sight := self._image_sight) is not None:
                sensed = replace(sensed, depth=image)
                cloud = sight.points(sensed)
                looked = sight.frame(sensed, cloud, sight.sites(cloud))
                found_rad = self._found_apart(looked, shown, sensed.goal_quat)
        acted = log.columns["acting"][step] > 0.5 and np.abs(log.channel("action")[step]).max() > 0.0
        return Difference(
            points_m=float(apart.max()),
            voxels=sum(len(sites) for sites in theirs),
            voxels_apart=sum(len(_keys(a) ^ _keys(b)) for a, b in zip(ours, theirs, strict=True)),
            borders=_near_borders(expected[0].numpy(), self._network.voxel_m),
            sense=max(float((known[name] - seen[name]).abs().max()) for name in known if name != OBJECT),
            goal_rad=self._goal_difference(log, step) if acted else 0.0,
            pixels=pixels,
            found_rad=found_rad,
        )

    def _goal_difference(self, log: "HandLog", step: int) -> float:
        """Between the goals that were sent and those of the environment's kernel [rad]."""
        self._actions.put(log.channel("smoothed")[step])
        goal = self._actions.goal(log.channel("action")[step], log.channel("position")[step])
        return float(np.abs(goal - log.channel("command")[step]).max())

    def _found_apart(
        self, known: dict[str, "torch.Tensor"], seen: dict[str, "torch.Tensor"], goal: np.ndarray
    ) -> float | None:
        """Angle between two findings of the object [rad]; None if it is not looked for."""
        from vd.evaluate.statistics import quat_multiply, symmetric_error
        from vd.student.object_sense import ROTATION

        if OBJECT not in known:
            return None
        ours, theirs = (quat_multiply(one[OBJECT][0, ROTATION].numpy(), goal) for one in (known, seen))
        return float(symmetric_error(ours, theirs, self._symmetry))

    def _pixels(self, image: np.ndarray) -> float:
        """Share of pixels of an image that differ from the simulated one, which was rendered before."""
        camera = self._image_view.camera
        assert camera is not None
        shown = camera.depth.numpy()[0]
        both = (shown > 0.0) & (image > 0.0)  # a camera misses some of what is there
        return float((np.abs(shown - image) > PIXEL_M)[both].mean()) if both.any() else 1.0


def shadow(cfg: ShadowCfg) -> int:
    """Compare, and print what was found; 1 if more than rounding tells the two apart."""
    quiet_warp()
    if cfg.every < 1:
        raise ValueError(f"--every is {cfg.every}; it has to be at least 1")
    found = []
    for difference in differences(cfg):
        found.append(difference)
        if sys.stderr.isatty():
            print(f"\r{len(found)} steps, {sum(not d.ok for d in found)} apart", end="", file=sys.stderr)
    if not found:
        raise ValueError(f"{cfg.log} has no steps to compare")
    result = summary(found)
    if cfg.json:
        print(json.dumps(result, indent=1))
    else:
        for name, value in result.items():
            print(f"{name:<28} {value}")
    return int(not result["ok"])


def differences(cfg: ShadowCfg) -> Iterator[Difference]:
    """Every compared step of a log, with ``follow`` as it grows."""
    from vd.hand_log import LogError, read_log

    beside, step, silent = None, 0, 0.0
    while True:
        try:
            log = read_log(cfg.log)
        except LogError:  # it has not begun
            if not cfg.follow or silent > BEGIN_S:
                raise
            silent += FOLLOW_S
            time.sleep(FOLLOW_S)
            continue
        beside = beside or Shadow(log, cfg.policy)
        steps = len(log.columns["t"])
        silent = 0.0 if step < steps else silent + FOLLOW_S
        while step < steps:
            yield beside.compare(log, step)
            step += cfg.every
        if not cfg.follow or "end" in log.run or silent > SILENT_S:
            return
        time.sleep(FOLLOW_S)


def summary(found: list[Difference]) -> dict[str, Any]:
    """The worst of all steps."""
    pixels = [one.pixels for one in found if one.pixels is not None]
    turns = [one.found_rad for one in found if one.found_rad is not None]
    turned = float(np.median(turns)) if turns else 0.0
    result: dict[str, Any] = {
        "ok": all(one.ok for one in found) and turned <= FOUND_RAD,
        "steps": len(found),
        "steps apart": sum(not one.ok for one in found),
        "points, largest [m]": float(f"{max(one.points_m for one in found):.2g}"),
        "voxels of a cloud": round(float(np.mean([one.voxels for one in found]))),
        "voxels apart": sum(one.voxels_apart for one in found),
        "points on borders of voxels": sum(one.borders for one in found),
        "senses, largest": float(f"{max(one.sense for one in found):.2g}"),
        "joint goals, largest [rad]": float(f"{max(one.goal_rad for one in found):.2g}"),
    }
    if pixels:
        result["pixels apart, largest share"] = float(f"{max(pixels):.3g}")
    if turns:
        result["object turned, median [rad]"] = float(f"{turned:.2g}")
    return result


def _sensed(log: "HandLog", step: int) -> "Sensed":
    """What was known at a step."""
    from vd.deploy.observation import Sensed

    pose = log.object_pose
    return Sensed(
        joint_q=log.channel("position")[step].astype(np.float32),
        joint_qd=log.channel("velocity")[step].astype(np.float32),
        smoothed=log.channel("smoothed")[step].astype(np.float32),
        goal_quat=log.goals[int(log.columns["goal"][step])].astype(np.float32),
        object_pose=np.array(UNKNOWN_POSE if pose is None else pose[step], dtype=np.float32),
        object_velocity=np.zeros(6, dtype=np.float32),
    )


def _keys(sites: Any) -> set[tuple[int, ...]]:
    return {tuple(row) for row in sites.coordinates.tolist()}


def _near_borders(points: np.ndarray, side: float) -> int:
    """Points closer to a border between voxels than they are to their counterparts."""
    cells = points / side
    return int((np.abs(cells - np.round(cells)) < 2.0 * POINT_M / side).any(axis=1).sum())
