"""Beginning a run with the networks of another: of a checkpoint, or of an exported policy."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.command.config import from_dict, leaves, to_dict
from vd.envs.curriculum import LEVELS

if TYPE_CHECKING:
    from vd.policy.contract import PolicySpec
    from vd.train.ppo import TeacherPPO
    from vd.train.presets import TeacherCfg

CRITIC_WARMUP = 50
"""Iterations in which a critic that begins from nothing learns alone. Its targets hold its own
values of up to 8 steps later, 4.5 in the mean, so an error of states that last shrinks by gamma^4.5
a time: to a tenth.
"""
MOMENTS_WARMUP = 3
"""Iterations of it where only the optimiser is missing: about a hundred steps, for Adam's second
moment.
"""
FIRST_LAYER = "mlp.0.weight"
"""Weights whose shape says how many values a network reads."""
REMEDY = "give the policy's settings, or leave --preset out, which takes them over"
_SENSES = ("hand", "fingertip", "hand_layer", "sim", "action", "observation")
"""Parts of a task that say what a policy's observations and actions mean."""


def find_start(name: str) -> Path:
    """The file that ``--init`` names.

    An installed policy, a file, or the best checkpoint of a run's folder.

    Raises:
        FileNotFoundError: There is none.
    """
    from vd.policy.agents import find_policy
    from vd.train.checkpoint import BEST_NAME, CHECKPOINT_FOLDER

    try:
        path = find_policy(name)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"--init: {error}") from error
    best = Path(name) / CHECKPOINT_FOLDER / BEST_NAME
    return best if path.is_relative_to(name) and best.is_file() else path


def read_start(path: Path, device: str = "cpu") -> dict[str, Any]:
    """What a run begins from: a checkpoint, or a policy as one without its optimiser.

    Beside what a checkpoint has, ``stage`` says how far its curriculum had come.

    Raises:
        ValueError: The file is damaged, no teacher, or of another version.
    """
    from vd.policy import SUFFIX, has_suffix
    from vd.policy.actor import TrainedPolicy, stage_of
    from vd.policy.bundle import read_policy
    from vd.train.checkpoint import load_checkpoint

    if not has_suffix(path, SUFFIX):
        state = load_checkpoint(path, device, flag="--init")
        return state | {"stage": stage_of(state)}
    policy = read_policy(path, device)
    if not isinstance(policy, TrainedPolicy):
        raise ValueError(f"--init: {path} sees by camera; give its teacher, {policy.spec.teacher}")
    contract = policy.contract
    state = {
        "policy": to_dict(contract.network),
        "task": contract.task,
        "interface": contract.interface,
        "learner": contract.learner,
        "stage": contract.stage,
        "iter": contract.iterations,
        "env_steps": contract.env_steps,
        "actor_state_dict": policy.weights,
    }
    return state | ({"critic_state_dict": policy.critic} if policy.critic else {})


def settings_of(name: str) -> "TeacherCfg":
    """Settings of the training of what a run begins from, for one that asks for no preset.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no teacher, or its settings are not of this version.
    """
    from vd.envs.cfg import ReorientCfg
    from vd.train.config import PolicyCfg, PpoCfg
    from vd.train.presets import gpu

    path = find_start(name)
    state = read_start(path)
    if not state["learner"]:
        raise ValueError(f"--init: {path} does not say how it was trained; add --preset")
    try:
        base = gpu()
        task = ReorientCfg.of_task(state["task"])
        curriculum = base.env.curriculum
        if task.table.lift_share == 0.0:  # nothing is off a table
            curriculum = replace(curriculum, object_weight=1.0)
        env = replace(task, curriculum=curriculum)
        learner = state["learner"]
        settings = dict(learner["ppo"])
        settings.pop("imitation_iterations", None)  # how the installed policies began
        ppo = from_dict(PpoCfg, settings, where="learner.ppo")
        policy = from_dict(PolicyCfg, learner["policy"], where="learner.policy")
    except ValueError as error:
        raise ValueError(
            f"--init: {path} was written by another version ({error}); add --preset and the "
            "settings that it was trained with"
        ) from error
    run = replace(base.run, out=Path("runs") / f"from-{Path(name).stem}")
    return replace(base, run=run, ppo=ppo, policy=policy, env=env)


def take_critic(learner: "TeacherPPO", state: Mapping[str, Any]) -> int:
    """Take over critic and optimiser, as far as they are there and fit.

    A critic that begins from nothing begins with the actor's normalisation, if it reads the same.

    Args:
        learner: Of the run that begins.
        state: A checkpoint, or a policy without an optimiser, and maybe without a critic.

    Returns:
        Iterations in which the critic has to learn alone first.
    """
    own = learner.critic.state_dict()
    critic = state.get("critic_state_dict")
    if critic is not None and critic[FIRST_LAYER].shape == own[FIRST_LAYER].shape:
        learner.critic.load_state_dict(critic)
        if "optimizer_state_dict" not in state:
            return MOMENTS_WARMUP
        learner.optimizer.load_state_dict(state["optimizer_state_dict"])
        return int(state.get("critic_warmup", 0))  # what its own run still lacked
    actor = state["actor_state_dict"]
    mean = "obs_normalizer._mean"
    if mean in actor and actor[mean].shape == own[mean].shape:
        normaliser = {name: actor[name] for name in own if name.startswith("obs_normalizer.")}
        learner.critic.load_state_dict(normaliser, strict=False)
    return CRITIC_WARMUP


def first_levels(state: Mapping[str, Any], asked: tuple[float, ...] | None) -> dict[str, float]:
    """Levels of the curriculum at which a run begins: those asked for, or those of ``state``.

    Raises:
        ValueError: A level is not within 0 and 1.
    """
    if asked is None:
        return dict(state["stage"])
    if not all(0.0 <= level <= 1.0 for level in asked):
        given = " ".join(f"{level:g}" for level in asked)
        raise ValueError(f"--init-levels is {given}; levels lie within 0 and 1")
    return dict(zip(LEVELS, asked, strict=True))


def check_fit(
    state: Mapping[str, Any], spec: "PolicySpec", task: Mapping[str, Any], path: str | Path
) -> None:
    """Refuse what a run cannot go on with.

    Raises:
        ValueError: Another hand, or an actor of another shape; with the remedy.
    """
    from vd.envs.cfg import ObservationCfg
    from vd.policy.contract import PolicySpec

    trained = from_dict(PolicySpec, state["policy"], where="policy")
    hand = state["task"].get("hand")
    here = task.get("hand")
    if trained.num_actions != spec.num_actions:
        raise ValueError(
            f"--init: {path} moves {trained.num_actions} joints of {hand}, and this run's hand, "
            f"{here}, has {spec.num_actions}; give --hand {hand}"
        )
    from_dict(
        ObservationCfg,
        state["task"].get("observation", {}),
        where=f"--init: {path}: task.observation",
    )
    for name in ("hidden", "distribution", "normalise_observations"):
        theirs = getattr(trained, name)
        ours = getattr(spec, name)
        if theirs != ours:
            flag = f"--policy.{name.replace('_', '-')}"
            raise ValueError(f"--init: {path} has {flag} {theirs}, and this run {ours}; {REMEDY}")
    if trained.num_observations != spec.num_observations:
        raise ValueError(
            f"--init: {path} reads {trained.num_observations} values and this run observes "
            f"{spec.num_observations}: {REMEDY}"
        )


def unlike(trained: Mapping[str, Any], task: Mapping[str, Any]) -> list[str]:
    """Settings that change what observations and actions mean, each with what it was and is.

    Such as ``env.observation.view goal, here world``. A run may want them changed; so they are no
    errors. What is younger than the policy's file counts as it is by default, as it does where the
    file is read.
    """
    from vd.envs.cfg import ReorientCfg

    before = _senses(to_dict(ReorientCfg())) | _senses(trained)
    changed = []
    for name, here in _senses(task).items():
        if name in before and before[name] != here:
            changed.append(f"{name} {before[name]}, here {here}")
    return changed


def _senses(task: Mapping[str, Any]) -> dict[str, Any]:
    """What decides what observations and actions mean, by dotted names."""
    return dict(leaves({name: task[name] for name in _SENSES if name in task}, "env"))
