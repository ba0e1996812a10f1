"""Agents by name or file, and the task they act in: shared by vd-eval and vd-play."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from vd.config import from_dict
from vd.envs.cfg import CurriculumCfg, ReorientCfg, SuccessCfg

BUILT_IN = ("zero", "random")
"""Agents without a file: no action, and uniform noise."""

DEFAULT_HAND = "dclaw4"
# What a run's folder holds, best first.
_RUN_FILES = ("policy.pt", "checkpoints/best.pt")


def find_policy(name: str | Path) -> Path:
    """The policy file that ``name`` means: a file, or the best one of a run's folder.

    Raises:
        FileNotFoundError: There is none.
    """
    path = Path(name)
    if not path.is_dir():
        return path
    for candidate in _RUN_FILES:
        if (path / candidate).is_file():
            return path / candidate
    raise FileNotFoundError(f"{path} holds no {' or '.join(_RUN_FILES)}; give a policy.pt or a checkpoint")


def trained_task(policy: Any) -> ReorientCfg:
    """The configuration a policy was trained in."""
    return from_dict(ReorientCfg, policy.task, where="task of the policy")


def open_policy(name: str, device: str) -> Any | None:
    """Load a trained policy; None for a built-in agent, which needs the number of actions first.

    Args:
        name: ``zero``, ``random``, a policy file, or a run's folder.
        device: Torch device.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no policy.
    """
    if name in BUILT_IN:
        return None
    from vd.policy import load_policy

    return load_policy(find_policy(name), device=device)


def built_in(name: str, num_actions: int, *, seed: int, device: str) -> Any:
    """The agent ``zero`` or ``random``."""
    from vd.policy import RandomPolicy, ZeroPolicy

    if name == "zero":
        return ZeroPolicy(num_actions)
    return RandomPolicy(num_actions, seed=seed, device=device)


def task_for(
    policy: Any | None,
    *,
    hand: str | None,
    objects: tuple[str, ...],
    num_worlds: int,
    seed: int,
    stop_tolerance_rad: float,
    max_goal_angle_rad: float,
    episode_s: float,
    randomised: bool,
    success_ends_episode: bool,
) -> ReorientCfg:
    """The task in which an agent is evaluated or watched.

    Physics, actions and rewards are those of the training; the success criteria are the paper's, whatever
    the policy was trained with, so that rates can be compared; there is no curriculum.

    Args:
        policy: A trained policy, or None.
        hand: Hand name; None takes the policy's.
        objects: Object sets.
        num_worlds: N.
        seed: Of the environment.
        stop_tolerance_rad: Orientation tolerance of success [rad].
        max_goal_angle_rad: Largest angle from an object to a goal the environment draws [rad].
        episode_s: Time limit [s].
        randomised: Domain randomisation, noise and disturbances.
        success_ends_episode: End at success, or give a new goal.
    """
    base = trained_task(policy) if policy is not None else ReorientCfg(hand=DEFAULT_HAND)
    return replace(
        base,
        hand=hand or base.hand,
        objects=objects,
        num_worlds=num_worlds,
        seed=seed,
        episode_s=episode_s,
        success_ends_episode=success_ends_episode,
        success=replace(SuccessCfg(), rotation_rad=stop_tolerance_rad),
        goal=replace(base.goal, max_angle_rad=max_goal_angle_rad),
        curriculum=CurriculumCfg(),
        randomisation=replace(base.randomisation, enabled=randomised),
    )
