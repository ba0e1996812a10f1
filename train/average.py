"""One policy of the mean weights of several that went on from the same one.

Once a policy is learned, an update is nearly all noise (docs/lessons.md), and every run ends somewhere
around what it has learned, not at it. Their mean is nearer to that. Weights of runs that began apart are not
alike, and their mean is nothing; so it has to be judged, like any policy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from vd.files import check_file
from vd.train.begin import find_start, unlike

if TYPE_CHECKING:
    import torch

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
    from vd.policy import policy_export
    from vd.train.checkpoint import load_checkpoint, save_checkpoint

    if len(policies) < 2:
        raise ValueError("a mean is of two policies at least; give more of them")
    paths = [find_start(name, flag="vd-train average") for name in policies]
    states = [policy_export(load_checkpoint(path, flag="vd-train average")) for path in paths]
    first = states[0]
    for name, state in zip(policies[1:], states[1:], strict=True):
        _check_alike(policies[0], first, name, state)
    mean = {key: value for key, value in first.items() if key not in NETWORKS}
    for key in NETWORKS:
        if all(key in state for state in states):
            mean[key] = _mean([state[key] for state in states])
    mean["env_steps"] = max(state["env_steps"] for state in states)
    save_checkpoint(output, mean)


def _check_alike(first_name: str, first: dict[str, Any], name: str, state: dict[str, Any]) -> None:
    """Refuse a policy whose weights mean something else than those of the first.

    Raises:
        ValueError: It says what differs.
    """
    different = [
        f"policy.{k} {first['policy'][k]}, there {v}"
        for k, v in state["policy"].items()
        if first["policy"].get(k) != v
    ]
    hands = [f"env.hand {t.get('hand')}" for t in (first["task"], state["task"])]
    if hands[0] != hands[1]:
        different.append(f"{hands[0]}, there {hands[1].removeprefix('env.hand ')}")
    different += [words.replace(", here ", ", there ") for words in unlike(first["task"], state["task"])]
    if different:
        raise ValueError(
            f"{name} is no policy to take a mean with {first_name} of ({'; '.join(different)}); give "
            "policies of runs that went on from the same one"
        )


def _mean(weights: "Sequence[dict[str, torch.Tensor]]") -> "dict[str, torch.Tensor]":
    """Means of the numbers, shape by shape; counts, which are no weights, are those of the first."""
    import torch

    return {
        name: torch.stack([one[name] for one in weights]).mean(dim=0) if value.is_floating_point() else value
        for name, value in weights[0].items()
    }
