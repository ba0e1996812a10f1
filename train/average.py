"""Weight averaging: one policy of the mean weights of several that went on from the same one.

Once a policy is learned, an update is nearly all noise (docs/lessons.md), and every run ends somewhere
around what it has learned, not at it. Their mean is nearer to that. Weights of runs that began apart are not
alike, and their mean is nothing; so it has to be judged, like any policy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from vd.files import check_file
from vd.train.begin import find_start, unlike

NETWORKS = ("actor_state_dict", "critic_state_dict")


@dataclass
class AverageCfg:
    """Write a policy of the mean weights of several, of runs that went on from the same one.

    Task, curriculum and learner's settings are those of the first. Judge it before you use it: vd-eval.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Checkpoints of vd-train teacher, policies, runs' folders (their best), or installed policies; two at
    least."""
    out: Path = Path("policy.pt")
    """File to write."""


def average_command(arguments: list[str], _started: float) -> int:
    """``vd-train average``; the exit status."""
    cfg = tyro.cli(AverageCfg, args=arguments, prog="vd-train average")
    check_file(cfg.out)
    average_policies(cfg.policies, cfg.out)
    print(f"{cfg.out}: the mean of {len(cfg.policies)} policies; next, judge it: vd-eval {cfg.out}")
    return 0


def average_policies(policies: Sequence[str], output: Path) -> None:
    """Write the mean of teachers: of their actors, and of their critics if all have one.

    Args:
        policies: As of :class:`AverageCfg`; those given twice count twice.
        output: The file.

    Raises:
        FileNotFoundError: One of them is not there.
        ValueError: There are fewer than two, or one is no teacher, or has other networks, observations or
            actions than the first.
    """
    import torch

    from vd.policy import policy_export
    from vd.train.checkpoint import load_checkpoint, save_checkpoint

    if len(policies) < 2:
        raise ValueError("a mean is of two policies at least; give more of them")
    paths = [find_start(name, flag="vd-train average") for name in policies]
    states = [policy_export(load_checkpoint(path, flag="vd-train average")) for path in paths]
    first = states[0]
    for name, state in zip(policies, states, strict=True):
        different = [
            f"policy.{key} {first['policy'].get(key)}, there {value}"
            for key, value in state["policy"].items()
            if first["policy"].get(key) != value
        ]
        different += [w.replace(", here ", ", there ") for w in unlike(first["task"], state["task"])]
        if different:
            raise ValueError(
                f"{name} is no policy to take a mean with {policies[0]} of ({'; '.join(different)}); give "
                "policies of runs that went on from the same one"
            )
    # A critic that not all have is left out. Counts, which are no weights, are those of the first.
    mean = dict(first)
    for network in NETWORKS:
        if not all(network in state for state in states):
            mean.pop(network, None)
            continue
        mean[network] = {
            name: torch.stack([state[network][name] for state in states]).mean(dim=0)
            if value.is_floating_point()
            else value
            for name, value in first[network].items()
        }
    mean["env_steps"] = max(state["env_steps"] for state in states)
    save_checkpoint(output, mean)
