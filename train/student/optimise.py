"""Optimiser steps that imitation and pre-training share."""

import math

import torch
from torch import nn


def scheduled(rate: float, step: int, *, warmup: int = 0, decay_after: int = 0) -> float:
    """Learning rate of an optimiser step, counted from 1.

    Args:
        rate: After the warm-up and until the decay.
        step: Number of the step.
        warmup: Steps over which it rises from 0, linearly.
        decay_after: Step after which it falls as 1 / sqrt(steps); 0: never.
    """
    factor = min(1.0, step / max(1, warmup))
    if decay_after:
        factor *= min(1.0, math.sqrt(decay_after / max(1, step)))
    return factor * rate


def autocast(device: torch.device, precision: str) -> torch.autocast:
    """Products in half precision where ``precision`` is ``bf16``."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bf16")


def descend(
    networks: nn.Module,
    optimizer: torch.optim.Optimizer,
    loss: torch.Tensor,
    *,
    rate: float,
    grad_norm: float,
    world_size: int = 1,
) -> torch.Tensor:
    """One optimiser step on the gradient of ``loss``, averaged over processes and clipped.

    Returns:
        Norm of the gradient before clipping, a scalar on the device.
    """
    optimizer.param_groups[0]["lr"] = rate
    optimizer.zero_grad()
    loss.backward()
    parameters = list(networks.parameters())
    if world_size > 1:
        # Every process has to take part with every weight, also one whose loss does not reach it.
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = nn.utils.parameters_to_vector(gradients)
        torch.distributed.all_reduce(flat)
        nn.utils.vector_to_parameters(flat / world_size, gradients)
    norm = nn.utils.clip_grad_norm_(parameters, grad_norm)
    optimizer.step()
    return norm.detach()


def share_statistics(student: nn.Module, world_size: int) -> None:
    """Let all processes use the batch statistics of the first; each has averaged its own."""
    if world_size > 1:
        for buffer in student.buffers():
            torch.distributed.broadcast(buffer, 0)


def read_means(figures: dict[str, torch.Tensor], world_size: int) -> dict[str, float]:
    """Scalars, averaged over the processes; waits for the device."""
    values = torch.stack(tuple(figures.values()))
    if world_size > 1:
        torch.distributed.all_reduce(values)
        values /= world_size
    return dict(zip(figures, values.tolist(), strict=True))
