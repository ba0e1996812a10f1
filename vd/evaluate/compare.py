"""Run policies through the same episodes, and judge each by the rules that stop it."""

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from datetime import date
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.command.device import resolve_device
from vd.command.functions import named_function
from vd.command.warp_quiet import quiet_warp
from vd.evaluate.cfg import LOG_EVERY_S, EvalCfg, parse_groups
from vd.evaluate.conditions import in_condition
from vd.policy.agents import BUILT_IN, check_fits, open_policy, sees_clouds, task_for
from vd.sim.cfg import in_mujoco

if TYPE_CHECKING:
    from vd.envs.cfg import ReorientCfg
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.goals import Goals
    from vd.evaluate.result import Agent, Protocol, Result
    from vd.evaluate.trace import Trace

# Environments simulated at once by default: enough to keep the device busy, few enough to fit
# anywhere. Images and clouds take memory, and who plans simulates hundreds for each.
ENVS_CPU = 64
ENVS_GPU = 8192
ENVS_CAMERA_GPU = 1024
ENVS_PLAN = 128
_PACKAGES = ("visual-dexterity", "newton", "warp-lang", "mujoco-warp", "mujoco", "torch")


def device_of(cfg: EvalCfg) -> str:
    """Where an evaluation runs."""
    return resolve_device("cpu" if cfg.engine == "mujoco" else cfg.device)


def open_agents(cfg: EvalCfg) -> dict[str, Any]:
    """The policies of an evaluation by name; None for an agent without a file."""
    return {name: open_policy(name, device_of(cfg)) for name in cfg.agent_names}


def compare(
    cfg: EvalCfg, condition: str = "", policies: Mapping[str, Any] | None = None
) -> "Result":
    """Run an evaluation, of a suite under ``condition``, and write its JSON into ``cfg.out``.

    Args:
        cfg: Its settings.
        condition: Name of the suite's line.
        policies: What :func:`open_agents` gave; None: they are opened here.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
        vd.sim.simulator.SimulationError: Contacts were lost.
    """
    quiet_warp()
    # A file that cannot be used, or is of another hand, is told before the simulator is imported.
    device = device_of(cfg)
    policies = open_agents(cfg) if policies is None else policies
    for name, policy in policies.items():
        check_fits(name, policy, cfg.hand, cfg.hand_layer)
    from vd.assets_usd.objects.sets import set_files
    from vd.command.versions import MEASURING, SEEING
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.result import Result, judge
    from vd.evaluate.symmetry import with_symmetries

    groups = parse_groups(cfg.object_sets)
    everything = tuple(dict.fromkeys(chain(*groups.values())))
    files = set_files(everything)
    camera = any(map(sees_clouds, policies.values()))
    envs = cfg.num_envs or envs_for(len(files), cfg.episodes, device, camera=camera, plan=cfg.plan)
    rows = []
    env: ReorientEnv | None = None
    start: dict[str, Any] = {}
    for name, policy in policies.items():
        task = task_of(cfg, policy, everything, envs)
        if env is None or env.cfg != task:
            print(
                "building the environments (the first start compiles kernels: minutes)",
                file=sys.stderr,
            )
            if env is not None:
                env.close()
            env = ReorientEnv(task, device)
            env.objects = with_symmetries(env.objects, device)
            start = env.state_dict()
        env.load_state_dict(start)
        actor, agent = actor_of(
            name, policy, env, goals=cfg.goals, sensor_errors=cfg.sensor_errors, seed=cfg.seed
        )
        if cfg.plan:
            actor, agent = planning(actor, agent, env, cfg.seed)
        trace = run_episodes(cfg, env, actor, agent)
        for group, sets in groups.items():
            chosen = list(map(files.index, set_files(sets)))
            objects = [env.objects[number] for number in chosen]
            protocol = _protocol(cfg, task, sets, agent.sees)
            rows += judge(
                trace.of(chosen), protocol, objects, agent, group=group, condition=condition
            )
    assert env is not None, "there is a policy"
    env.close()
    result = Result(tuple(rows), software_of(device, SEEING if camera else MEASURING))
    result.write(cfg.out / "eval.json")
    return result


def software_of(device: str, code: tuple[str, ...]) -> dict[str, str]:
    """With what, where and when something is measured, by the packages ``code`` of ours."""
    import warp as wp

    from vd.command.versions import code_fingerprint, installed_versions

    measured = {
        "device": wp.get_device(device).name,
        "date": f"{date.today()}",
        "code": code_fingerprint(code),
    }
    return measured | installed_versions(_PACKAGES)


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
        episode_s=cfg.schedule.length_s,
        randomised=True,
        success_ends_episode=True,
        at_rest=cfg.rest,
        hand_layer=cfg.hand_layer,
        condition=cfg.randomisation,
        failures_per_million=1e6,  # whose episodes end there, and are counted
    )
    if cfg.condition is not None:
        task = in_condition(task, cfg.condition)
    if cfg.table_friction is not None:
        task = replace(task, table_friction=cfg.table_friction)
    if cfg.engine == "mujoco":
        task = replace(task, sim=in_mujoco(task.sim))
    return task


def _protocol(cfg: EvalCfg, task: "ReorientCfg", sets: tuple[str, ...], sees: str) -> "Protocol":
    """How the episodes of one policy with the objects of a group are run."""
    from vd.assets_usd.hands import load_hand
    from vd.evaluate.result import Protocol

    return Protocol(
        objects=", ".join(sets),
        hand=task.hand,
        hand_layer=task.hand_layer,
        episodes=cfg.episodes,
        seed=cfg.seed,
        max_goal_angle_rad=cfg.max_goal_angle,
        stop_tolerance_rad=cfg.stop_tolerance,
        episode_s=cfg.schedule.goal_s if cfg.consecutive else task.episode_s,
        control_hz=task.sim.control_hz,
        randomisation=cfg.condition or "off",
        at_rest=task.start.at_rest,
        goals_about_vertical=task.start.at_rest and task.goal.about_vertical,
        palm_up=load_hand(task.hand).palm_up,
        in_air=cfg.in_air,
        air_goals=cfg.air_goals,
        consecutive=cfg.consecutive,
        table_friction=cfg.table_friction,
        goals=cfg.goals,
        sensor_errors=cfg.sensor_errors and sees == "rendered clouds",
        engine=cfg.engine,
    )


def actor_of(
    name: str,
    policy: Any | None,
    env: "ReorientEnv",
    *,
    goals: "Goals" = "points",
    sensor_errors: bool = False,
    seed: int = 0,
) -> tuple[Any, "Agent"]:
    """What acts in an environment, and who that is.

    A camera policy with ``goals`` and ``sensor_errors``.
    """
    from vd.evaluate.result import Agent
    from vd.policy.actor import BuiltIn, FunctionPolicy
    from vd.policy.stopping import StoppingRule

    if policy is None and name not in BUILT_IN:
        function = FunctionPolicy(named_function(name, "the policy"), env.num_actions)
        return function, Agent(name, "function", "state", StoppingRule)
    if policy is None:
        actor = BuiltIn(name, env.num_actions, seed=seed, device=env.device)
        return actor, Agent(name, name, "nothing", StoppingRule)
    if not sees_clouds(policy):
        return policy, Agent(name, "teacher", "state", StoppingRule)
    from vd.command.workers import one_thread_without_gpu
    from vd.evaluate.camera_actor import CameraActor

    one_thread_without_gpu(env.device)
    eyes = CameraActor(env, policy, goals=goals, sensor_errors=sensor_errors, seed=seed)
    return eyes, Agent(name, policy.kind, "rendered clouds", policy.spec.rule_for)


def planning(actor: Any, agent: "Agent", env: "ReorientEnv", seed: int) -> tuple[Any, "Agent"]:
    """A controller that plans by sampling, to which a teacher proposes; ``zero`` proposes nothing.

    Raises:
        ValueError: The agent sees by camera, or acts at random.
    """
    from vd.evaluate.sampling import SamplingController

    if agent.kind not in ("teacher", "zero"):
        raise ValueError(f"--plan is for teachers and zero, not for {agent.policy}")
    proposes = actor if agent.kind == "teacher" else None
    planner = SamplingController(env, policy=proposes, seed=seed)
    return planner, replace(agent, policy=f"{agent.policy} --plan", sees="state")


def run_episodes(cfg: EvalCfg, env: "ReorientEnv", actor: Any, agent: "Agent") -> "Trace":
    """All episodes of one policy, with a progress bar."""
    from tqdm import tqdm

    from vd.evaluate.rollout import draw_starts_and_goals, draw_turns
    from vd.evaluate.trace import record

    schedule = cfg.schedule
    draw: dict[str, Any] = {"seed": cfg.seed, "max_goal_angle": cfg.max_goal_angle}
    names = [item.name for item in env.objects]
    starts = goals = turns = None
    if not env.cfg.start.at_rest:  # such starts are the environment's to draw
        starts, goals = draw_starts_and_goals(names, cfg.episodes, **draw)
    if schedule.most > 1:
        turns = draw_turns(names, cfg.episodes, schedule.most, **draw)
    ways = agent.ways_to_stop(cfg.stop_tolerance, schedule).values()
    rounds = math.ceil(cfg.episodes / (env.num_envs // len(env.objects)))
    with tqdm(
        total=rounds * env.max_episode_steps,
        unit="step",
        desc=Path(agent.policy).name or agent.policy,
        mininterval=0.5 if sys.stderr.isatty() else LOG_EVERY_S,
    ) as bar:
        trace = record(
            env,
            actor,
            cfg.episodes,
            schedule,
            ways=[way for way in ways if way[1] != "success"],
            tolerance=cfg.stop_tolerance,
            turns=turns,
            starts=starts,
            goals=goals,
            on_step=bar.update,
        )
    env.check()
    return trace


def envs_for(
    num_objects: int, episodes: int, device: str, *, camera: bool = False, plan: bool = False
) -> int:
    """Environments to simulate at once.

    The same number for every object, at most one for each episode.
    """
    limit = ENVS_CAMERA_GPU if camera else ENVS_GPU
    if device == "cpu":
        limit = ENVS_CPU
    if plan:
        limit = min(limit, ENVS_PLAN)
    return num_objects * max(1, min(episodes, limit // num_objects))
