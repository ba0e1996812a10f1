"""Agents side by side in the very task of a training: counted for the demo's page, and filmed."""

import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vd.evaluate.result import Episode, EvalResult

AGENTS = ("trained", "random", "zero")

VIDEO_SECONDS, VIDEO_CELLS = 8.0, 4
IDENTITY = (0.0, 0.0, 0.0, 1.0)
# Time between progress lines where the output is no terminal.
PLAIN_INTERVAL_S = 15.0


@dataclass(frozen=True)
class GoalCount:
    """All goals of one episode of every world.

    Attributes:
        worlds: Episodes.
        reached: Goals that were reached in them.
    """

    worlds: int
    reached: float

    @property
    def per_episode(self) -> float:
        """Goals reached in an episode."""
        return self.reached / self.worlds


def compare_agents(
    run_dir: Path, objects: tuple[str, ...], episodes: int, *, seed: int, device: str
) -> "Iterator[tuple[str, EvalResult, GoalCount]]":
    """Evaluate the trained policy, random and zero actions in the very task of the training.

    All three begin in the same state with the same first goals. As in training, a reached goal gives the
    next one; the result is that of each episode's first goal, the count that of all its goals. Errors are
    plain angles, as the training has them, also for symmetric objects.

    Args:
        run_dir: Folder of the training.
        objects: Object sets.
        episodes: Episodes of each agent, spread evenly over the objects.
        seed: Of starts, goals and random actions.
        device: ``cpu`` or ``cuda``.

    Yields:
        Name, result and count of each agent.
    """
    from vd.assets_usd.objects.model import load_set
    from vd.evaluate.agents import built_in
    from vd.evaluate.result import Protocol, summarise

    count = len(load_set(list(objects)))
    each = math.ceil(episodes / count)
    env, trained = _open_task(run_dir, objects, count * each, seed=seed, device=device)
    task, start = env.cfg, env.state_dict()
    for agent in AGENTS:
        policy = trained
        if agent != "trained":
            policy = built_in(agent, env.num_actions, seed=seed, device=env.device)
        env.load_state_dict(start)
        recorded = first_goals(env, policy, title=f"  {agent}")
        env.check()
        reached = float(env.goal_counts.numpy()[1])
        protocol = Protocol(
            policy=agent,
            objects=", ".join(objects),
            hand=task.hand,
            episodes=each,
            seed=seed,
            max_goal_angle_rad=task.goal.max_angle_rad,
            stop_tolerance_rad=task.success.rotation_rad,
            episode_s=task.episode_s,
            control_hz=task.sim.control_hz,
            randomised=task.randomisation.enabled,
            at_rest=task.start.at_rest,
            goals_about_vertical=task.goal.about_vertical,
        )
        names = tuple(item.name for item in env.objects)
        result = summarise(protocol, names, recorded)
        yield agent, result, GoalCount(env.num_worlds, reached)
    env.close()


def first_goals(env: Any, policy: Any, *, title: str = "") -> "tuple[Episode, ...]":
    """Simulate one episode of every world from the present state, and keep how the first goals ended.

    Args:
        env: The environment, just reset; worlds of an object are neighbours.
        policy: With ``act(observation)``, torch in and out.
        title: Of the progress bar.

    Returns:
        N episodes in the order of the worlds: to the goal, the drop, or the end.
    """
    import numpy as np

    from vd.evaluate.result import Episode
    from vd.evaluate.statistics import symmetric_error
    from vd.play.video import act

    env.goal_counts.zero_()
    starts, goals = env.object_pose()[:, 3:7], env.goal_quat.numpy().copy()
    errors = symmetric_error(starts, goals, np.array([IDENTITY]))
    episodes: dict[int, Episode] = {}
    with progress_bar(title, env.max_episode_steps, "step") as bar:
        for step in range(1, env.max_episode_steps + 1):
            act(env, policy)
            done, angle = env.done.numpy() != 0, env.rotation_error.numpy()
            reached, fell = env.success.numpy() != 0, env.fell.numpy() != 0
            for world in np.flatnonzero(done):
                episodes.setdefault(
                    int(world),
                    Episode(
                        object_index=int(env.world_object[world]),
                        start_quat=_quat(starts[world]),
                        goal_quat=_quat(goals[world]),
                        start_error_rad=float(errors[world]),
                        error_rad=float(angle[world]),
                        exact_error_rad=float(angle[world]),
                        steps=step,
                        stopped=bool(reached[world] and not fell[world]),
                        fell=bool(fell[world]),
                    ),
                )
            bar.update()
    return tuple(episodes[world] for world in range(env.num_worlds))


def _quat(values: Iterable[float]) -> tuple[float, float, float, float]:
    x, y, z, w = (float(value) for value in values)
    return x, y, z, w


def progress_bar(title: str, total: int, unit: str) -> Any:
    """A progress bar; outside a terminal a line now and then."""
    from tqdm import tqdm

    interval = 0.2 if sys.stderr.isatty() else PLAIN_INTERVAL_S
    return tqdm(total=total, desc=title, unit=unit, mininterval=interval, dynamic_ncols=True)


def _counted(items: Iterable[Any], bar: Any) -> Iterator[Any]:
    for item in items:
        yield item
        bar.update()


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
    from vd.evaluate.agents import open_teacher, trained_task

    name = "cuda:0" if device == "cuda" else "cpu"
    trained = open_teacher(str(run_dir), name)
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
    from vd.play.cli import spread
    from vd.play.video import GOAL_SHARE, GRID_CELL, record, write_frames
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
    with progress_bar("  video", steps, "frame") as bar:
        write_frames(video, _counted(record(env, trained, renderer, shown, steps), bar), rate)
    env.check()
    env.close()
