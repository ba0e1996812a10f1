"""Going on with networks that read more: inputs that are new begin without effect."""

from typing import Any

import torch
from torch import nn

MOMENT, SECOND_MOMENT = "exp_avg", "exp_avg_sq"
"""Adam's running means of a gradient and of its square."""
_FIRST = "mlp.0.weight"
_FILLS = {
    _FIRST: 0.0,
    "obs_normalizer._mean": 0.0,
    "obs_normalizer._var": 1.0,
    "obs_normalizer._std": 1.0,
}
"""What reads or normalises the inputs, and what it has for new ones."""


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


def widen(
    state: dict[str, Any], actor: nn.Module, critic: nn.Module, *, num_observations: int
) -> dict[str, Any]:
    """A checkpoint with the networks of a run that observes more, acting as before.

    What was there reads nothing of what is new: those weights are zero, and normalisation of new inputs
    starts at mean 0 and std 1. Of the optimiser's new moments the first is zero; the second is the mean of
    that of the unit's other weights: from zero Adam's first steps would be several times too long, because it
    counts steps from the begin of the run.

    Args:
        state: The checkpoint, as :func:`vd.train.checkpoint.load_checkpoint` reads it; not changed. Critic
            and optimiser may be missing, as in an exported policy.
        actor: The actor it is for.
        critic: The critic it is for.
        num_observations: Values that the run observes, at least as many as the checkpoint's networks read.
    """
    optimiser = state.get("optimizer_state_dict", {"state": {}})
    moments = dict(optimiser["state"])
    widened = dict(state)
    index = 0  # the optimiser counts the actor's parameters, then the critic's
    for network, module in (("actor", actor), ("critic", critic)):
        weights = dict(state.get(f"{network}_state_dict", {}))
        own = module.state_dict()
        for name, parameter in module.named_parameters():
            if name == _FIRST and index in moments:
                moments[index] = _wider_moments(moments[index], parameter.shape[1])
            index += 1
        for name in weights.keys() & _FILLS.keys():
            extra = own[name].shape[-1] - weights[name].shape[-1]
            weights[name] = nn.functional.pad(weights[name], (0, extra), value=_FILLS[name])
        if weights:
            widened[f"{network}_state_dict"] = weights
    if "optimizer_state_dict" in state:
        widened["optimizer_state_dict"] = optimiser | {"state": moments}
    widened["policy"] = state["policy"] | {"num_observations": num_observations}
    return widened


def _wider_moments(moment: dict[str, Any], inputs: int) -> dict[str, Any]:
    """Adam's moments of the first layer, for more inputs."""
    first, second = moment[MOMENT], moment[SECOND_MOMENT]
    extra = inputs - first.shape[1]
    means = second.mean(dim=1, keepdim=True).expand(-1, extra)
    return moment | {
        MOMENT: nn.functional.pad(first, (0, extra)),
        SECOND_MOMENT: torch.cat((second, means), dim=1),
    }
