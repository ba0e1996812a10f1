"""Rollouts that imitation learns from: sequences of what was seen, with labels.

T steps, N environments, D actions, G the student's memory.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

UNCLIPPED = ("points",)
"""Frames' tensors that hold NaN on purpose: where there is no point."""


@dataclass
class Rollout:
    """What an update needs of N sequences of T steps."""

    frames: dict[str, torch.Tensor]
    """Frames before each step, tensors [T, N, ...]."""
    label: torch.Tensor
    """The teacher's mean action of each state [T, N, D], or one in each of its views [T, N, F, D]."""
    done: torch.Tensor
    """Where the goal or the episode ended with the step [T, N], bool."""
    hidden: torch.Tensor
    """The student's memory before the first step [N, G]."""
    envs: torch.Tensor
    """World of each sequence [N]."""


def taken(rollouts: Sequence[Rollout], sequences: torch.Tensor) -> Rollout:
    """Some sequences of rollouts of N environments each, as one: k N + n is sequence n of rollout k."""
    envs = len(rollouts[0].envs)
    parts = []
    for index, rollout in enumerate(rollouts):
        own = sequences[sequences // envs == index] - index * envs if len(rollouts) > 1 else sequences
        if len(own):
            parts.append((rollout, own))
    return Rollout(
        {name: torch.cat([r.frames[name][:, own] for r, own in parts], dim=1) for name in rollouts[0].frames},
        torch.cat([r.label[:, own] for r, own in parts], dim=1),
        torch.cat([r.done[:, own] for r, own in parts], dim=1),
        torch.cat([r.hidden[own] for r, own in parts]),
        torch.cat([r.envs[own] for r, own in parts]),
    )


def rollout_bytes(rollout: Rollout) -> int:
    """Memory of a rollout's tensors."""
    tensors = (*rollout.frames.values(), rollout.label, rollout.done, rollout.hidden)
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def moved(rollout: Rollout | dict[str, Any], device: str | torch.device) -> dict[str, Any]:
    """A rollout, or the dictionary of one, as a dictionary of tensors on ``device``."""
    values = rollout if isinstance(rollout, dict) else asdict(rollout)
    return {
        name: moved(value, device) if isinstance(value, dict) else value.to(device)
        for name, value in values.items()
    }
