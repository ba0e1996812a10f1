"""What a policy that sees by a camera is told before an action, by a simulator or a robot's drivers."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Senses:
    """What N hands sense before an action, as a simulator or a robot's drivers report it."""

    joint_q: torch.Tensor
    """Joint positions [rad] [N, D]."""
    joint_qd: torch.Tensor
    """Joint velocities [rad/s] [N, D]."""
    action: torch.Tensor
    """Moving average of the actions so far [N, D]."""
    goal_quat: torch.Tensor
    """Wanted orientation of the object [N, 4]."""
    points: torch.Tensor
    """What the camera sees, base frame [m], NaN for none [N, K, 3]."""
    fresh: torch.Tensor
    """Where an episode begins: where the object was before means nothing; bool [N]."""
