"""What ``vd-eval`` is told."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from vd.assets_usd.hands import HANDS
from vd.command.config import require
from vd.command.workers import shard
from vd.envs.cfg import RandomisationCfg
from vd.evaluate.conditions import CONDITIONS, Condition
from vd.evaluate.goals import AIR_GOALS, CONSECUTIVE, ONE_GOAL, Goals, GoalSchedule
from vd.paper import PAPER
from vd.policy.agents import DEFAULT_HAND, SHIPPED_POLICIES, default_policy
from vd.sim.cfg import Engine

# Seconds between progress lines where they go to a file.
LOG_EVERY_S = 10.0
PASSED_ON = ("seed", "device", "num_envs", "hand", "hand_layer", "engine")
"""Settings beside ``--suite`` that every line of it gets."""
BESIDE_SUITE = (*PASSED_ON, "policies", "objects", "suite", "jobs", "shard", "out")
"""Settings that a suite does not decide."""
EXCLUSIVE = (
    ("condition", "table_friction"),
    ("at_rest", "no_at_rest"),
    ("air_goals", "in_air", "consecutive"),
    ("air_goals", "episode_s"),
)
"""Settings that say different things of the same."""
POLICY_HELP = (
    "A policy.safetensors, a checkpoint, a run's folder, the name of an installed policy "
    f" ({', '.join(SHIPPED_POLICIES)}), module:function, a function of yours from observations to "
    "actions, or zero or random."
)
"""What names a policy on a command line."""


@dataclass(kw_only=True)
class TaskFlags:
    """The task in which policies act, for vd-eval, vd-play and vd-train tracker."""

    objects: tuple[str, ...] = ("cube",)
    """Object sets by name, folders or files (vd-assets makes them)."""
    seed: int = 0
    """Seed of starts, goals and everything else random."""
    in_air: tyro.conf.FlagCreatePairsOff[bool] = False
    """Take the table away after 2 s, as in the paper's test of reorientation in the air."""
    device: str = "auto"
    """auto, cpu or cuda:N."""


@dataclass(kw_only=True)
class HandFlags:
    """The hand, for vd-eval and vd-play."""

    hand: str | None = None
    """dclaw3, dclaw4, an imported hand or a hand's USD; by default the policy's, or dclaw4."""
    hand_layer: str | None = None
    """Layer over the hand with a servo model, identified.usda of vd-gap; by default the policy's,
    none for the hand as it is."""


@dataclass(kw_only=True)
class EpisodeFlags(TaskFlags):
    """Episodes that are judged, for vd-eval and vd-train tracker."""

    episodes: int = 20
    """Starts and goals of every object."""
    stop_tolerance: float = PAPER.success.rotation_rad
    """An episode stops below this error [rad]; 0.1 for the paper's precise variant."""
    episode_s: float | None = None
    """Time limit of an episode [s]; 10 by default, 15 with --in-air, 39 with --air-goals of
    vd-eval, of whose --consecutive it is the time for each goal."""
    goals: Goals = "points"
    """What camera policies know shapes and goals by: 500 exact points, as the paper's; or a scan,
    points with 4 mm of noise and a fifth missing.
    """
    sensor_errors: bool = True
    """Cameras of policies err as a D415 does: noise, gaps, late images, not quite where it is
    believed (docs/concepts/perception.md). Without: a perfect camera."""
    num_envs: int | None = None
    """Environments simulated at once; by default as many as episodes, up to 64 on a CPU, 8192 on a
    GPU (1024 with camera policies)."""

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        require(self, "--", "positive", "episodes episode_s num_envs")
        require(self, "--", "zero or positive", "seed")
        require(self, "--", "an angle", "stop_tolerance")


@dataclass(kw_only=True)
class EvalCfg(HandFlags, EpisodeFlags):
    """Evaluate policies: every object from the same starts to the same goals, whatever the policy.

    Objects fall into the hand from orientations uniform on SO(3), or, with --at-rest, lie on the
    table.

    Writes eval.json (every episode) and eval.html (one page) and prints tables. Episodes are
    recorded to their ends; rules that stop them are applied to the record. Camera policies stop by
    the distance that they predict and, for comparison, by the true one; others by the true one and,
    as a second row, at the first step at which all success criteria of training hold, stillness
    included.

    Policies that turn objects without a goal (leap-spin) are judged by their turns in 30 s and
    their drops, in spin.json.

    --suite paper runs all of the paper's evaluations in simulation and writes paper.json and
    paper.html, its figures beside ours. --suite robust changes one thing after the other and writes
    robust.json and robust.html. What is finished is not repeated by the next call.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(help=POLICY_HELP)] = ()
    suite: str | None = None
    """Run the command lines of a suite, paper, robust, benchmark or a YAML file (docs/concepts),
    on the D'Claw policies if none is named. --objects training=FOLDER held-out=FOLDER names
    objects; without, our procedural sets stand for them.
    """
    jobs: int = 1
    """Of a suite, evaluations side by side, each in a process of its own, spread over the GPUs."""
    shard: str | None = None
    """I/N: of a suite every N-th evaluation from the I-th, from 0, for arrays of jobs. The same
    command without it runs what is missing in --out and writes the page."""
    objects: tuple[str, ...] = ()
    """Object sets by name, folders or files (vd-assets makes them); cube by default. NAME=SET puts
    one into a group, which gets figures of its own: training=FOLDER held-out=FOLDER
    symmetric=symmetric."""
    max_goal_angle: float = math.pi
    """Goals are within this angle [rad] of the start; pi is all of SO(3)."""
    at_rest: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start at rest on the table; the default is as trained, and a drop for zero and random. The
    environment draws such starts and their goals; they depend on --num-envs too."""
    no_at_rest: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start from a drop, whatever the training."""
    air_goals: tyro.conf.FlagCreatePairsOff[bool] = False
    """The same, and a second later goal after goal, three with 12 s for each; what reaches the
    first is also held for 30 s. Success is of the first."""
    consecutive: tyro.conf.FlagCreatePairsOff[bool] = False
    """Successes in a row: goal after goal, 50 at most, until the object is lost or one is not
    reached within --episode-s. The distance decides; neither action nor stillness is asked for."""
    table_friction: float | None = None
    """Coefficient of the table, of which contacts with objects get the mean of the two; 0.5 by
    default.
    """
    condition: Condition | None = None
    """Evaluate in a named condition, whatever the training: nominal; s3, Table S3; hard, the same
    with forces that last a control step; mixed, Table S3 with friction, backlash, late commands and
    a late object; observation-late (the object), all-late (joints too) and command-late, 83 ms and
    nothing else; sizes, all of the hand's file; the others change one thing, which the page of
    --suite robust names."""
    plan: tyro.conf.FlagCreatePairsOff[bool] = False
    """Plan every step by sampling 256 futures of a second, with the nominal simulator as model. A
    teacher proposes half of them; ``zero --plan`` needs none. It tells what physics allows: GPUs.
    """
    engine: Engine = "newton"
    """What steps the physics: as in training, or MuJoCo's own engine in C, in steps of 1 ms, on the
    CPU.
    """
    out: Path = Path("runs/eval")
    """Folder for eval.json and eval.html."""

    @property
    def agent_names(self) -> tuple[str, ...]:
        """What is evaluated, each once; by default the installed teacher of the hand.

        Raises:
            ValueError: The hand has none.
        """
        if not self.policies and self.suite is None:
            return (default_policy(self.hand or DEFAULT_HAND, "teacher"),)
        shipped = (name for name in SHIPPED_POLICIES if name.partition("-")[0] in HANDS)
        return tuple(dict.fromkeys(self.policies or shipped))

    @property
    def suite_name(self) -> str:
        """What the files of the suite are called, or of the one evaluation."""
        return "eval" if self.suite is None else Path(self.suite).stem

    @property
    def object_sets(self) -> tuple[str, ...]:
        """The sets of ``objects``, the default included."""
        return self.objects or ("cube",)

    @property
    def schedule(self) -> GoalSchedule:
        """The goals of an episode."""
        if self.air_goals:
            return AIR_GOALS
        goal_s = episode_limit_s(self.episode_s, in_air=self.in_air)
        table_s = PAPER.scene.air_table_s if self.in_air else None
        return replace(
            CONSECUTIVE if self.consecutive else ONE_GOAL, goal_s=goal_s, table_s=table_s
        )

    @property
    def rest(self) -> bool | None:
        """Whether objects start at rest; None: as trained."""
        return self.at_rest if self.at_rest or self.no_at_rest else None

    @property
    def randomisation(self) -> RandomisationCfg:
        """What is drawn."""
        if self.condition is None:
            return RandomisationCfg(enabled=False)
        return CONDITIONS[self.condition]

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        super().validate()
        require(self, "--", "positive", "jobs")
        require(self, "--", "an angle", "max_goal_angle")
        require(self, "--", "zero or positive", "table_friction")
        if self.engine == "mujoco" and self.device.startswith("cuda"):
            raise ValueError(
                f"--engine mujoco steps on the CPU, not on {self.device}; leave --device out"
            )
        given = [name for name, value in vars(EvalCfg()).items() if getattr(self, name) != value]
        for names in EXCLUSIVE:
            if len(both := [flag(name) for name in names if name in given]) > 1:
                raise ValueError(f"{' and '.join(both)} exclude each other; give one of them")
        shard((), self.shard)
        if self.suite is None and (self.jobs > 1 or self.shard):
            raise ValueError(
                "--jobs and --shard are of a suite; add --suite paper, or leave them out"
            )
        decided = [flag(name) for name in given if name not in BESIDE_SUITE]
        if self.suite and decided:
            raise ValueError(
                f"{' and '.join(decided)} is decided by --suite {self.suite}; leave it out"
            )


def flag(name: str) -> str:
    """What the field ``name`` is called on a command line."""
    return f"--{name.replace('_', '-')}"


def episode_limit_s(episode_s: float | None, *, in_air: bool) -> float:
    """Length of an episode [s].

    As asked for, or that of the paper's test on the table or in the air.
    """
    if episode_s is not None:
        return episode_s
    return PAPER.scene.air_episode_s if in_air else PAPER.scene.episode_s


def parse_groups(objects: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Object sets by the name of their group: ``NAME=SET`` is of that group, others of ``objects``.

    Raises:
        ValueError: A group has no set.
    """
    groups: dict[str, tuple[str, ...]] = {}
    for item in objects:
        name, equals, sets = item.partition("=")
        if not equals:
            name = "objects"
            sets = item
        if not name or not sets:
            raise ValueError(
                f"--objects: '{item}' has to be NAME=SET, such as training=procedural-150-seed0"
            )
        groups[name] = (*groups.get(name, ()), sets)
    return groups
