"""Losses of the student. T steps, N worlds, D actions, H distance heads."""

import math

import torch

from vd.student.network import StudentOutput


def imitation_loss(
    output: StudentOutput, label: torch.Tensor, kind: str, *, bounded: bool = False
) -> torch.Tensor:
    """How far the student's actions are from the teacher's, the mean over steps and worlds.

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


def distance_loss(predicted: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Squared error of predictions [T, N, H] of the rotation distance [T, N], in rad^2; the mean over all."""
    return (predicted - true[..., None]).square().mean()


def unexplained(predicted: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Share of the variance of ``true`` [T, N, D] over steps and worlds that is left: 1 for a constant."""
    rest = (true - true.mean(dim=(0, 1))).square().mean()
    return (predicted - true).square().mean() / rest.clamp(min=torch.finfo(rest.dtype).tiny)
