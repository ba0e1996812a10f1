"""Going on with networks that read more: inputs that are new begin without effect."""

from typing import Any

import torch
from torch import nn

FIRST = "mlp.0.weight"
NEW_INPUTS = {
    FIRST: 0.0,
    "obs_normalizer._mean": 0.0,
    "obs_normalizer._var": 1.0,
    "obs_normalizer._std": 1.0,
}
"""What reads or normalises the inputs, and what it has for new ones."""


def widen(state: dict[str, Any], actor: nn.Module, critic: nn.Module) -> tuple[dict[str, Any], int]:
    """A checkpoint with the networks of a run that observes more, acting as before.

    What was there reads nothing of what is new: those weights are zero, and normalisation of new inputs
    starts at mean 0 and std 1. Of the optimiser's new moments the first is zero; the second is the mean of
    that of the unit's other weights: from zero Adam's first steps would be several times too long, because it
    counts steps from the begin of the run.

    Args:
        state: The checkpoint, as :func:`vd.train.checkpoint.load_checkpoint` reads it; not changed. Critic
            and optimiser may be missing, as in an exported policy.
        actor: The actor it is for, which reads at least as much as that of the checkpoint.
        critic: The critic it is for.

    Returns:
        The checkpoint, and how many inputs are new, of the network with the most of them.
    """
    widened, count = dict(state), 0
    moments = dict(state.get("optimizer_state_dict", {"state": {}})["state"])
    index = 0  # the optimiser counts the actor's parameters, then the critic's
    for key, network in (("actor_state_dict", actor), ("critic_state_dict", critic)):
        weights, own = dict(state.get(key, {})), network.state_dict()
        for name in weights.keys() & NEW_INPUTS.keys():
            extra = own[name].shape[-1] - weights[name].shape[-1]
            count = max(count, extra)
            weights[name] = nn.functional.pad(weights[name], (0, extra), value=NEW_INPUTS[name])
        if weights:
            widened[key] = weights
        for name, parameter in network.named_parameters():
            if name == FIRST and index in moments:
                moments[index] = _wider_moments(moments[index], parameter.shape[1])
            index += 1
    if "optimizer_state_dict" in state:
        widened["optimizer_state_dict"] = state["optimizer_state_dict"] | {"state": moments}
    return widened, count


def _wider_moments(moment: dict[str, Any], inputs: int) -> dict[str, Any]:
    """Adam's moments of the first layer, for more inputs."""
    first, second = moment["exp_avg"], moment["exp_avg_sq"]
    extra = inputs - first.shape[1]
    mean = second.mean(dim=1, keepdim=True).expand(-1, extra)
    return moment | {
        "exp_avg": nn.functional.pad(first, (0, extra)),
        "exp_avg_sq": torch.cat((second, mean), dim=1),
    }
