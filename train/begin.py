"""Beginning a run with the networks of another: of a checkpoint, or of an exported policy."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.config import from_dict, to_dict

if TYPE_CHECKING:
    from vd.policy import PolicySpec
    from vd.train.presets import TeacherCfg

CRITIC_WARMUP = 50
"""Iterations in which a critic that begins from nothing learns alone. Its targets hold its own values of up
to 8 steps later, 4.5 in the mean, so an error of states that last shrinks by gamma^4.5 a time: to a tenth."""
MOMENTS_WARMUP = 3
"""Iterations of it where only the optimiser is missing: about a hundred steps, for Adam's second moment."""
FINE_KL, FINE_LEARNING_RATE = 0.03, 1e-4
"""Divergence and first rate of a policy that has learned, for one that does not say how it was trained."""
_APPENDED = {"history": 0, "dynamics": "none"}
"""Settings of the observation whose values come last, as they are in a policy without them."""
_SENSES = ("fingertip", "hand_layer", "sim", "action", "observation")
"""Parts of a task that say what a policy's observations and actions mean."""


def find_start(name: str, flag: str = "--init") -> Path:
    """The file that ``--init`` names: an installed policy, a file, or the best checkpoint of a run's folder.

    Args:
        name: What is named.
        flag: What asked for it, for messages.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is a student or a bundle.
    """
    from vd.bundle import is_bundle
    from vd.evaluate.agents import SHIPPED_POLICIES, find_policy
    from vd.train.checkpoint import BEST_NAME, CHECKPOINT_FOLDER

    best = Path(name) / CHECKPOINT_FOLDER / BEST_NAME
    if name not in SHIPPED_POLICIES and best.is_file():
        return best
    try:
        path = find_policy(name)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{flag}: {error}") from error
    if is_bundle(path):
        raise ValueError(f"{flag}: {name} is a bundle; give the policy or checkpoint that it was made from")
    return path


def settings_of(name: str, base: "TeacherCfg") -> "TeacherCfg":
    """Settings with which a run goes on as what it begins from was trained, where no preset is asked for.

    Task and networks are those of the file. So is the learner, if the file says; else it is that of ``base``,
    with the small steps of a policy that has learned.

    Args:
        name: What ``--init`` names.
        base: Settings for what the file does not say.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no teacher, or its settings are not of this version.
    """
    from vd.envs.cfg import ReorientCfg
    from vd.policy import PolicySpec
    from vd.train.checkpoint import load_checkpoint
    from vd.train.config import PolicyCfg, PpoCfg

    path = find_start(name)
    state = load_checkpoint(path, flag="--init")
    try:
        env = from_dict(ReorientCfg, state["task"], where="task")
        if "learner" in state:
            learner = state["learner"]
            ppo = from_dict(PpoCfg, learner["ppo"], where="learner.ppo")
            policy = from_dict(PolicyCfg, learner["policy"], where="learner.policy")
        else:
            spec = from_dict(PolicySpec, state["policy"], where="policy")
            ppo = replace(base.ppo, desired_kl=FINE_KL, actor_learning_rate=FINE_LEARNING_RATE)
            policy = replace(base.policy, **_networks(spec))
            if (
                spec.distribution == "gaussian"
            ):  # it has learned its std, and whatever bounds it had are unknown
                policy = replace(policy, std_range=PolicyCfg().std_range, quiet_std=None)
    except ValueError as error:
        raise ValueError(
            f"--init: {path} was written by another version ({error}); add --preset and the settings that it "
            "was trained with"
        ) from error
    run = replace(base.run, out=Path("runs") / f"from-{Path(name).stem}")
    return replace(
        base,
        run=run,
        ppo=replace(ppo, critic_warmup_iterations=None, imitation_iterations=0),
        policy=policy,
        env=env,
    )


def warmup_iterations(state: Mapping[str, Any], wanted: int | None) -> int:
    """Iterations in which the critic is to learn alone after a begin from ``state``.

    Args:
        state: Checkpoint or exported policy.
        wanted: What ``--ppo.critic-warmup-iterations`` asks for; None: what the state needs.
    """
    if wanted is not None:
        return wanted
    if "critic_state_dict" not in state:
        return CRITIC_WARMUP
    if "optimizer_state_dict" not in state:
        return MOMENTS_WARMUP
    return int(state.get("critic_warmup", 0))  # what its own run still lacked


def completed(state: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """An exported policy as a checkpoint: what it lacks is that of a run which begins.

    The critic reads what the actor reads, so where it is missing it begins with the actor's normalisation.
    A policy without a stage of the curriculum has come to the end of it.

    Args:
        state: The policy, of as many observations as the run; a whole checkpoint passes unchanged.
        own: Networks, optimiser and window of the run: ``critic_state_dict``, ``optimizer_state_dict``,
            ``window``.
    """
    if "critic_state_dict" not in state:
        critic = own["critic_state_dict"]
        normaliser = {
            k: v
            for k, v in state["actor_state_dict"].items()
            if k.startswith("obs_normalizer.") and v.shape == critic[k].shape
        }
        # One that reads more begins with a normalisation of its own.
        state = state | {"critic_state_dict": critic | (normaliser if len(normaliser) == 4 else {})}
    if "optimizer_state_dict" in state:
        return state
    tightening = state["task"].get("curriculum", {}).get("tightening", {}).get("enabled", False)
    stage = state.get("stage", {"difficulty": 1.0, "tightness": 1.0, "tightening": tightening})
    return state | {
        "optimizer_state_dict": own["optimizer_state_dict"],
        "elapsed_s": 0.0,
        "best": None,
        "window": own["window"],
        "ranks": [{"env": stage}],
        "infos": None,
    }


def at_stage(state: dict[str, Any], stage: tuple[float, float]) -> dict[str, Any]:
    """A checkpoint whose curriculum has come to another difficulty and tightness.

    Raises:
        ValueError: They are not within 0 and 1.
    """
    if not all(0.0 <= value <= 1.0 for value in stage):
        raise ValueError(
            f"--init-stage is {stage[0]:g} {stage[1]:g}; difficulty and tightness lie within 0 and 1"
        )
    difficulty, tightness = stage
    moved = {"difficulty": difficulty, "tightness": tightness, "tightening": True}
    return state | {"ranks": [rank | {"env": rank["env"] | moved} for rank in state["ranks"]]}


def check_fit(state: Mapping[str, Any], spec: "PolicySpec", task: Mapping[str, Any], path: str) -> None:
    """Refuse networks that a run cannot take over, with the flag that would let it.

    Raises:
        ValueError: Another hand, or networks of another shape.
    """
    from vd.envs.cfg import ObservationCfg
    from vd.policy import PolicySpec

    found = from_dict(PolicySpec, state["policy"], where="policy")
    hand, here = state["task"].get("hand"), task.get("hand")
    if found.num_actions != spec.num_actions:
        raise ValueError(
            f"--init: {path} moves {found.num_actions} joints of {hand}, and this run's hand, {here}, has "
            f"{spec.num_actions}; give --hand {hand}"
        )
    if found.activation != spec.activation:
        raise ValueError(f"--init: {path} has {found.activation} units, this version {spec.activation} alone")
    wanted, given = _networks(found), _networks(spec)
    for name, value in wanted.items():
        if value != given[name]:
            flag = f"--policy.{name.replace('_', '-')}"
            words = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
            raise ValueError(
                f"--init: the networks of {path} have {flag} {words}, those of this run {given[name]}; "
                f"give {_as_flag(flag, value, words)}, or leave --preset out to go on with its settings"
            )
    seen = from_dict(ObservationCfg, state["task"].get("observation", {}), where="task.observation")
    before, now = (
        {name: t.get("observation", {}).get(name, default) for name, default in _APPENDED.items()}
        for t in (state["task"], task)
    )
    if before not in (_APPENDED, now):
        raise ValueError(
            f"--init: {path} observes {_flags(before)} and this run {_flags(now)}; only a policy "
            "without them can go on with others: give those of the policy"
        )
    if found.num_observations > spec.num_observations:
        observed = _flags(to_dict(seen))
        raise ValueError(
            f"--init: {path} reads {found.num_observations} values and this run observes "
            f"{spec.num_observations}, but a run can only go on with more; give what it was trained with: "
            f"--hand {hand} {observed}"
        )


def unlike(trained: Mapping[str, Any], task: Mapping[str, Any]) -> list[str]:
    """Settings that change what observations and actions mean to a policy, each with what it was and is.

    Such as ``env.observation.view goal, here world``. A run may want them changed; so they are no errors.
    What is younger than the policy's file counts as it is by default, as it does where the file is read.
    """
    from vd.envs.cfg import ReorientCfg

    default, before, now = (
        dict(_leaves({k: t[k] for k in _SENSES if k in t}, "env"))
        for t in (to_dict(ReorientCfg()), trained, task)
    )
    before = {k: default[k] for k in now if k in default} | before
    return [f"{k} {before[k]}, here {now[k]}" for k in before if k in now and before[k] != now[k]]


def _networks(spec: "PolicySpec") -> dict[str, Any]:
    """The settings of ``PolicyCfg`` that a network's shape decides."""
    names = ("hidden", "distribution", "normalise_observations")
    return {name: getattr(spec, name) for name in names}


def _flags(settings: Mapping[str, Any]) -> str:
    return " ".join(f"--env.observation.{name} {value}" for name, value in settings.items())


def _as_flag(flag: str, value: Any, words: str) -> str:
    """``flag`` as it is typed."""
    if isinstance(value, bool):
        group, _, name = flag.rpartition(".")
        return flag if value else f"{group}.no-{name}"
    return f"{flag} {words}"


def _leaves(values: Mapping[str, Any], where: str) -> Iterator[tuple[str, Any]]:
    """Values by dotted path."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{where}.{key}")
        else:
            yield f"{where}.{key}", list(value) if isinstance(value, tuple) else value
