"""What ``vd-eval`` is told."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vd.envs.cfg import RandomisationCfg
from vd.evaluate.agents import LAYER_HELP, SHIPPED_POLICIES, episode_limit_s, start_at_rest
from vd.evaluate.conditions import CONDITIONS, Condition
from vd.evaluate.goals import AIR_S, Goals
from vd.paper import PAPER
from vd.sim.cfg import Engine

# Seconds between progress lines where they go to a file.
LOG_EVERY_S = 10.0
OF_THE_SUITE = (
    "episodes",
    "max_goal_angle",
    "at_rest",
    "no_at_rest",
    "stop_tolerance",
    "episode_s",
    "in_air",
    "air_goals",
    "table_friction",
    "condition",
    "goals",
    "sensor_errors",
)
"""Settings that a suite decides."""
POLICY_HELP = (
    "A policy.pt, a checkpoint, the folder of a bundle or of a run, the name of an installed "
    f"policy ({', '.join(SHIPPED_POLICIES)}), or zero or random, which have no file."
)
"""What names a policy on a command line."""


@dataclass
class EvalCfg:
    """Evaluate policies: every object from the same starts to the same goals, whatever the policy.

    Objects fall into the hand from orientations uniform on SO(3), or, with --at-rest, lie on the table.

    Writes eval.json (every episode) and eval.html (one page) and prints tables. Episodes are
    recorded to their ends; rules that stop them are applied to the record. Camera policies stop by the
    distance that they predict and, for comparison, by the true one; others by the true one and, as a second
    row, at the first step at which all success criteria of training hold, stillness included.

    --suite paper runs all of the paper's evaluations in simulation and writes paper.json and paper.html, its
    figures beside ours. --suite robust changes one thing after the other and writes robust.json and
    robust.html. What is finished is not repeated by the next call.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(help=POLICY_HELP)] = ()
    suite: Literal["paper", "robust"] | None = None
    """Run the paper's evaluations, or those of every --condition, on the installed policies if none is named.
    --objects training=FOLDER held-out=FOLDER names objects; without, our procedural sets stand for them."""
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
    """Start at rest on the table; the default is as trained, and a drop for zero and random. The
    environment draws such starts and their goals; they depend on --num-envs too."""
    no_at_rest: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start from a drop, whatever the training."""
    stop_tolerance: float = PAPER.success.rotation_rad
    """An episode stops below this error [rad]; 0.1 for the paper's precise variant."""
    episode_s: float | None = None
    """Time limit of an episode [s]; 10 by default, 15 with --in-air, 39 with --air-goals."""
    in_air: tyro.conf.FlagCreatePairsOff[bool] = False
    """Take the table away after 2 s, as in the paper's test of reorientation in the air."""
    air_goals: tyro.conf.FlagCreatePairsOff[bool] = False
    """The same, and a second later goal after goal, three with 12 s for each; what reaches the first is also
    held for 30 s. Success is of the first."""
    table_friction: float | None = None
    """Coefficient of the table, of which contacts with objects get the mean of the two; 0.5 by default."""
    goals: Goals = "mesh"
    """What camera policies know shapes and goals by: the exact mesh; 500 exact points, as the paper's; or a
    scan, points with 4 mm of noise and a fifth missing. A surface is laid through points."""
    sensor_errors: bool = True
    """Cameras of policies err as a D415 does: noise, gaps, late images, not quite where it is believed
    (docs/concepts/perception.md). Without: as in their training."""
    randomise: bool = False
    """Randomise dynamics and add noise and disturbances as in training."""
    condition: Condition | None = None
    """Evaluate in a named condition, whatever the training: nominal; s3, Table S3; hard, the same with forces
    that last a control step; mixed, Table S3 with friction, backlash, late commands and a late object;
    observation-late (the object), all-late (joints too) and command-late, 83 ms and nothing else; the others
    change one thing, which the page of --suite robust names."""
    engine: Engine = "newton"
    """What steps the physics: as in training, or MuJoCo's own engine in C, in steps of 1 ms, on the CPU."""
    num_envs: int | None = None
    """Environments simulated at once; by default as many as episodes, up to 64 on a CPU, 8192 on a GPU (1024
    with camera policies)."""
    device: str = "auto"
    """auto, cpu or cuda:N."""
    out: Path = Path("runs/eval")
    """Folder for eval.json and eval.html."""
    json: bool = False
    """Print protocol and summaries as JSON instead of the table."""

    @property
    def agent_names(self) -> tuple[str, ...]:
        """What is evaluated, each once.

        Raises:
            ValueError: Nothing is named.
        """
        if not self.policies and self.suite is None:
            raise ValueError(
                f"name a policy: a file, zero, random, or an installed one ({', '.join(SHIPPED_POLICIES)})"
            )
        return tuple(dict.fromkeys(self.policies or SHIPPED_POLICIES))

    @property
    def object_sets(self) -> tuple[str, ...]:
        """The sets of ``objects``, the default included."""
        return self.objects or ("cube",)

    @property
    def limit_s(self) -> float:
        """Time limit of an episode [s]."""
        return AIR_S if self.air_goals else episode_limit_s(self.episode_s, in_air=self.in_air)

    @property
    def randomisation(self) -> RandomisationCfg | None:
        """What is drawn; None: as trained."""
        if self.condition is not None:
            return CONDITIONS[self.condition]
        return None if self.randomise else RandomisationCfg(enabled=False)

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
        if self.table_friction is not None and self.randomise:
            raise ValueError("--table-friction and --randomise exclude each other; give one of them")
        if self.condition is not None and (self.randomise or self.table_friction is not None):
            raise ValueError("--condition excludes --randomise and --table-friction; give one of them")
        if self.table_friction is not None and self.table_friction < 0.0:
            raise ValueError(f"--table-friction is {self.table_friction}; it must not be negative")
        if self.engine == "mujoco" and self.device.startswith("cuda"):
            raise ValueError(f"--engine mujoco steps on the CPU, not on {self.device}; leave --device out")
        self._validate_time()
        self._validate_suite()
        start_at_rest(self.at_rest, self.no_at_rest)
        if self.num_envs is not None and self.num_envs < 1:
            raise ValueError(
                f"--num-envs is {self.num_envs}; at least one environment for each object is needed"
            )

    def _validate_time(self) -> None:
        if self.air_goals and (self.in_air or self.episode_s is not None):
            raise ValueError(
                "--air-goals has the table go, and a time limit, of its own; leave --in-air and "
                "--episode-s out"
            )
        if self.limit_s <= 0.0:
            raise ValueError(f"--episode-s is {self.episode_s}; it must be positive")

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


def parse_groups(objects: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Object sets by the name of their group: ``NAME=SET`` is of that group, others of ``objects``.

    Raises:
        ValueError: A group has no set.
    """
    groups: dict[str, tuple[str, ...]] = {}
    for item in objects:
        name, equals, sets = item.partition("=")
        if not equals:
            name, sets = "objects", item
        if not name or not sets:
            raise ValueError(f"--objects: '{item}' has to be NAME=SET, such as training=procedural-150-seed0")
        groups[name] = (*groups.get(name, ()), sets)
    return groups
