"""What a student learns from: sequences of steps, with the truth about each, and their losses.

All of it is in the frame of each step (:mod:`vd.vision.inputs`).

T steps, B sequences, N environments, D actions.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from vd.policy.senses import Senses
from vd.train.student.config import LearnCfg
from vd.vision.inputs import Belief, InputBuilder, StudentInput, carried, each
from vd.vision.rotations import turn_angle
from vd.vision.student import SHIFT_M, StudentOutput

LEAST_DISTANCE_RAD = 0.02
"""Distances to the goal below this count as this: nothing is stopped as near."""


@dataclass(frozen=True)
class Sequences:
    """Sequences to learn from."""

    sight: StudentInput
    """What was read in each step, with what was believed then [T, B]."""
    truth: Belief
    """What was to be believed [T, B]."""
    hidden: Tensor
    """Memory before the first step [B, G]."""
    done: Tensor
    """Whether an episode ended with a step, bool [T, B]."""
    label: Tensor | None = None
    """What the teacher does [T, B, D]; None: there is no teacher."""


def inputs_of(build: InputBuilder, senses: Senses, belief: Belief, rows: Tensor) -> StudentInput:
    """What was read in T steps of the environments ``rows`` [B], made again [T, B].

    Args:
        build: Makes it.
        senses: What was sensed [T, B].
        belief: What was believed [T, B].
        rows: The environments.
    """
    steps = len(senses.fresh)
    flat = each(senses, lambda value: value.flatten(0, 1))
    believed = each(belief, lambda value: value.flatten(0, 1))
    sight = build(flat, believed, rows.repeat(steps))
    return each(sight, lambda value: value.unflatten(0, (steps, len(rows))))


def belief_errors(belief: Belief, truth: Belief) -> tuple[Tensor, Tensor]:
    """Angles [rad] and distances [m] by which beliefs are wrong [..]."""
    turn = belief.rotation.mT @ truth.rotation
    return turn_angle(turn), (belief.position - truth.position).norm(dim=-1)


def last_errors(belief: Belief, sequences: Sequences) -> tuple[Tensor, Tensor]:
    """Angles [rad] and distances [m] by which beliefs after the last step are wrong [B]."""
    return belief_errors(belief, each(sequences.truth, lambda value: value[-1]))


def flow_loss(output: StudentOutput, sequences: Sequences) -> Tensor:
    """Negative logarithm of the likelihood of the shifts from beliefs to the truth, a mean over voxels."""
    flow = output.flow
    believed = each(sequences.sight.belief, lambda value: value.flatten(0, 1))
    truth = each(sequences.truth, lambda value: value.flatten(0, 1))
    turn = truth.rotation @ believed.rotation.mT
    offset = truth.position - believed.position
    end = carried(flow.start[:, None], turn[flow.look])[:, 0] + offset[flow.look]
    off = (flow.start + flow.shift - end).norm(dim=-1) / SHIFT_M
    return (off * torch.exp(-flow.log_scale) + 3.0 * flow.log_scale).mean()


def student_losses(output: StudentOutput, sequences: Sequences, cfg: LearnCfg) -> dict[str, Tensor]:
    """Weighted losses by name, means over all steps."""
    truth = sequences.truth
    to_goal = truth.rotation.mT @ sequences.sight.goal_rotation
    distance = turn_angle(to_goal).clamp(min=LEAST_DISTANCE_RAD)
    losses = {
        "flow": cfg.flow_weight * flow_loss(output, sequences),
        "distance": cfg.distance_weight * (output.log_distance - distance.log()).square().mean(),
    }
    if sequences.label is not None:
        off = sequences.label - output.action
        losses["action"] = cfg.action_weight * off.square().mean()
    return losses
