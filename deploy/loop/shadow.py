"""Compare what a policy was told on a hand with what the simulator shows in the same state, step by step.

Every step of a log is put into a simulated world. Its observation, by the code of the training, is compared
with what the loop makes of the same joints, and the joint goals likewise. Where images were kept (--images)
the image is compared too, and the object is looked for in both. With --follow it runs beside the loop.
"""

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.deploy.loop.observation import Sensed
    from vd.hand_log import HandLog

SENSE = 5e-5
"""Values that are observed lie this close: rounding of poses computed in another order."""
GOAL_RAD = 2e-5
"""So do joint goals within the digits of a log."""
FOUND_RAD = 0.15
"""The object is found turned by no more in most steps, a symmetric one up to its symmetry: twice what the
errors of a camera made of it."""
PIXEL_M = 0.005
"""Difference from which a pixel shows something else [m]."""
PIXEL_SHARE = 0.05
"""Share of such pixels that motion explains, between the image and the reading of the state."""
FOLLOW_S = 0.5
"""How often a log is looked at that is still being written."""
SILENT_S = 30.0
"""Time without a new step after which a log is taken to be finished."""
BEGIN_S = 300.0
"""Longest wait for a log to begin: a twin that compiles its kernels takes minutes."""
UNKNOWN_POSE = (0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0)
"""Where an object is put whose pose nobody knows: out of the way."""


@dataclass(frozen=True)
class ShadowCfg:
    """Compare what a policy was told on a hand with what the simulator shows in the same state."""

    log: Annotated[Path, tyro.conf.Positional]
    """Folder of the log."""
    policy: str | None = None
    """The policy by whose camera the object is looked for; by default that of the log."""
    follow: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Wait for the log to begin, and go on as it grows until it ends: beside the loop."""
    every: int = 1
    """Compare each so many steps."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""


@dataclass(frozen=True)
class Difference:
    """One step, on the hand and in the simulator."""

    sense: float
    """Largest difference of what is observed of joints, fingertips and the action before."""
    goal_rad: float
    """Largest difference of the joint goals [rad]; 0 where the policy did not act."""
    pixels: float | None
    """Share of the pixels with depth in both images that show something else; None without an image."""
    found_rad: float | None = None
    """Angle between the object's orientations as found, up to its symmetry [rad]; None without an image."""

    @property
    def ok(self) -> bool:
        """Whether nothing but rounding tells them apart."""
        return (
            self.sense <= SENSE
            and self.goal_rad <= GOAL_RAD
            and (self.pixels is None or self.pixels <= PIXEL_SHARE)
        )


class Shadow:
    """The simulator beside a log.

    Args:
        log: Its first steps.
        policy: Name of the policy; None: that of the log.
    """

    def __init__(self, log: "HandLog", policy: str | None = None):
        from vd.assets_usd.hands import load_hand
        from vd.deploy.loop.action import ActionFilter
        from vd.deploy.loop.flight import STILL, mirror_task
        from vd.deploy.loop.goals import one_object
        from vd.deploy.loop.mirror import Mirror
        from vd.deploy.loop.pilot import camera_and_depth
        from vd.evaluate.agents import open_policy
        from vd.evaluate.senses import EnvironmentSenses
        from vd.kernels.task.observations import teacher_observation_slices
        from vd.sensors.depth_cloud import CameraCloud
        from vd.tracking.observer import Observer

        name = policy or log.run["policy"]
        loaded: Any = None if name == STILL else open_policy(name, "cpu")
        hand, item = load_hand(log.run["hand"]), one_object(log.run["object"]["set"])
        task = mirror_task(loaded, log.run["hand"], log.run["object"]["set"])
        camera, depth = camera_and_depth(loaded, hand)
        self._mirror = Mirror(task)
        self._actions = ActionFilter(hand, task)
        self._simulated = EnvironmentSenses(self._mirror.env, camera, depth)
        self._eye = CameraCloud(camera, points=depth.points, crop_m=depth.crop_m)
        columns = teacher_observation_slices(hand.num_fingers)

        def observer() -> Observer:
            return Observer(
                hand,
                [item],
                columns["previous_action"].stop,
                world_object=np.zeros(1, dtype=int),
                world_scale=np.ones(1),
                camera=camera,
                control_hz=task.sim.control_hz,
                device="cpu",
            )

        self._ours, self._theirs = observer(), observer()
        names = ("joint_position", "joint_velocity", "fingertips", "previous_action")
        self._told = [column for part in names for column in range(columns[part].start, columns[part].stop)]
        self._symmetry = item.symmetry
        self._compared = 0

    def compare(self, log: "HandLog", step: int) -> Difference:
        """One step of the log, on both sides."""
        import torch
        import warp as wp

        from vd.deploy.loop.observation import seen_points, senses_of

        sensed, image, env = _sensed(log, step), log.image(step), self._mirror.env
        self._mirror.take(sensed)
        # The simulator looks for the object anew where an episode begins.
        wp.to_torch(env.step_count).fill_(self._compared)
        fresh = torch.full((1,), self._compared == 0)
        self._compared += 1
        pixels, found_rad = None, None
        if image is None:
            points = torch.full((1, 1, 3), torch.nan)
        else:
            points, shown = seen_points(self._eye, image), self._simulated.read()
            pixels = self._pixels(image)
            self._theirs(shown)
        observed, _ = self._ours(senses_of(sensed, points, fresh=fresh))
        if image is not None:
            found_rad = self._found_apart()
        apart = observed - wp.to_torch(env.world_observation)[:, : observed.shape[1]]
        acted = log.columns["acting"][step] > 0.5 and np.abs(log.channel("action")[step]).max() > 0.0
        return Difference(
            sense=float(apart[0, self._told].abs().max()),
            goal_rad=self._goal_difference(log, step) if acted else 0.0,
            pixels=pixels,
            found_rad=found_rad,
        )

    def _goal_difference(self, log: "HandLog", step: int) -> float:
        """Between the goals that were sent and those of the environment's kernel [rad]."""
        self._actions.put(log.channel("smoothed")[step])
        goal = self._actions.goal(log.channel("action")[step], log.channel("position")[step])
        return float(np.abs(goal - log.channel("command")[step]).max())

    def _found_apart(self) -> float:
        """Angle between the object as it is found in both images [rad]."""
        from vd.evaluate.statistics import symmetric_error

        ours, theirs = self._ours.found, self._theirs.found
        assert ours is not None and theirs is not None
        one, other = (found.orientation[0].numpy() for found in (ours, theirs))
        return float(symmetric_error(one, other, self._symmetry))

    def _pixels(self, image: np.ndarray) -> float:
        """Share of pixels of an image that differ from the simulated one, which was rendered before."""
        camera = self._simulated.camera
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
        "observed, largest": float(f"{max(one.sense for one in found):.2g}"),
        "joint goals, largest [rad]": float(f"{max(one.goal_rad for one in found):.2g}"),
    }
    if pixels:
        result["pixels apart, largest share"] = float(f"{max(pixels):.3g}")
    if turns:
        result["object turned, median [rad]"] = float(f"{turned:.2g}")
    return result


def _sensed(log: "HandLog", step: int) -> "Sensed":
    """What was known at a step."""
    from vd.deploy.loop.observation import Sensed

    pose = log.object_pose
    return Sensed(
        joint_q=log.channel("position")[step].astype(np.float32),
        joint_qd=log.channel("velocity")[step].astype(np.float32),
        smoothed=log.channel("smoothed")[step].astype(np.float32),
        goal_quat=log.goals[int(log.columns["goal"][step])].astype(np.float32),
        object_pose=np.array(UNKNOWN_POSE if pose is None else pose[step], dtype=np.float32),
        object_velocity=np.zeros(6, dtype=np.float32),
    )
