"""A policy made ready to fly: loaded, checked against the hand, given its eyes, and warmed up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.camera_layer import read_camera
from vd.assets_usd.hand_data import CameraModel
from vd.assets_usd.hand_model import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.deploy.camera.camera import DepthSource
from vd.deploy.hardware.motion import reset_pose
from vd.deploy.loop.goals import read_goals
from vd.deploy.loop.mirror import Mirror
from vd.deploy.loop.observation import Sensed
from vd.deploy.loop.pilot import Pilot, StillPilot, StudentPilot, TeacherPilot, TrackingPilot
from vd.deploy.twin.twin_link import TwinLink
from vd.envs.cfg import ReorientCfg
from vd.evaluate.agents import (
    check_bundle,
    is_saved_student,
    is_tracking_policy,
    open_policy,
    task_for,
    trained_task,
)
from vd.evaluate.rollout import draw_goals
from vd.paper import PAPER

STILL = "still"
"""Name of the policy that does nothing."""
WARM_UP = 3
"""Decisions before the hand is switched on: kernels are loaded, allocators have grown."""
FIRST_IMAGE_S = 5.0
"""Longest wait for a camera's first image."""


@dataclass(frozen=True)
class Flight:
    """A policy made ready."""

    name: str
    """As it was asked for."""
    kind: str
    """teacher, student, tracking or still."""
    pilot: Pilot
    """It."""
    task: ReorientCfg
    """Environment of its training."""
    camera: CameraModel | None = None
    """Where its depth camera has to be; None: it has none."""
    needs_truth: bool = False
    """Whether it needs the object's true pose, which only a twin knows."""
    calibrated: bool = True
    """Whether its rule to stop comes from episodes; a teacher's needs none."""


def make_flight(
    name: str,
    hand_name: str,
    item_name: str,
    hand: HandModel,
    item: ObjectModel,
    *,
    tolerance_rad: float = PAPER.success.rotation_rad,
    seed: int = 0,
) -> Flight:
    """Load a policy, and make it ready.

    Args:
        name: Bundle, file of a policy, installed policy, or ``still``.
        hand_name: Name of the hand or its USD.
        item_name: Name of the object's set or its USD.
        hand: The hand.
        item: The object.
        tolerance_rad: How near to the goal it is to stop [rad].
        seed: Of the choice of camera points.

    Raises:
        ValueError: It is for another hand, or cannot act.
    """
    if name == STILL:
        return Flight(name, STILL, StillPilot(hand.num_joints), ReorientCfg(hand=hand_name))
    policy: Any = open_policy(name, "cpu")
    if policy is None:
        raise ValueError(f"{name} cannot be flown; give a bundle, a policy's file, or {STILL}")
    student = is_saved_student(policy)
    moves = policy.spec.num_actions if student else policy.num_actions
    if moves != hand.num_joints:
        raise ValueError(f"{name} moves {moves} joints, the hand {hand.name} has {hand.num_joints}")
    check_bundle(name, replace(trained_task(policy), hand=hand_name))
    if student or is_tracking_policy(policy):
        pilot: StudentPilot | TrackingPilot
        if student:
            pilot = StudentPilot(policy, hand, item, tolerance_rad=tolerance_rad, seed=seed)
        else:
            pilot = TrackingPilot(policy, hand, item, tolerance_rad=tolerance_rad, seed=seed)
        return Flight(
            name,
            "student" if student else "tracking",
            pilot,
            trained_task(policy),
            pilot.camera,
            needs_truth=pilot.camera is None,
            calibrated=policy.spec.calibrated_for(tolerance_rad),
        )
    task = mirror_task(policy, hand_name, item_name)
    teacher = TeacherPilot(policy, Mirror(task), tolerance_rad)
    return Flight(name, "teacher", teacher, task, needs_truth=True)


def mirror_task(policy: Any, hand_name: str, item_name: str) -> ReorientCfg:
    """The environment of a policy's training as a mirror takes it: one world, not randomised."""
    return task_for(
        policy,
        hand=hand_name,
        objects=(item_name,),
        num_envs=1,
        seed=0,
        stop_tolerance_rad=PAPER.success.rotation_rad,
        max_goal_angle_rad=None,
        episode_s=PAPER.scene.episode_s,
        randomised=False,
        success_ends_episode=False,
        at_rest=False,
    )


def make_goals(texts: Sequence[str], drawn: int, max_angle: float, *, seed: int) -> list[np.ndarray]:
    """Goals as they were typed, or drawn ones, each within an angle of the one before.

    Args:
        texts: Orientations as :func:`vd.deploy.loop.goals.read_goals` reads them.
        drawn: How many to draw where there are none.
        max_angle: Largest angle between two drawn goals [rad]; the first from no rotation.
        seed: Of the draw.

    Returns:
        Quaternions xyzw.

    Raises:
        ValueError: A text that is no orientation.
    """
    goals = read_goals(texts)
    if goals:
        return goals
    rng = np.random.default_rng(seed)
    last = np.array([0.0, 0.0, 0.0, 1.0])
    for _ in range(drawn):
        last = draw_goals(last[None], rng, max_angle)[0]
        goals.append(last)
    return goals


def look(flight: Flight, source: DepthSource, hand: HandModel, layer: Path | None) -> CameraModel:
    """Let a policy see by the camera's own lens, from where it was found to be.

    Args:
        flight: The policy, one that has a camera.
        source: The camera.
        hand: The hand.
        layer: Its place as a layer over the hand; None: where it was in training.

    Returns:
        The camera by which it sees.

    Raises:
        HandError: The layer is none of this hand.
    """
    assert isinstance(flight.pilot, (StudentPilot, TrackingPilot)) and flight.camera is not None
    place = flight.camera if layer is None else read_camera(hand, layer)
    seen = source.intrinsics.seen_from(place)
    flight.pilot.look_by(seen)
    return seen


def warm_up(
    pilot: Pilot, hand: HandModel, goal: np.ndarray, camera: DepthSource | None, link: TwinLink | None
) -> None:
    """Let the policy decide a few times on what is seen now, and forget it.

    The object may not be between the fingers yet: for the flight it is looked for anew.
    """
    pose = reset_pose(hand.num_fingers)
    known = None if link is None else link.state()
    sensed = Sensed(
        joint_q=pose,
        joint_qd=np.zeros_like(pose),
        smoothed=np.zeros_like(pose),
        goal_quat=goal,
        depth=None if camera is None else camera.read(FIRST_IMAGE_S).depth_m,
        object_pose=None if known is None else known.object_pose,
        object_velocity=None if known is None else known.object_velocity,
    )
    for _ in range(WARM_UP):
        pilot.decide(sensed)
    pilot.begin()
