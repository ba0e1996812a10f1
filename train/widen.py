"""Going on with networks that see more than before: new inputs begin without effect."""

from typing import Any

import torch
from torch import nn

FIRST_WEIGHT = "mlp.0.weight"
"""The layer that reads the observation, in rsl-rl's models."""
MOMENT, SECOND_MOMENT = "exp_avg", "exp_avg_sq"
"""Adam's running means of a gradient and of its square."""
_FILLS = {"obs_normalizer._mean": 0.0, "obs_normalizer._var": 1.0, "obs_normalizer._std": 1.0}


def new_inputs(state: dict[str, Any], num_observations: int) -> int:
    """How many more values ``num_observations`` are than the networks of a checkpoint read.

    Raises:
        ValueError: They are fewer.
    """
    before = int(state["policy"]["num_observations"])
    if num_observations < before:
        raise ValueError(
            f"its networks read {before} values and this run observes {num_observations}, but a run can only "
            "go on with more"
        )
    return num_observations - before


def widen(state: dict[str, Any], extra: int, actor: nn.Module, critic: nn.Module) -> dict[str, Any]:
    """A checkpoint whose networks read ``extra`` more values behind those they know, with the same outputs.

    New weights are zero and normalisation starts at mean 0 and std 1, so actions and values do not depend
    on the new values at first. Of the optimiser's moments the first is zero; the second is the mean of that
    of the unit's other weights. From zero Adam's first steps would be several times too long, because it
    counts steps from the begin of the run.

    Args:
        state: The checkpoint, as :func:`vd.train.checkpoint.load_checkpoint` reads it; not changed. Critic
            and optimiser may be missing, as in an exported policy.
        extra: New inputs.
        actor: The actor it is for; says the order of the optimiser's parameters.
        critic: The critic it is for.
    """
    order = [
        (network, name)
        for network, module in (("actor", actor), ("critic", critic))
        for name, _ in module.named_parameters()
    ]
    optimiser = state.get("optimizer_state_dict", {"state": {}})
    moments = dict(optimiser["state"])
    widened = dict(state)
    for network in ("actor", "critic"):
        if f"{network}_state_dict" not in state:
            continue
        weights = dict(state[f"{network}_state_dict"])
        weights[FIRST_WEIGHT] = _behind(weights[FIRST_WEIGHT], extra, 0.0)
        for name, fill in _FILLS.items():
            if name in weights:
                weights[name] = _behind(weights[name], extra, fill)
        widened[f"{network}_state_dict"] = weights
        index = order.index((network, FIRST_WEIGHT))
        if index in moments:
            moment = moments[index]
            second = moment[SECOND_MOMENT]
            filled = torch.cat((second, second.mean(dim=1, keepdim=True).expand(-1, extra)), dim=1)
            moments[index] = moment | {MOMENT: _behind(moment[MOMENT], extra, 0.0), SECOND_MOMENT: filled}
    if "optimizer_state_dict" in state:
        widened["optimizer_state_dict"] = optimiser | {"state": moments}
    before = int(state["policy"]["num_observations"])
    widened["policy"] = state["policy"] | {"num_observations": before + extra}
    return widened


def _behind(tensor: torch.Tensor, extra: int, fill: float) -> torch.Tensor:
    """``tensor`` with ``extra`` more entries of ``fill`` in its last dimension."""
    return nn.functional.pad(tensor, (0, extra), value=fill)
