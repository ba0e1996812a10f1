"""Command line of evaluation: ``vd-eval POLICY ... --objects SET ... --episodes M``."""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vd import interrupt
from vd.device import resolve_device
from vd.evaluate.agents import (
    LAYER_HELP,
    SHIPPED_POLICIES,
    check_names,
    check_second_view,
    episode_limit_s,
    sees_clouds,
    start_at_rest,
)
from vd.evaluate.compare import parse_groups
from vd.evaluate.conditions import CONDITIONS, Condition
from vd.evaluate.goals import Goals
from vd.files import check_folder
from vd.paper import PAPER
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.envs.cfg import RandomisationCfg
    from vd.evaluate.result import EvalResult

# Worlds simulated at once by default: enough to keep the device busy, few enough to fit anywhere.
WORLDS_CPU, WORLDS_GPU = 64, 8192
# Seconds between progress lines where they go to a file.
LOG_EVERY_S = 10.0
DEFAULT_OBJECTS = ("cube",)
OF_THE_SUITE = (
    "episodes",
    "max_goal_angle",
    "at_rest",
    "no_at_rest",
    "stop_tolerance",
    "episode_s",
    "in_air",
    "aim",
    "table_friction",
    "condition",
    "goals",
    "sensor_errors",
    "second_view",
    "sees",
)
"""Settings that a suite decides."""
POLICY_HELP = (
    "A policy.pt or student.pt, a checkpoint, the folder of a bundle or of a run, or the name of an "
    f"installed policy: {', '.join(SHIPPED_POLICIES)}."
)
"""What names a policy on a command line."""
_PACKAGES = ("visual-dexterity", "newton", "warp-lang", "mujoco-warp", "torch")


@dataclass
class EvalCfg:
    """Evaluate policies: every object from the same starts to the same goals, whatever the policy.

    Objects fall into the hand from orientations uniform on SO(3), or, with --at-rest, lie on the table.

    Writes eval.json (every episode) and eval.html (one page with figures) and prints a table. A single
    teacher is stopped, and its error measured, at the first step at which all success criteria hold.
    Camera policies, several policies, groups of objects and --in-air are compared side by side: the former
    stop by the distance that they predict and, for comparison, by the true one.

    --suite paper runs all of the paper's evaluations in simulation and writes paper.json and paper.html, its
    figures beside ours. What is finished is not repeated by the next call.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(help=POLICY_HELP)] = ()
    agent: str | None = None
    """zero or random, alone or beside policies."""
    suite: Literal["paper"] | None = None
    """Run the paper's evaluations, on the installed policies if none is named. --objects training=FOLDER
    held-out=FOLDER names the objects; without, our procedural sets stand for them."""
    quick: tyro.conf.FlagCreatePairsOff[bool] = False
    """Of the suite only a part, with few objects and episodes: minutes on two CPU cores."""
    jobs: int = 1
    """Of a suite, evaluations side by side, each in a process of its own, spread over the GPUs."""
    objects: tuple[str, ...] = ()
    """Object sets by name, folders or files (vd-assets makes them); cube by default. NAME=SET puts one into a
    group, which gets figures of its own: training=FOLDER held-out=FOLDER symmetric=symmetric."""
    episodes: int = 20
    """Starts and goals of every object."""
    hand: str | None = None
    """dclaw3, dclaw4 or a hand's USD; by default the policy's, or dclaw4."""
    hand_layer: Annotated[str | None, tyro.conf.arg(help=LAYER_HELP)] = None
    seed: int = 0
    """Seed of starts, goals and everything else random."""
    max_goal_angle: float = math.pi
    """Goals are within this angle [rad] of the start; pi is all of SO(3)."""
    at_rest: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start at rest on the table; the default is as trained, and a drop for --agent zero and random. The
    environment draws such starts and their goals; they depend on --num-worlds too."""
    no_at_rest: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start from a drop, whatever the training."""
    stop_tolerance: float = PAPER.success.rotation_rad
    """An episode stops, still and oriented, at this error [rad]; 0.1 for the paper's precise variant."""
    episode_s: float | None = None
    """Time limit of an episode [s]; 10 by default, 15 with --in-air."""
    in_air: tyro.conf.FlagCreatePairsOff[bool] = False
    """Take the table away after 2 s, as in the paper's test of reorientation in the air."""
    table_friction: float | None = None
    """Coefficient of the table, of which contacts with objects get the mean of the two; 0.5 by default."""
    aim: tyro.conf.FlagCreatePairsOff[bool] = False
    """Ours: aim past the goal while the object is near it; more come within 0.1 rad."""
    second_view: tyro.conf.FlagCreatePairsOff[bool] = False
    """Ours: where a policy has not come to its goal in 3 s, look at it once a second from other fingers'
    sides, or in the mirror, and go on in the view of which its critic, or its teacher's, expects
    most."""
    goals: Goals = "mesh"
    """What camera policies know shapes and goals by: the exact mesh; 500 exact points, as the paper's; or a
    scan, points with 4 mm of noise and a fifth missing. A surface is laid through points."""
    sensor_errors: bool = True
    """Cameras of policies err as a D415 does: noise, gaps, late images, not quite where it is believed
    (docs/depth.md). Without: as in their training."""
    sees: Literal["auto", "complete", "rendered"] = "auto"
    """What students see: complete clouds, a depth camera's, or what their stage was trained on."""
    randomise: bool = False
    """Randomise dynamics and add noise and disturbances as in training."""
    condition: Condition | None = None
    """Evaluate in a named condition, whatever the training: nominal; s3, Table S3; hard, the same with forces
    that last a control step; mixed, Table S3 with friction, backlash, late commands and observations;
    observation-late and command-late, 83 ms and nothing else."""
    resample: Literal["auto", "object", "episode"] = "auto"
    """What intervals speak about: objects (from 8 of them) or episodes within objects."""
    num_worlds: int | None = None
    """Worlds simulated at once; by default as many as episodes, up to 64 on a CPU and 8192 on a GPU (1024 in
    a comparison)."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    output: Path = Path("runs/eval")
    """Folder for eval.json and eval.html."""
    json: bool = False
    """Print protocol and summaries as JSON instead of the table."""

    @property
    def agent_names(self) -> tuple[str, ...]:
        """What is evaluated, each once.

        Raises:
            ValueError: Nothing is named.
        """
        names = tuple(dict.fromkeys((*self.policies, *([] if self.agent is None else [self.agent]))))
        if not names and self.suite is not None:
            return tuple(SHIPPED_POLICIES)
        if not names:
            raise ValueError(
                "name a policy: a file, --agent zero, --agent random, or an installed policy "
                f"({', '.join(SHIPPED_POLICIES)})"
            )
        return names

    @property
    def object_sets(self) -> tuple[str, ...]:
        """The sets of ``objects``, the default included."""
        return self.objects or DEFAULT_OBJECTS

    @property
    def limit_s(self) -> float:
        """Time limit of an episode [s]."""
        return episode_limit_s(self.episode_s, in_air=self.in_air)

    @property
    def randomisation(self) -> "RandomisationCfg | None":
        """What is drawn; None: as trained, if at all."""
        return None if self.condition is None else CONDITIONS[self.condition]

    @property
    def randomised(self) -> bool:
        """Whether anything is drawn."""
        return self.randomise if self.randomisation is None else self.randomisation.enabled

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        if self.episodes < 1:
            raise ValueError(f"--episodes is {self.episodes}; at least 1 is needed")
        if not 0.0 < self.max_goal_angle <= math.pi + 1e-6:
            raise ValueError(
                f"--max-goal-angle is {self.max_goal_angle}; it must be above 0 and at most pi rad"
            )
        if not 0.0 < self.stop_tolerance <= math.pi:
            raise ValueError(
                f"--stop-tolerance is {self.stop_tolerance}; it must be above 0 and at most pi rad"
            )
        if self.limit_s <= 0.0:
            raise ValueError(f"--episode-s is {self.episode_s}; it must be positive")
        if self.table_friction is not None and self.randomise:
            raise ValueError("--table-friction and --randomise exclude each other; give one of them")
        if self.condition is not None and (self.randomise or self.table_friction is not None):
            raise ValueError("--condition excludes --randomise and --table-friction; give one of them")
        if self.table_friction is not None and self.table_friction < 0.0:
            raise ValueError(f"--table-friction is {self.table_friction}; it must not be negative")
        self._validate_suite()
        start_at_rest(self.at_rest, self.no_at_rest)
        if self.num_worlds is not None and self.num_worlds < 1:
            raise ValueError(
                f"--num-worlds is {self.num_worlds}; at least one world for each object is needed"
            )

    def _validate_suite(self) -> None:
        if self.jobs < 1:
            raise ValueError(f"--jobs is {self.jobs}; at least 1 is needed")
        if self.suite is None:
            if self.quick:
                raise ValueError("--quick is of a suite; add --suite paper, or lower --episodes")
            if self.jobs > 1:
                raise ValueError("--jobs is of a suite; add --suite paper, or leave it out")
            return
        default = EvalCfg()
        for name in OF_THE_SUITE:
            if getattr(self, name) != getattr(default, name):
                flag = name.replace("_", "-")
                raise ValueError(f"--{flag} is decided by --suite {self.suite}; leave it out")


@interrupt.command("vd-eval")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-eval``; returns the exit status."""
    cfg = tyro.cli(EvalCfg, args=arguments, prog="vd-eval")
    try:
        cfg.validate()
        names = cfg.agent_names
        check_names(names, chain(*parse_groups(cfg.object_sets).values()), cfg.hand)
        check_folder(cfg.output)
        if cfg.second_view:
            check_second_view(names)
        if cfg.suite is not None:
            return _run_suite(cfg)
        traced = cfg.in_air or cfg.table_friction is not None or cfg.goals != "mesh"
        if len(names) > 1 or traced or "=" in "".join(cfg.objects) or sees_clouds(names[0]):
            if cfg.condition is not None:
                raise ValueError(
                    "--condition is for one teacher, without --in-air and groups; run each alone"
                )
            return _compare(cfg)
        return _evaluate(cfg)
    except (ValueError, OSError, RuntimeError) as error:
        print(f"vd-eval: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        hint = "; the same command goes on from here" if cfg.suite else ""
        print(f"\nvd-eval: interrupted{hint}", file=sys.stderr)
        return interrupt.INTERRUPTED


def _evaluate(cfg: EvalCfg) -> int:
    result = evaluate(cfg)
    from vd.config import to_dict
    from vd.evaluate.report import task_line, terminal_table, warning_lines

    if cfg.json:
        summary = {key: value for key, value in to_dict(result).items() if key != "episodes"}
        print(json.dumps(summary, indent=1))
    else:
        print("\n".join([terminal_table(result), *warning_lines(result.warnings)]))
        print(f"\n{task_line(result)}\n{cfg.output / 'eval.json'}\n{cfg.output / 'eval.html'}")
    return 0


def _compare(cfg: EvalCfg) -> int:
    from vd.evaluate.compare import compare

    comparison = compare(cfg)
    from vd.config import to_dict
    from vd.evaluate.comparison_page import terminal_table
    from vd.evaluate.report import warning_lines

    if cfg.json:
        summary = to_dict(comparison)
        for row in summary["rows"]:
            del row["result"]["episodes"]
        for entry in summary["predictions"]:
            del entry["true_rad"], entry["predicted_rad"]
        print(json.dumps(summary, indent=1))
    else:
        print("\n".join([terminal_table(comparison), *warning_lines(comparison.warnings)]))
        print(f"\n{cfg.output / 'eval.json'}\n{cfg.output / 'eval.html'}")
    return 0


def _run_suite(cfg: EvalCfg) -> int:
    from vd.evaluate.suite_page import out_of_time, terminal_table
    from vd.evaluate.suite_run import PAGE_FILE, RESULT_FILE, run_suite

    result = run_suite(cfg)
    if cfg.json:
        print(json.dumps(result.summary(), indent=1))
    else:
        print(f"{terminal_table(result)}\n")
        if result.found:
            print(f"{cfg.output / RESULT_FILE}\n{cfg.output / PAGE_FILE}")
    if result.late:
        print(f"vd-eval: {out_of_time(result)}", file=sys.stderr)
    for (condition, policy), why in result.failed.items():
        print(f"vd-eval: {condition} of {policy} failed: {why}", file=sys.stderr)
    return 1 if result.failed else 0


def evaluate(cfg: EvalCfg) -> "EvalResult":
    """Run an evaluation and write its JSON and page into ``cfg.output``.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
        vd.sim.simulator.SimulationError: Contacts were lost, or a world left the finite numbers.
    """
    from tqdm import tqdm

    quiet_warp()
    import numpy as np

    from vd.assets_usd.objects.model import load_set
    from vd.assets_usd.objects.sheet import pictures
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.agents import built_in, check_bundle, open_teacher, task_for
    from vd.evaluate.report import write_report
    from vd.evaluate.result import Protocol, summarise, warnings_of
    from vd.evaluate.rollout import collect, collect_drawn, draw_starts_and_goals
    from vd.evaluate.second_view import SecondView

    device = resolve_device(cfg.device)
    (name,) = cfg.agent_names
    trained = open_teacher(name, device)
    count = len(load_set(list(cfg.object_sets)))
    task = task_for(
        trained,
        hand=cfg.hand,
        objects=cfg.object_sets,
        num_worlds=cfg.num_worlds or worlds_for(count, cfg.episodes, device),
        seed=cfg.seed,
        stop_tolerance_rad=cfg.stop_tolerance,
        max_goal_angle_rad=cfg.max_goal_angle,
        episode_s=cfg.limit_s,
        randomised=cfg.randomised,
        success_ends_episode=True,
        at_rest=start_at_rest(cfg.at_rest, cfg.no_at_rest),
        hand_layer=cfg.hand_layer,
        aim=cfg.aim,
        second_view=cfg.second_view,
        condition=cfg.randomisation,
    )
    check_bundle(name, task)
    print("building the worlds (the first start compiles kernels: minutes)", file=sys.stderr)
    env = ReorientEnv(task, device)
    policy: Any = trained or built_in(name, env.num_actions, seed=cfg.seed, device=device)
    if cfg.second_view and trained is not None:
        policy = SecondView(env, trained)
    rounds = math.ceil(cfg.episodes / (env.num_worlds // count))
    refresh = 0.5 if sys.stderr.isatty() else LOG_EVERY_S
    with tqdm(total=rounds * env.max_episode_steps, unit="step", desc="vd-eval", mininterval=refresh) as bar:

        def show(done: int) -> None:
            bar.set_postfix_str(f"{done} of {count * cfg.episodes} episodes", refresh=False)
            bar.update()

        if task.start.at_rest:
            episodes = collect_drawn(env, policy, cfg.episodes, on_step=show)
        else:
            drawn = [
                draw_starts_and_goals(
                    item.name, cfg.episodes, seed=cfg.seed, max_goal_angle=cfg.max_goal_angle
                )
                for item in env.objects
            ]
            starts, goals = (np.stack([pair[i] for pair in drawn]) for i in range(2))
            episodes = collect(env, policy, starts, goals, on_step=show)
    env.check()
    env.close()
    protocol = Protocol(
        policy=name,
        objects=", ".join(cfg.object_sets),
        hand=task.hand,
        hand_layer=task.hand_layer,
        episodes=cfg.episodes,
        seed=cfg.seed,
        max_goal_angle_rad=cfg.max_goal_angle,
        stop_tolerance_rad=cfg.stop_tolerance,
        episode_s=cfg.limit_s,
        control_hz=task.sim.control_hz,
        randomised=cfg.randomised,
        at_rest=task.start.at_rest,
        goals_about_vertical=task.start.at_rest and task.goal.about_vertical,
        aim=cfg.aim,
        second_view=cfg.second_view,
        condition=cfg.condition,
    )
    result = summarise(
        protocol,
        tuple(item.name for item in env.objects),
        episodes,
        resample=cfg.resample,
        software=software(device),
        warnings=warnings_of(env.objects),
    )
    result.write(cfg.output / "eval.json")
    write_report(result, cfg.output / "eval.html", pictures=pictures(env.objects))
    return result


def worlds_for(num_objects: int, episodes: int, device: str, *, limit: int | None = None) -> int:
    """Worlds to simulate at once: the same number for every object, at most one for each episode."""
    limit = limit or (WORLDS_CPU if device == "cpu" else WORLDS_GPU)
    return num_objects * max(1, min(episodes, limit // num_objects))


def software(device: str) -> dict[str, str]:
    """The device and the versions of what runs."""
    import warp as wp

    from vd.versions import installed_versions

    return {"device": wp.get_device(device).name} | installed_versions(_PACKAGES)


if __name__ == "__main__":
    sys.exit(main())
