"""Optimiser steps that imitation and pre-training share."""

import math

import torch
from torch import nn


def make_optimizer(
    network: nn.Module, learning_rate: float, *, amsgrad: bool = True
) -> torch.optim.Optimizer:
    """AdamW, with amsgrad as in the released code."""
    return torch.optim.AdamW(network.parameters(), lr=learning_rate, amsgrad=amsgrad)


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
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    loss: torch.Tensor,
    grad_norm: float,
    world_size: int = 1,
) -> torch.Tensor:
    """One optimiser step on the gradient of ``loss``, averaged over processes and clipped.

    Returns:
        Norm of the gradient before clipping, a scalar on the device.
    """
    optimizer.zero_grad()
    loss.backward()
    parameters = list(network.parameters())
    if world_size > 1:
        # Every process has to take part with every weight, also one whose loss does not reach it.
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        torch.distributed.all_reduce(flat)
        flat /= world_size
        parts = flat.split([p.numel() for p in parameters])
        for parameter, part in zip(parameters, parts, strict=True):
            if parameter.grad is not None:
                parameter.grad.copy_(part.view_as(parameter))
    norm = nn.utils.clip_grad_norm_(parameters, grad_norm)
    optimizer.step()
    return norm.detach()


def all_finite(network: nn.Module) -> bool:
    """Whether all weights are; one wait for the device."""
    return math.isfinite(float(torch.stack([p.detach().sum() for p in network.parameters()]).sum()))
