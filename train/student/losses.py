"""Losses of the student, and figures of its errors. T steps, N environments, D actions, H distance heads."""

import math
from collections.abc import Mapping

import torch

from vd.quaternions import relative_rotation
from vd.vision.network import StudentOutput
from vd.vision.rotations import two_columns
from vd.vision.sight import OBJECT

POSE_SCALE_M = 0.05
"""Positions of objects are predicted in units of this, about their spread."""
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


def imitation_figures(mean: torch.Tensor, label: torch.Tensor) -> dict[str, torch.Tensor]:
    """How far the student's mean actions are from labels [T, N, D].

    Returns:
        Scalars on the device: ``student/action_error``, the root mean square of the difference of what the
        environment makes of both, and ``student/unexplained``, the share of the labels' variance that is left
        (1: no better than the best constant action).
    """
    mean, label = mean.clamp(-1.0, 1.0), label.clamp(-1.0, 1.0)
    error = (mean - label).square().mean()
    spread = (label - label.mean(dim=(0, 1))).square().mean()
    return {
        "student/action_error": error.sqrt(),
        "student/unexplained": error / spread.clamp(min=torch.finfo(spread.dtype).tiny),
    }


def poses(frames: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Where the object of frames is, in units of 5 cm, and how it is turned from the goal [.., 9].

    Args:
        frames: ``body_q`` [.., B, 7] and ``goal_quat`` [.., 4].
    """
    pose = frames["body_q"][..., OBJECT, :]
    turn = two_columns(relative_rotation(pose[..., 3:], frames["goal_quat"]))
    return torch.cat((pose[..., :3] / POSE_SCALE_M, turn), dim=-1)
