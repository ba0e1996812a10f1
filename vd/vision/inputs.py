"""What a student reads of a step, as the hand's symmetry shows it.

Where the fingers of a hand are alike and evenly spaced, a turn about its axis that puts them in
each other's places changes nothing but their names. So every step is read in the one of these
turned frames in which the axis of the wanted rotation lies nearest to one direction, as teachers
see it (:mod:`vd.envs.symmetry_frames`): what is to be learned is a part of what it were otherwise.

N environments, R steps of them, T steps, V frames, G fingertips, A joints with motors. Base frame
of the hand, or that turned; metres, radians.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import torch
import warp as wp
from torch import Tensor

from vd.assets_usd.hand_data import HandModel
from vd.geometry.arrays import as_warp
from vd.geometry.clouds import HandCloud
from vd.geometry.frame_maps import turns_of_hand
from vd.paper import PAPER
from vd.policy.senses import Senses
from vd.vision.rotations import quaternion_matrices, quaternions

Step = TypeVar("Step")


@dataclass(frozen=True)
class Belief:
    """Where a goal's cloud is believed to lie on the object; leading axes [N] or [T, N]."""

    rotation: Tensor
    """From the cloud's own axes to the base frame, matrices [.., 3, 3]."""
    position: Tensor
    """Of the cloud's mean [m] [.., 3]."""


@dataclass(frozen=True)
class StudentInput:
    """What a student reads of a step; leading axes [N] or [T, N]."""

    camera: Tensor
    """What the camera sees, or complete surfaces; NaN for none [.., K, 3]."""
    hand: Tensor
    """The hand's own points by its joints [.., H, 3]."""
    goal: Tensor
    """The goal's cloud about its mean, in its own axes [.., P, 3]."""
    goal_rotation: Tensor
    """Wanted rotation, from the cloud's own axes to the base frame, matrices [.., 3, 3]."""
    proprioception: Tensor
    """Positions and velocities of joints with motors, scaled, and the last action [.., 3 A]."""
    tips: Tensor
    """Places of the fingertips [m] [.., G, 3]."""
    belief: Belief
    """What the step before left."""
    frame: Tensor
    """The frame in which all of this is given, int64 [..]."""


def each(step: Step, change: Callable[[Tensor], Tensor]) -> Step:
    """A step with its tensors changed, such as indexed, and those of its belief."""
    values: dict[str, Any] = {}
    for field in fields(step):  # type: ignore[arg-type]
        value = getattr(step, field.name)
        if isinstance(value, Belief):
            value = each(value, change)
        elif isinstance(value, Tensor):
            value = change(value)
        values[field.name] = value
    return type(step)(**values)


def joined(steps: Sequence[Step]) -> Step:
    """Steps one after the other, along their first axis."""
    values: dict[str, Any] = {}
    for field in fields(steps[0]):  # type: ignore[arg-type]
        parts = [getattr(step, field.name) for step in steps]
        values[field.name] = joined(parts) if isinstance(parts[0], Belief) else torch.cat(parts)
    return type(steps[0])(**values)


def either(which: Tensor, first: Belief, second: Belief) -> Belief:
    """The first beliefs where ``which`` [R] is, elsewhere the second [R]."""
    return Belief(
        rotation=torch.where(which[:, None, None], first.rotation, second.rotation),
        position=torch.where(which[:, None], first.position, second.position),
    )


def carried(points: Tensor, rotation: Tensor, position: Tensor | float = 0.0) -> Tensor:
    """Points [.., P, 3] turned by matrices [.., 3, 3] and shifted by [.., 1, 3]: P R^T + p."""
    return points @ rotation.mT + position


def turned(belief: Belief, turn: Tensor) -> Belief:
    """A belief in a frame turned by matrices [.., 3, 3]."""
    position = carried(belief.position[..., None, :], turn)
    return Belief(turn @ belief.rotation, position[..., 0, :])


class HandFrames:
    """The V frames in which a hand looks the same; the base frame alone where it has no others.

    Args:
        hand: The hand.
        device: Torch device.

    Attributes:
        turn: From the base frame to each [V, 3, 3].
    """

    def __init__(self, hand: HandModel, device: torch.device):
        turn, sector, joints = turns_of_hand(hand)
        order = np.argsort(joints, axis=1)
        fingers = np.arange(len(hand.tip_link))[None]
        if len(turn) > 1:
            fingers = order[:, :: hand.joints_per_finger] // hand.joints_per_finger
        self.turn = torch.tensor(turn, dtype=torch.float32, device=device)
        self._sector = torch.tensor(sector, dtype=torch.float32, device=device)
        self._joints = torch.tensor(joints, device=device)
        self._order = torch.tensor(order, device=device)
        self._fingers = torch.tensor(fingers, device=device)

    def choose(self, belief: Belief, goal_rotation: Tensor) -> Tensor:
        """The frame in whose sector the axis of the wanted rotation lies, int64 [R]."""
        wanted = goal_rotation @ belief.rotation.mT
        twice = wanted - wanted.mT
        axis = torch.stack([twice[:, 2, 1], twice[:, 0, 2], twice[:, 1, 0]], dim=1)
        return (axis @ self._sector.T).argmax(dim=1)

    def joints_in(self, values: Tensor, frame: Tensor) -> Tensor:
        """Values of all joints [R, .., D] by the frame's names for them."""
        return self._named(values, self._order[frame])

    def joints_out(self, values: Tensor, frame: Tensor) -> Tensor:
        """The inverse of :meth:`joints_in`."""
        return self._named(values, self._joints[frame])

    def _named(self, values: Tensor, order: Tensor) -> Tensor:
        """Values [R, .., D] in an order [R, D]."""
        if len(self.turn) == 1:
            return values
        between = (1,) * (values.dim() - 2)
        return values.gather(-1, order.unflatten(0, (-1, *between)).expand_as(values))

    def tips_in(self, tips: Tensor, frame: Tensor) -> Tensor:
        """Places of the fingertips [R, G, 3] in frames."""
        named = tips.gather(1, self._fingers[frame][..., None].expand_as(tips))
        return carried(named, self.turn[frame])

    def belief_in(self, belief: Belief, frame: Tensor) -> Belief:
        """A belief [R] in frames."""
        return turned(belief, self.turn[frame])

    def belief_out(self, belief: Belief, frame: Tensor) -> Belief:
        """The inverse of :meth:`belief_in`."""
        return turned(belief, self.turn[frame].mT)


class InputBuilder:
    """Makes what a student reads of what N hands sense.

    Args:
        hand: The hand.
        goals: Clouds of the goals, in their own axes and of true size [m] [N, P, 3].

    Attributes:
        frames: The frames of the hand.
    """

    def __init__(self, hand: HandModel, goals: Tensor):
        device = goals.device
        links = np.arange(len(hand.link_names))
        self.set_goals(goals)
        self._cloud = HandCloud(hand, link_body=links, device=str(device))
        self._links = len(links)

        def constant(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.frames = HandFrames(hand, device)
        self._tip_link = torch.tensor(hand.tip_link, device=device)
        self._tip_place = constant(hand.tip_frame[:, :3])
        self._mount = constant(hand.mount[:3])
        self._to_base = quaternion_matrices(constant(hand.mount[3:])).T
        self._place = constant(hand.goal_in_base)
        self._moved = torch.tensor(hand.actuated, device=device)
        self._lower = constant(hand.lower)
        self._range = constant(hand.upper - hand.lower)

    def set_goals(self, goals: Tensor) -> None:
        """Take other clouds."""
        middle = goals.mean(dim=1)
        self._middle = middle
        self._goals = goals - middle[:, None]

    def goal_rotation(self, goal_quat: Tensor) -> Tensor:
        """Wanted rotations in the base frame [R, 3, 3], of quaternions in the world's [R, 4]."""
        return self._to_base @ quaternion_matrices(goal_quat)

    def goal_quat(self, rotation: Tensor) -> Tensor:
        """The inverse of :meth:`goal_rotation`."""
        return quaternions(self._to_base.T @ rotation)

    def first_belief(self, goal_quat: Tensor) -> Belief:
        """What is believed of an object before it is seen.

        It is turned as it is wanted and lies where objects are handled.
        """
        rotation = self.goal_rotation(goal_quat)
        return Belief(rotation, self._place.repeat(len(goal_quat), 1))

    def near_place(self, belief: Belief, reach_m: float) -> Belief:
        """A belief whose place is at most ``reach_m`` from where objects are handled."""
        offset = belief.position - self._place
        length = offset.norm(dim=-1, keepdim=True)
        share = reach_m / length.clamp(min=reach_m)
        position = self._place + offset * share
        return Belief(belief.rotation, position)

    def belief_of(self, pose: Tensor, rows: Tensor | None = None) -> Belief:
        """What is to be believed of objects at poses in the base frame [R, 7]; ``rows`` as below."""
        middle = self._middle if rows is None else self._middle[rows]
        rotation = quaternion_matrices(pose[:, 3:])
        position = carried(middle[:, None], rotation, pose[:, None, :3])
        return Belief(rotation, position[:, 0])

    def pose_of(self, belief: Belief) -> Tensor:
        """Where the frames of the objects of all environments are believed to be [N, 7]."""
        middle = carried(self._middle[:, None], belief.rotation)[:, 0]
        orientation = quaternions(belief.rotation)
        return torch.cat([belief.position - middle, orientation], dim=1)

    def __call__(
        self,
        senses: Senses,
        belief: Belief,
        rows: Tensor | None = None,
        *,
        clouds: bool = True,
    ) -> StudentInput:
        """What is read of R steps.

        Args:
            senses: What was sensed, R rows; instead of what a camera sees ``points`` may hold
                complete surfaces (:func:`carried`).
            belief: What was believed before, base frame [R].
            rows: Environment of each row [R]; row i is of environment i by default.
            clouds: Whether the hand's own points are made; without them nothing can be looked at.
        """
        joint_q = senses.joint_q
        poses = self._link_poses(joint_q)
        goal_rotation = self.goal_rotation(senses.goal_quat)
        frame = self.frames.choose(belief, goal_rotation)
        turn = self.frames.turn[frame]
        position = 2.0 * (joint_q - self._lower) / self._range - 1.0
        velocity = PAPER.observation.velocity_scale * senses.joint_qd
        joints = torch.stack([position, velocity, senses.action], dim=1)
        named = self.frames.joints_in(joints, frame)[..., self._moved]
        hand = self._points_on(poses) if clouds else senses.points[:, :0]
        return StudentInput(
            camera=carried(senses.points, turn),
            hand=carried(hand, turn),
            goal=self._goals if rows is None else self._goals[rows],
            goal_rotation=turn @ goal_rotation,
            proprioception=named.flatten(1),
            tips=self.frames.tips_in(self._tips(poses), frame),
            belief=self.frames.belief_in(belief, frame),
            frame=frame,
        )

    def hand_points(self, joint_q: Tensor) -> Tensor:
        """The hand's own points [m] [R, H, 3] by positions of its joints [rad] [R, D]."""
        return self._points_on(self._link_poses(joint_q))

    def _link_poses(self, joint_q: Tensor) -> Tensor:
        """Poses of the links in the world [R, L, 7]."""
        poses = joint_q.new_empty((len(joint_q), self._links, 7))
        self._cloud.pose(as_warp(joint_q), as_warp(poses, wp.transform))
        return poses

    def _points_on(self, poses: Tensor) -> Tensor:
        """The hand's own points [m] [R, H, 3] for poses of its links in the world [R, L, 7]."""
        return wp.to_torch(self._cloud(as_warp(poses, wp.transform)))

    def _tips(self, poses: Tensor) -> Tensor:
        """Places of the fingertips [R, G, 3], of poses of the links in the world [R, L, 7]."""
        links = poses[:, self._tip_link]
        rotation = quaternion_matrices(links[..., 3:])
        place = links[..., :3] + carried(self._tip_place[:, None], rotation)[..., 0, :]
        return carried(place - self._mount, self._to_base)
