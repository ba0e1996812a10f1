"""The mean of several policies' weights: less of the noise that each stopped at.

An update is mostly noise (:mod:`vd.train.noise`), so weights wander about a path that improves slowly, and
their mean over it can act better than any of them (Polyak and Juditsky 1992). Only policies of one run, or of
runs that went on from each other, have weights that can be averaged.
"""

from collections.abc import Sequence
from typing import Any

import torch

from vd.train.config import AverageCfg

NETWORKS = ("actor_state_dict", "critic_state_dict")
_NORMALISER = "obs_normalizer."


def shares(weights: Sequence[float], count: int) -> list[float]:
    """``weights`` of ``count`` policies, or equal ones, so that they sum to 1.

    Raises:
        ValueError: Fewer than two policies, another number of weights, or one that is not positive.
    """
    if count < 2:
        raise ValueError("there is nothing to average; name at least two policies")
    given = list(weights) or [1.0] * count
    if len(given) != count or min(given) <= 0.0:
        raise ValueError(
            f"--weights has {len(given)} numbers for {count} policies; give a positive one for each"
        )
    return [weight / sum(given) for weight in given]


def averaged(
    states: Sequence[dict[str, Any]], weights: Sequence[float], names: Sequence[str]
) -> dict[str, Any]:
    """A policy with the weighted mean of the networks' weights.

    Args:
        states: Policies or checkpoints; not changed. The critic is left out unless all have one.
        weights: Of each, positive; see :func:`shares`.
        names: What to call them in errors.

    Raises:
        ValueError: Networks, hand or observations differ, so that there is no mean.
    """
    from vd.policy import policy_export
    from vd.train.begin import unlike

    newest = max(states, key=lambda state: state["env_steps"])
    for state, name in zip(states, names, strict=True):
        what = [] if state["policy"] == newest["policy"] else ["the shape of the networks"]
        hand, other = (s["task"].get("hand") for s in (state, newest))
        what += [f"the hand ({hand}, {other})"] if hand != other else []
        what += unlike(state["task"], newest["task"])
        if what:
            raise ValueError(
                f"{name} cannot be averaged with the newest of them: they differ in {'; '.join(what)}. Give "
                "policies of one run, or of runs that went on from each other"
            )
    result = policy_export(newest)
    for network in NETWORKS:
        if not all(network in state for state in states):
            result.pop(network, None)
            continue
        result[network] = {
            key: value
            if key.startswith(_NORMALISER)
            else sum(w * state[network][key].cpu() for w, state in zip(weights, states, strict=True))
            for key, value in result[network].items()
        }
    return result | {"averaged_steps": [int(state["env_steps"]) for state in states]}


def average_files(cfg: AverageCfg) -> None:
    """Read, average and write for ``vd-train average``.

    Raises:
        FileNotFoundError: One of the policies is not there.
        ValueError: One is no teacher, or they cannot be averaged.
    """
    from vd.evaluate.agents import find_policy
    from vd.train.checkpoint import load_checkpoint, save_checkpoint

    weights = shares(cfg.weights, len(cfg.policies))
    with torch.no_grad():
        states = [load_checkpoint(find_policy(name), flag="vd-train average") for name in cfg.policies]
        save_checkpoint(cfg.output, averaged(states, weights, cfg.policies))
