"""Losses of the student, and figures of its errors. T steps, N environments, D actions, H distance heads."""

import math
from collections.abc import Mapping

import torch
from torch import nn

from vd.paper import PAPER
from vd.quaternions import relative_rotation
from vd.train.student.rotations import matrices, two_columns
from vd.vision.match import Matches
from vd.vision.network import StudentOutput
from vd.vision.sight import BASE, OBJECT

POSE_SCALE_M = 0.05
"""Positions of objects are predicted in units of this, about their spread."""
MATCH_SCALE_M = 0.05
"""Errors of matched points are in units of this, about the radius of an object; beyond a fifth of it they
count no more than linearly: a camera's points may be of the hand."""
MATCH_BEND = 0.2
"""Error at which squared becomes linear, in these units."""
POSE_VALUES = 9
"""Position 3, two columns of the rotation from the goal 6."""


def imitation_loss(
    output: StudentOutput, label: torch.Tensor, kind: str, *, bounded: bool = False
) -> torch.Tensor:
    """How far the student's actions are from the teacher's, the mean over steps and environments.

    Args:
        output: What the student says, leading shape [T, N].
        label: The teacher's mean action, shape [T, N, D].
        kind: ``likelihood``: minus the log-likelihood of the label under the student's independent normal
            distributions. ``squared``: the squared distance of label and mean.
        bounded: A mean beyond a label of 1 (or -1) is no error: the environment makes the same of both.

    Returns:
        A scalar.
    """
    error = label - output.mean
    if bounded:
        error = error.masked_fill((error * label < 0.0) & (label.abs() >= 1.0), 0.0)
    if kind == "squared":
        return error.square().sum(dim=-1).mean()
    scaled = error * torch.exp(-output.log_std)
    return (0.5 * scaled.square() + output.log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1).mean()


def in_view(label: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
    """The labels [.., D] that belong to the views [..] which were taken.

    Args:
        label: One label of a state [.., D], or one in each view of the teacher [.., F, D].
        view: Views [..].
    """
    if label.ndim == view.ndim + 1:
        return label
    return label.take_along_dim(view[..., None, None], dim=-2).squeeze(-2)


def distance_loss(predicted: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Squared error of predictions [T, N, H] of the rotation distance [T, N], in rad^2; the mean over all."""
    return (predicted - true[..., None]).square().mean()


def unexplained(predicted: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Share left of the variance of ``true`` [T, N, D] over steps and environments: 1 for a constant."""
    rest = (true - true.mean(dim=(0, 1))).square().mean()
    return (predicted - true).square().mean() / rest.clamp(min=torch.finfo(rest.dtype).tiny)


def imitation_figures(prefix: str, mean: torch.Tensor, label: torch.Tensor) -> dict[str, torch.Tensor]:
    """How far the student's mean actions are from labels [T, N, D], beside what says nothing of the state.

    Returns:
        Scalars on the device: ``action_error``, the root mean square of the difference of what the
        environment makes of both; ``zero_error``, the same of no action; ``unexplained``, the share of the
        labels' variance that is left (1: no better than the best constant action).
    """
    mean, label = mean.clamp(-1.0, 1.0), label.clamp(-1.0, 1.0)
    return {
        f"{prefix}/action_error": (mean - label).square().mean().sqrt(),
        f"{prefix}/zero_error": label.square().mean().sqrt(),
        f"{prefix}/unexplained": unexplained(mean, label),
    }


def poses(frames: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Where the object of frames is, in units of 5 cm, and how it is turned from the goal [.., 9].

    Args:
        frames: ``body_q`` [.., B, 7] and ``goal_quat`` [.., 4].
    """
    pose = frames["body_q"][..., OBJECT, :]
    turn = two_columns(relative_rotation(pose[..., 3:], frames["goal_quat"]))
    return torch.cat((pose[..., :3] / POSE_SCALE_M, turn), dim=-1)


def match_loss(matches: Matches, body_q: torch.Tensor, goal_quat: torch.Tensor) -> torch.Tensor:
    """How far points of objects are found from where they are on their goals, the mean over all.

    Args:
        matches: Of R clouds.
        body_q: Poses of frames in the world frame [R, B, 7].
        goal_quat: Wanted orientations in the world frame [R, 4].

    Returns:
        A scalar.
    """
    origin, place = body_q[:, BASE], body_q[:, OBJECT]
    world, now, wanted = (
        matrices(two_columns(quaternion)) for quaternion in (origin[:, 3:], place[:, 3:], goal_quat)
    )
    centre = (place[:, None, :3] - origin[:, None, :3]) @ world
    # Rows times a matrix: turned by its transpose. From the base to the object, to the goal, to the base.
    own = (matches.points - centre) @ world.transpose(1, 2) @ now
    goal = own @ wanted.transpose(1, 2) @ world + own.new_tensor(PAPER.cloud.goal_position_m)
    error = nn.functional.smooth_l1_loss(
        matches.found / MATCH_SCALE_M, goal / MATCH_SCALE_M, reduction="none", beta=MATCH_BEND
    )
    return (error.sum(dim=-1, keepdim=True) * matches.present).sum() / matches.present.sum().clamp(min=1.0)
