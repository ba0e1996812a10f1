"""Run policies through the same episodes, and judge each by the rules that stop it."""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.evaluate.agents import (
    BUILT_IN,
    built_in,
    check_bundle,
    is_tracking_policy,
    open_policy,
    sees_clouds,
    start_at_rest,
    task_for,
)
from vd.evaluate.cfg import LOG_EVERY_S, WORLDS_CPU, WORLDS_GPU, EvalCfg, parse_groups
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.envs.cfg import ReorientCfg
    from vd.evaluate.comparison import Comparison
    from vd.evaluate.result import Protocol
    from vd.evaluate.trace import Trace
    from vd.stopping import StoppingRule

STUDENT_WORLDS_GPU = 1024
"""Environments at once by default where a student looks at them: depth images and clouds take memory."""
_PACKAGES = ("visual-dexterity", "newton", "warp-lang", "mujoco-warp", "torch")


def compare(cfg: EvalCfg, stop_at: float = math.inf) -> "Comparison":
    """Run an evaluation and write its JSON and page into ``cfg.out``.

    Args:
        cfg: Settings of the command line.
        stop_at: When to give up [s], on the monotonic clock.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
        vd.sim.simulator.SimulationError: Contacts were lost, or a world left the finite numbers.
        TimeoutError: It was to give up.
    """
    quiet_warp()
    from vd.device import resolve_device

    device = resolve_device(cfg.device)
    # A file that cannot be used is told before the simulator is imported.
    policies = {name: open_policy(name, device) for name in cfg.agent_names}
    from vd.assets_usd.objects.sets import load_set
    from vd.assets_usd.objects.sheet import pictures
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.comparison import Comparison, judge
    from vd.evaluate.comparison_page import write_comparison
    from vd.tracking.symmetry import with_symmetries

    groups = parse_groups(cfg.object_sets)
    everything = tuple(dict.fromkeys(s for sets in groups.values() for s in sets))
    members = {name: [item.name for item in load_set(list(sets))] for name, sets in groups.items()}
    count = len(load_set(list(everything)))
    limit = STUDENT_WORLDS_GPU if device != "cpu" and any(map(sees_clouds, cfg.agent_names)) else None
    envs = cfg.num_envs or worlds_for(count, cfg.episodes, device, limit=limit)
    rows, predictions = [], []
    env: Any = None
    task, start = None, None
    for name, policy in policies.items():
        wanted = task_of(cfg, policy, everything, envs)
        check_bundle(name, wanted)
        if task != wanted:
            print("building the environments (the first start compiles kernels: minutes)", file=sys.stderr)
            if env is not None:
                env.close()
            env = ReorientEnv(wanted, device)
            env.objects = with_symmetries(env.objects, device)
            task, start = wanted, env.state_dict()
        env.load_state_dict(start)
        actor, kind, sees, rules = actor_of(cfg, name, policy, env, device)
        trace = run_episodes(cfg, env, actor, name, rules, stop_at)
        protocol = _protocol(cfg, name, wanted, sees)
        index = {item.name: number for number, item in enumerate(env.objects)}
        for group, sets in groups.items():
            chosen = [index[member] for member in members[group]]
            found, prediction = judge(
                trace.of(chosen),
                replace(protocol, objects=", ".join(sets)),
                [env.objects[number] for number in chosen],
                kind=kind,
                sees=sees,
                group=group,
                rules=rules,
                resample=cfg.resample,
            )
            rows += found
            predictions += [] if prediction is None else [prediction]
    env.close()
    comparison = Comparison(tuple(rows), tuple(predictions), software=_software(device))
    comparison.write(cfg.out / "eval.json")
    write_comparison(comparison, cfg.out / "eval.html", pictures=pictures(env.objects))
    return comparison


def task_of(cfg: EvalCfg, policy: Any | None, sets: tuple[str, ...], envs: int) -> "ReorientCfg":
    """The task of one policy, in which no state ends an episode but a fall."""
    from vd.evaluate.trace import NEVER_RAD

    task = task_for(
        policy,
        hand=cfg.hand,
        objects=sets,
        num_envs=envs,
        seed=cfg.seed,
        stop_tolerance_rad=NEVER_RAD,
        max_goal_angle_rad=cfg.max_goal_angle,
        episode_s=cfg.limit_s,
        randomised=cfg.randomised,
        success_ends_episode=True,
        at_rest=start_at_rest(cfg.at_rest, cfg.no_at_rest),
        hand_layer=cfg.hand_layer,
        second_view=cfg.second_view,
        condition=cfg.randomisation,
    )
    if cfg.table_friction is not None:
        task = replace(task, table_friction=cfg.table_friction)
    if cfg.randomised:
        return task
    # Noise that is switched off anyway, and would keep a teacher and its student from sharing environments.
    exact = replace(
        task.randomisation,
        observation_noise_mean=0.0,
        observation_noise_std=0.0,
        observation_offset_std=0.0,
    )
    return replace(task, randomisation=exact)


def _protocol(cfg: EvalCfg, name: str, task: "ReorientCfg", sees: str) -> "Protocol":
    """How the episodes of one policy are run; its objects are those of a group."""
    from vd.evaluate.result import Protocol

    return Protocol(
        policy=name,
        objects="",
        hand=task.hand,
        hand_layer=task.hand_layer,
        episodes=cfg.episodes,
        seed=cfg.seed,
        max_goal_angle_rad=cfg.max_goal_angle,
        stop_tolerance_rad=cfg.stop_tolerance,
        episode_s=task.episode_s,
        control_hz=task.sim.control_hz,
        randomised=cfg.randomised,
        at_rest=task.start.at_rest,
        goals_about_vertical=task.start.at_rest and task.goal.about_vertical,
        in_air=cfg.in_air,
        table_friction=cfg.table_friction,
        goals=cfg.goals,
        sensor_errors=cfg.sensor_errors and sees == "rendered clouds",
        second_view=cfg.second_view and name not in BUILT_IN,
        condition=cfg.condition,
    )


def actor_of(cfg: EvalCfg, name: str, policy: Any | None, env: Any, device: str) -> tuple[Any, str, str, Any]:
    """What acts, its kind, what it sees, and its rules to stop, by tolerance."""
    from vd.policy import TrainedPolicy
    from vd.stopping import StoppingRule

    if name in BUILT_IN:
        return built_in(name, env.num_actions, seed=cfg.seed, device=device), name, "nothing", StoppingRule
    if isinstance(policy, TrainedPolicy):
        if cfg.second_view:
            from vd.evaluate.second_view import SecondView

            return SecondView(env, policy), "teacher", "state", StoppingRule
        return policy, "teacher", "state", StoppingRule
    from vd.workers import one_thread_without_gpu

    assert policy is not None
    one_thread_without_gpu(device)
    if is_tracking_policy(policy):
        from vd.evaluate.tracking import TrackingActor

        if cfg.sees == "complete":
            raise ValueError(f"--sees complete: {name} tracks by a depth camera; leave it out")
        tracker = TrackingActor(
            env,
            policy,
            goals=cfg.goals,
            sensor_errors=cfg.sensor_errors,
            second_view=cfg.second_view,
            seed=cfg.seed,
        )
        return tracker, "tracking", "rendered clouds", policy.spec.rule_for
    from vd.evaluate.student import StudentActor

    rendered = None if cfg.sees == "auto" else cfg.sees == "rendered"
    actor = StudentActor(
        env,
        policy,
        rendered=rendered,
        goals=cfg.goals,
        sensor_errors=cfg.sensor_errors,
        seed=cfg.seed,
    )
    sees = "rendered clouds" if actor.rendered else "complete clouds"
    return actor, f"student of stage {policy.spec.stage}", sees, policy.spec.rule_for


def run_episodes(
    cfg: EvalCfg,
    env: Any,
    actor: Any,
    name: str,
    rules: Callable[[float], "StoppingRule"],
    stop_at: float,
) -> "Trace":
    """All episodes of one policy, with a progress bar.

    Raises:
        TimeoutError: The monotonic clock has come to ``stop_at`` [s].
    """
    import numpy as np
    from tqdm import tqdm

    from vd.evaluate.comparison import ways_to_stop
    from vd.evaluate.result import air_table_steps
    from vd.evaluate.rollout import draw_starts_and_goals
    from vd.evaluate.trace import record

    starts, goals = None, None
    if not env.cfg.start.at_rest:
        drawn = [
            draw_starts_and_goals(item.name, cfg.episodes, seed=cfg.seed, max_goal_angle=cfg.max_goal_angle)
            for item in env.objects
        ]
        starts, goals = (np.stack([pair[i] for pair in drawn]) for i in range(2))
    rounds = math.ceil(cfg.episodes / (env.num_envs // len(env.objects)))
    refresh = 0.5 if sys.stderr.isatty() else LOG_EVERY_S
    title = Path(name).name or name
    ways = ways_to_stop(rules, cfg.stop_tolerance, predicts=hasattr(actor, "predicted"))
    with tqdm(total=rounds * env.max_episode_steps, unit="step", desc=title, mininterval=refresh) as bar:

        def stepped() -> None:
            bar.update()
            if time.monotonic() > stop_at:
                raise TimeoutError(f"{title} did not end in the time that was left")

        trace = record(
            env,
            actor,
            cfg.episodes,
            starts=starts,
            goals=goals,
            table_steps=air_table_steps(env.cfg.sim.control_hz) if cfg.in_air else None,
            held=[(way.rule, way.by) for way in ways if way.by != "success"],
            on_step=stepped,
        )
    env.check()
    return trace


def worlds_for(num_objects: int, episodes: int, device: str, *, limit: int | None = None) -> int:
    """Environments to simulate at once: the same number for every object, at most one for each episode."""
    limit = limit or (WORLDS_CPU if device == "cpu" else WORLDS_GPU)
    return num_objects * max(1, min(episodes, limit // num_objects))


def _software(device: str) -> dict[str, str]:
    """The device and the versions of what runs."""
    import warp as wp

    from vd.versions import installed_versions

    return {"device": wp.get_device(device).name} | installed_versions(_PACKAGES)
