"""How far policies turn objects that have no goal, and how long they hold them, as HORA counts it."""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.command.config import to_dict
from vd.command.files import write_json
from vd.command.versions import MEASURING
from vd.evaluate.cfg import EvalCfg, flag
from vd.evaluate.compare import actor_of, device_of, envs_for, software_of, task_of
from vd.evaluate.page import NOTHING, aligned
from vd.evaluate.trace import act_in, drawn_rounds
from vd.policy.agents import check_fits

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

SPIN_S = 30.0
"""Length of an episode where none is asked for [s], that of HORA on the real hand."""
SPIN_FILE = "spin.json"
"""What is written into ``--out``."""
OF_GOALS = (
    "in_air",
    "air_goals",
    "consecutive",
    "plan",
    "goals",
    "stop_tolerance",
    "max_goal_angle",
    "table_friction",
)
"""Settings that mean nothing where there is no goal."""
_HEADER = ("policy", "object", "revolutions", "turned before a drop", "dropped", "held [s]")


@dataclass(frozen=True)
class Turns:
    """What a policy did with an object, or with all."""

    policy: str
    object: str
    """Its name, or ``all``."""
    episodes: int
    revolutions: float
    """Turns about the axis to the drop or the end, mean of all episodes; the other way round is
    negative."""
    revolutions_sd: float
    """Their standard deviation."""
    per_drop: float | None
    """Turns in all episodes for each drop; None: nothing was dropped."""
    dropped: float
    """Share of the episodes in which the object was dropped, or its physics failed."""
    held_s: float
    """Time to the drop or the end, mean of all episodes [s]."""


@dataclass(frozen=True)
class SpinResult:
    """Everything that was evaluated."""

    rows: tuple[Turns, ...]
    axis: tuple[float, float, float]
    """In the world."""
    episode_s: float
    condition: str
    seed: int
    software: dict[str, str]
    format: str = field(default="visual-dexterity spin 1")

    def text(self) -> str:
        """A table for a terminal."""
        lines = [_HEADER]
        for row in self.rows:
            per_drop = NOTHING if row.per_drop is None else f"{row.per_drop:z.1f}"
            lines.append(
                (
                    row.policy,
                    row.object,
                    f"{row.revolutions:z.2f} (sd {row.revolutions_sd:.2f})",
                    per_drop,
                    f"{100 * row.dropped:.0f} %",
                    f"{row.held_s:.1f}",
                )
            )
        axis = " ".join(f"{value:g}" for value in self.axis)
        settings = f"{self.episode_s:g} s about {axis}, {self.rows[0].episodes} episodes in all"
        return f"{aligned(lines, words=2)}\n\n{settings}, condition {self.condition}"


def spins(policy: Any) -> bool:
    """Whether a policy, or None, was trained to turn objects without a goal."""
    return policy is not None and bool(policy.task["reward"].get("spin", {}).get("rate"))


def evaluate_spin(cfg: EvalCfg, policies: Mapping[str, Any]) -> SpinResult:
    """Run an evaluation of what :func:`open_agents` gave, and write its JSON into ``cfg.out``.

    Agents without a file act in the task of the first policy.

    Raises:
        ValueError: A policy has goals, or a setting is of goals.
    """
    from vd.assets_usd.objects.sets import set_files
    from vd.envs.reorient import ReorientEnv

    ours = EvalCfg()
    of_goals = [name for name in OF_GOALS if getattr(cfg, name) != getattr(ours, name)]
    if of_goals:
        flags = ", ".join(map(flag, of_goals))
        raise ValueError(f"what spins has no goals and no table: leave out {flags}")
    device = device_of(cfg)
    with_goals = [name for name, policy in policies.items() if policy and not spins(policy)]
    if with_goals:
        raise ValueError(f"{with_goals[0]} turns objects to goals; evaluate it by itself")
    first = next(filter(None, policies.values()))
    asked = replace(cfg, episode_s=cfg.episode_s or SPIN_S)
    count = len(set_files(cfg.object_sets))
    rows: list[Turns] = []
    for name, policy in policies.items():
        check_fits(name, policy, cfg.hand, cfg.hand_layer)
        envs = cfg.num_envs or envs_for(count, cfg.episodes, device)
        task = task_of(asked, policy or first, cfg.object_sets, envs)
        print("building the environments (the first start compiles kernels)", file=sys.stderr)
        env = ReorientEnv(task, device)
        actor, _ = actor_of(name, policy, env, seed=cfg.seed)
        rows += _rows(name, env, *turn(env, actor, cfg.episodes))
        env.check()
        env.close()
    result = SpinResult(
        tuple(rows),
        axis=task.reward.spin.axis,
        episode_s=task.episode_s,
        condition=cfg.condition or "off",
        seed=cfg.seed,
        software=software_of(device, MEASURING),
    )
    write_json(Path(cfg.out) / SPIN_FILE, to_dict(result))
    return result


def turn(env: "ReorientEnv", policy: Any, episodes: int) -> tuple[np.ndarray, ...]:
    """Run episodes of every object, K objects, M episodes each.

    Returns:
        Angle turned about the axis to the drop or the end [rad], time until then [s], and whether
        it was a drop, shape [K, M].
    """
    assert env.spin is not None
    shape = len(env.objects), episodes
    angle = np.zeros(shape)
    steps = np.zeros(shape)
    dropped = np.zeros(shape, bool)
    objects = np.asarray(env.world_object)
    for numbers, state in drawn_rounds(env, episodes, None, None):
        env.load_state_dict(state)
        env.observe()
        running = np.flatnonzero(numbers >= 0)
        while len(running):
            action = act_in(env, policy, running).detach().contiguous().float()
            env.advance(wp.from_torch(action, dtype=wp.float32))
            place = objects[running], numbers[running]
            lost = (env.fell.numpy() + env.sim.failed.numpy())[running] > 0
            angle[place] = env.spin.turned.numpy()[running]
            steps[place] += 1
            dropped[place] = lost
            running = running[env.ended.numpy()[running] == 0]
            env.renew()
    return angle, steps / env.cfg.sim.control_hz, dropped


def _rows(
    policy: str, env: "ReorientEnv", angle: np.ndarray, held_s: np.ndarray, dropped: np.ndarray
) -> list[Turns]:
    """Of all objects, then of each, if there are several."""
    chosen = {"all": slice(None)} if len(env.objects) > 1 else {}
    chosen |= {item.name: slice(k, k + 1) for k, item in enumerate(env.objects)}
    rows = []
    for name, where in chosen.items():
        turns = angle[where] / math.tau
        drops = int(dropped[where].sum())
        row = Turns(
            policy=policy,
            object=name,
            episodes=turns.size,
            revolutions=float(turns.mean()),
            revolutions_sd=float(turns.std()),
            per_drop=float(turns.sum() / drops) if drops else None,
            dropped=float(dropped[where].mean()),
            held_s=float(held_s[where].mean()),
        )
        rows.append(row)
    return rows
