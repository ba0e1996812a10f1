"""Going on with larger networks: inputs and hidden units that are new begin without effect."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

MOMENT, SECOND_MOMENT = "exp_avg", "exp_avg_sq"
"""Adam's running means of a gradient and of its square."""
_FILLS = {"obs_normalizer._mean": 0.0, "obs_normalizer._var": 1.0, "obs_normalizer._std": 1.0}


def new_inputs(state: dict[str, Any], num_observations: int, critic_observations: int | None = None) -> int:
    """How many more values a run observes than the networks of a checkpoint read.

    Args:
        state: The checkpoint, with or without a critic.
        num_observations: Values that the run's actor reads.
        critic_observations: Values that its critic reads; as many by default.

    Raises:
        ValueError: They are fewer.
    """
    before = int(state["policy"]["num_observations"])
    read = [(before, num_observations)]
    if "critic_state_dict" in state:
        of_critic = state["critic_state_dict"]["mlp.0.weight"].shape[1]
        read.append((of_critic, num_observations if critic_observations is None else critic_observations))
    for then, now in read:
        if now < then:
            raise ValueError(
                f"its networks read {then} values and this run observes {now}, but a run can only "
                "go on with more"
            )
    return max(now - then for then, now in read)


def can_grow(before: Sequence[int], now: Sequence[int]) -> bool:
    """Whether hidden layers of ``now`` units can take over those of ``before``: as many, none smaller."""
    return len(before) == len(now) and all(old <= new for old, new in zip(before, now, strict=True))


def new_units(state: dict[str, Any], hidden: Sequence[int]) -> int:
    """How many hidden units more ``hidden`` has than a checkpoint's networks; 0 if they cannot grow to it."""
    before = state["policy"]["hidden"]
    return sum(hidden) - sum(before) if can_grow(before, hidden) else 0


def widen(
    state: dict[str, Any],
    actor: nn.Module,
    critic: nn.Module,
    *,
    num_observations: int,
    hidden: Sequence[int],
) -> dict[str, Any]:
    """A checkpoint with the networks of a run that observes more or has wider layers, acting as before.

    What was there reads nothing of what is new: those weights are zero, and normalisation of new inputs
    starts at mean 0 and std 1. New units read everything, with the weights of the run's own beginning, so
    that each is a feature of its own which the layer after it can come to use (Net2Net, Chen et al. 2016,
    copies units instead). Of the optimiser's new moments the first is zero; the second is the mean of that
    of the unit's other weights, for new units that of the layer's. From zero Adam's first steps would be
    several times too long, because it counts steps from the begin of the run.

    Args:
        state: The checkpoint, as :func:`vd.train.checkpoint.load_checkpoint` reads it; not changed. Critic
            and optimiser may be missing, as in an exported policy.
        actor: The actor it is for, as the run begins: the weights of new units are taken from it.
        critic: The critic it is for, likewise.
        num_observations: Values that the run observes, at least as many as the checkpoint's networks read.
        hidden: Units of the run's hidden layers, see :func:`can_grow`.
    """
    optimiser = state.get("optimizer_state_dict", {"state": {}})
    moments = dict(optimiser["state"])
    widened = dict(state)
    index = 0  # the optimiser counts the actor's parameters, then the critic's
    for network, module in (("actor", actor), ("critic", critic)):
        weights = dict(state.get(f"{network}_state_dict", {}))
        own = module.state_dict()
        for name, _ in module.named_parameters():
            if index in moments:
                moments[index] = _grown_moments(moments[index], own[name].shape)
            index += 1
        for name in weights:
            if name in _FILLS:
                extra = own[name].shape[-1] - weights[name].shape[-1]
                weights[name] = nn.functional.pad(weights[name], (0, extra), value=_FILLS[name])
            else:
                weights[name] = _grown(weights[name], own[name])
        if weights:
            widened[f"{network}_state_dict"] = weights
    if "optimizer_state_dict" in state:
        widened["optimizer_state_dict"] = optimiser | {"state": moments}
    widened["policy"] = state["policy"] | {"num_observations": num_observations, "hidden": list(hidden)}
    return widened


def _grown(old: torch.Tensor, fresh: torch.Tensor) -> torch.Tensor:
    """``fresh`` with ``old`` as its first rows (and columns), which read nothing of further columns."""
    if old.shape == fresh.shape:
        return old
    grown = fresh.detach().clone().to(old)
    if old.dim() == 2:
        grown[: old.shape[0], old.shape[1] :] = 0.0
    grown[tuple(slice(size) for size in old.shape)] = old
    return grown


def _grown_moments(moment: dict[str, Any], shape: torch.Size) -> dict[str, Any]:
    """Adam's moments of a parameter that has grown to ``shape``."""
    first, second = moment[MOMENT], moment[SECOND_MOMENT]
    if first.shape == shape:
        return moment
    old = tuple(slice(size) for size in first.shape)
    grown, squares = first.new_zeros(shape), second.new_full(shape, float(second.mean()))
    if second.dim() == 2:
        squares[: second.shape[0]] = second.mean(dim=1, keepdim=True)
    grown[old], squares[old] = first, second
    return moment | {MOMENT: grown, SECOND_MOMENT: squares}
