"""What a student learns from: single looks with the truth, and sequences of what was told of looks.

All of it is in the frame of each step (:mod:`vd.vision.inputs`). T steps, B sequences, R looks, A
actions.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from vd.vision.inputs import Belief, StudentInput, carried
from vd.vision.rotations import turn_angle
from vd.vision.student import SHIFT_M, Flow


@dataclass(frozen=True)
class Looks:
    """Looks to learn to see from."""

    sight: StudentInput
    """What was read, with what was believed then [R]."""
    truth: Belief
    """What was to be believed [R]."""


@dataclass(frozen=True)
class Sequences:
    """Sequences to learn to act from."""

    told: Tensor
    """What was told in each step [T, B, S]."""
    hidden: Tensor
    """Memory before the first step [B, G]."""
    done: Tensor
    """Whether an episode ended with a step, bool [T, B]."""
    label: Tensor
    """What the teacher does [T, B, A]."""


def belief_errors(belief: Belief, truth: Belief) -> tuple[Tensor, Tensor]:
    """Angles [rad] and distances [m] by which beliefs are wrong [..]."""
    turn = belief.rotation.mT @ truth.rotation
    return turn_angle(turn), (belief.position - truth.position).norm(dim=-1)


def flow_loss(flow: Flow, looks: Looks) -> Tensor:
    """Negative logarithm of the likelihood of the shifts from beliefs to the truth, a mean over voxels."""
    believed = looks.sight.belief
    turn = looks.truth.rotation @ believed.rotation.mT
    offset = looks.truth.position - believed.position
    end = carried(flow.start[:, None], turn[flow.look])[:, 0] + offset[flow.look]
    off = (flow.start + flow.shift - end).norm(dim=-1) / SHIFT_M
    return (off * torch.exp(-flow.log_scale) + 3.0 * flow.log_scale).mean()
