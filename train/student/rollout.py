"""Rollouts that imitation learns from: sequences of what was seen, with labels.

T steps, N environments, D actions, G the student's memory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
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
    """The teacher's mean action of each state [T, N, D]."""
    done: torch.Tensor
    """Where the goal or the episode ended with the step [T, N], bool."""
    hidden: torch.Tensor
    """The student's memory before the first step [N, G]."""
    envs: torch.Tensor
    """Environment of each sequence [N]."""

    def state_dict(self) -> dict[str, Any]:
        """Its tensors, on the CPU."""
        return _moved({field.name: getattr(self, field.name) for field in fields(self)}, "cpu")

    @classmethod
    def from_state(cls, state: Mapping[str, Any], device: torch.device) -> "Rollout":
        """What :meth:`state_dict` gave, on ``device``."""
        return cls(**_moved({field.name: state[field.name] for field in fields(cls)}, device))

    @property
    def num_bytes(self) -> int:
        """Memory of its frames, which are nearly all of it."""
        return sum(frame.nbytes for frame in self.frames.values())


def taken(rollouts: Sequence[Rollout], sequences: torch.Tensor) -> Rollout:
    """Some sequences of rollouts of N environments each, as one: k N + n is sequence n of rollout k."""
    envs = len(rollouts[0].envs)
    parts = [(r, sequences[sequences // envs == k] - k * envs) for k, r in enumerate(rollouts)]
    parts = [(rollout, own) for rollout, own in parts if len(own)]
    return Rollout(
        {name: torch.cat([r.frames[name][:, own] for r, own in parts], dim=1) for name in rollouts[0].frames},
        torch.cat([r.label[:, own] for r, own in parts], dim=1),
        torch.cat([r.done[:, own] for r, own in parts], dim=1),
        torch.cat([r.hidden[own] for r, own in parts]),
        torch.cat([r.envs[own] for r, own in parts]),
    )


def _moved(values: Mapping[str, Any], device: str | torch.device) -> dict[str, Any]:
    return {
        name: _moved(value, device) if isinstance(value, Mapping) else value.to(device)
        for name, value in values.items()
    }
