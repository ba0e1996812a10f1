"""Agents side by side in the very task of a training: counted for the demo's page, and filmed."""

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vd.evaluate.result import EvalResult

AGENTS = ("trained", "random", "zero")

VIDEO_SECONDS, VIDEO_CELLS = 8.0, 4
# Time between progress lines where the output is no terminal.
PLAIN_INTERVAL_S = 15.0


@dataclass(frozen=True)
class GoalCount:
    """All goals of one episode of every world, as the curve of a training counts them.

    Attributes:
        worlds: Episodes.
        ended: Goals that ended, by success, drop or the end of the episode.
        reached: Those that were reached.
    """

    worlds: int
    ended: float
    reached: float

    @property
    def per_goal(self) -> float:
        """Share of the goals that were reached."""
        return self.reached / max(self.ended, 1.0)

    @property
    def per_episode(self) -> float:
        """Goals reached in an episode."""
        return self.reached / self.worlds


def compare_agents(
    run_dir: Path, objects: tuple[str, ...], episodes: int, *, seed: int, device: str
) -> "Iterator[tuple[str, EvalResult, GoalCount]]":
    """Evaluate the trained policy, random and zero actions in the very task of the training.

    All three start from the same orientations and get the same first goals. As in training, a reached goal
    gives the next one; the result is that of each episode's first goal, the count that of all its goals.

    Args:
        run_dir: Folder of the training.
        objects: Object sets.
        episodes: Episodes of each agent, spread evenly over the objects.
        seed: Of starts, goals and random actions.
        device: ``cpu`` or ``cuda``.

    Yields:
        Name, result and count of each agent.
    """
    import numpy as np

    from vd.assets_usd.objects.model import load_set
    from vd.evaluate.agents import built_in
    from vd.evaluate.result import Protocol, summarise
    from vd.evaluate.rollout import collect, draw_starts_and_goals

    count = len(load_set(list(objects)))
    each = math.ceil(episodes / count)
    env, trained = _open_task(run_dir, objects, count * each, seed=seed, device=device)
    task, torch_device = env.cfg, env.device
    angle = task.goal.max_angle_rad
    drawn = [draw_starts_and_goals(o.name, each, seed=seed, max_goal_angle=angle) for o in env.objects]
    starts, goals = np.stack([start for start, _ in drawn]), np.stack([goal for _, goal in drawn])
    for agent in AGENTS:
        policy = trained
        if agent != "trained":
            policy = built_in(agent, env.num_actions, seed=seed, device=torch_device)
        with _bar(f"  {agent}", env.max_episode_steps, "step") as bar:
            env.goal_counts.zero_()
            recorded = collect(env, policy, starts, goals, on_step=_advance(bar))
        env.check()
        ended, reached = (float(value) for value in env.goal_counts.numpy()[:2])
        protocol = Protocol(
            policy=agent,
            objects=", ".join(objects),
            hand=task.hand,
            episodes=each,
            seed=seed,
            max_goal_angle_rad=angle,
            stop_tolerance_rad=task.success.rotation_rad,
            episode_s=task.episode_s,
            control_hz=task.sim.control_hz,
            randomised=task.randomisation.enabled,
        )
        names = tuple(item.name for item in env.objects)
        result = summarise(protocol, names, [item.symmetry for item in env.objects], recorded)
        yield agent, result, GoalCount(env.num_worlds, ended, reached)
    env.close()


def _bar(title: str, total: int, unit: str) -> Any:
    """A progress bar; outside a terminal a line now and then."""
    from tqdm import tqdm

    interval = 0.2 if sys.stderr.isatty() else PLAIN_INTERVAL_S
    return tqdm(total=total, desc=title, unit=unit, mininterval=interval, dynamic_ncols=True)


def _counted(items: Iterable[Any], bar: Any) -> Iterator[Any]:
    for item in items:
        yield item
        bar.update()


def _advance(bar: Any) -> Callable[[int], None]:
    """A callback that counts steps, whatever number it is called with."""

    def step(_episodes: int) -> None:
        bar.update()

    return step


def _open_task(
    run_dir: Path,
    objects: tuple[str, ...],
    num_worlds: int,
    *,
    seed: int,
    device: str,
) -> tuple[Any, Any]:
    """The whole task of a training, without its curriculum, and the policy that came out."""
    from vd.envs.cfg import CurriculumCfg
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.agents import open_policy, trained_task

    name = "cuda:0" if device == "cuda" else "cpu"
    trained = open_policy(str(run_dir), name)
    task = replace(
        trained_task(trained),
        objects=objects,
        num_worlds=num_worlds,
        seed=seed,
        curriculum=CurriculumCfg(),
    )
    return ReorientEnv(task, name), trained


def record_training_task(
    run_dir: Path, objects: tuple[str, ...], video: Path, *, seed: int, device: str
) -> None:
    """Film the trained policy in the task of its training, in several worlds side by side.

    Args:
        run_dir: Folder of the training.
        objects: Object sets.
        video: File to write.
        seed: Of starts and goals.
        device: ``cpu`` or ``cuda``.
    """
    from vd.assets_usd.objects.model import load_set
    from vd.play.cli import GOAL_SHARE, GRID_CELL, spread
    from vd.play.video import record, write_frames
    from vd.render import Renderer

    worlds = max(VIDEO_CELLS, len(load_set(list(objects))))
    env, trained = _open_task(run_dir, objects, worlds, seed=seed, device=device)
    shown = spread(env.world_object, VIDEO_CELLS)
    width, height = GRID_CELL
    renderer = Renderer(
        env.hand,
        [env.objects[env.world_object[world]] for world in shown],
        width=width,
        height=height,
        goal_size=round(GOAL_SHARE * height),
        device=env.device,
    )
    rate = env.cfg.sim.control_hz
    steps = round(VIDEO_SECONDS * rate)
    with _bar("  video", steps, "frame") as bar:
        write_frames(video, _counted(record(env, trained, renderer, shown, steps), bar), rate)
    env.check()
    env.close()
