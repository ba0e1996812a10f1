"""Run every start and goal of an evaluation through an environment of many worlds.

Errors are those of the step at which an episode ended: the first step at which all success criteria
held, the drop, or the time limit. They are never the least error on the way, which a policy that passes
the goal without stopping would get for nothing.
"""

import zlib
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.evaluate.result import Episode
from vd.evaluate.statistics import rotation_angle, symmetric_error

# Points of the inverse of the cumulative distribution of goal angles; linear between them.
ANGLE_GRID = 4096


class Policy(Protocol):
    """What is evaluated: the mean action for every world."""

    def act(self, observation: Any) -> Any:
        """Actions [N, D] (torch) of observations [N, O] (torch)."""


def draw_starts_and_goals(
    name: str, episodes: int, *, seed: int, max_goal_angle: float = np.pi
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the initial and goal orientations of one object.

    They depend on the object's name, the seed and the number of the episode alone: not on the other
    objects, the number of worlds or the device. Starts are uniform on SO(3); goals are uniform on the part
    of SO(3) within ``max_goal_angle`` of the start.

    Args:
        name: Object name.
        episodes: M.
        seed: Of the evaluation.
        max_goal_angle: Largest angle from start to goal [rad], in (0, pi].

    Returns:
        Starts and goals, quaternions xyzw, shapes [M, 4].
    """
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    start = Rotation.random(episodes, rng=rng).as_quat()
    return start, draw_goals(start, rng, max_goal_angle)


def draw_goals(start: np.ndarray, rng: np.random.Generator, max_goal_angle: float) -> np.ndarray:
    """Orientations uniform on the part of SO(3) within ``max_goal_angle`` [rad] of each of ``start``.

    Args:
        start: Quaternions xyzw, shape [n, 4].
        rng: Where randomness comes from.
        max_goal_angle: In (0, pi].

    Returns:
        Quaternions xyzw, shape [n, 4].
    """
    axis = rng.normal(size=(len(start), 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    # The angle of a uniform rotation has density (1 - cos)/pi: invert its cumulative distribution.
    grid = np.linspace(0.0, max_goal_angle, ANGLE_GRID)
    cumulative = grid - np.sin(grid)
    angle = np.interp(rng.random(len(start)) * cumulative[-1], cumulative, grid)
    return (Rotation.from_rotvec(axis * angle[:, None]) * Rotation.from_quat(start)).as_quat()


def collect(
    env: Any,
    policy: Policy,
    starts: np.ndarray,
    goals: np.ndarray,
    *,
    on_step: Callable[[int], object] = lambda done: None,
) -> tuple[Episode, ...]:
    """Run all episodes, in rounds of one episode a world.

    Every round resets all worlds and takes the first episode of each; a world that is done before the
    others simulates on, unread.

    Args:
        env: An environment whose episodes end at success.
        policy: What to evaluate.
        starts: Initial orientations xyzw, shape [K, M, 4], objects in the order of ``env.objects``.
        goals: Goal orientations xyzw, shape [K, M, 4].
        on_step: Called after every control step with the number of episodes done so far.

    Returns:
        K x M episodes, object by object.

    Raises:
        RuntimeError: An episode outlived the environment's own limit.
    """
    objects, episodes = starts.shape[:2]
    world_object = np.asarray(env.world_object)
    recorded: dict[tuple[int, int], Episode] = {}
    for world_episode in episode_rounds(world_object, objects, episodes):
        # Worlds without an episode left repeat their object's first one, unread.
        index = world_object, np.maximum(world_episode, 0)
        env.reset(object_quat=starts[index].astype(np.float32), goal_quat=goals[index].astype(np.float32))
        _run_round(env, policy, starts[index], goals[index], world_episode, recorded, on_step)
    return tuple(recorded[k, m] for k in range(objects) for m in range(episodes))


def collect_drawn(
    env: Any,
    policy: Policy,
    episodes: int,
    *,
    on_step: Callable[[int], object] = lambda done: None,
) -> tuple[Episode, ...]:
    """Run episodes whose starts and goals are those the environment draws, for example at rest on the table.

    All rounds are drawn before the first step, since how often worlds reset depends on the policy and moves
    the random streams: so starts and goals depend on the environment's configuration (its seed and number
    of worlds included), never on the policy.

    Args:
        env: A new environment whose episodes end at success.
        policy: What to evaluate.
        episodes: M, of every object.
        on_step: Called after every control step with the number of episodes done so far.

    Returns:
        K x M episodes, object by object.

    Raises:
        RuntimeError: An episode outlived the environment's own limit.
    """
    objects = len(env.objects)
    recorded: dict[tuple[int, int], Episode] = {}
    rounds = episode_rounds(np.asarray(env.world_object), objects, episodes)
    states = []
    for _ in rounds:
        env.reset()
        states.append(env.state_dict())
    for world_episode, state in zip(rounds, states, strict=True):
        env.load_state_dict(state)
        starts = unit_quats(env.object_pose()[:, 3:7])
        goals = unit_quats(env.goal_quat.numpy())
        _run_round(env, policy, starts, goals, world_episode, recorded, on_step)
    return tuple(recorded[k, m] for k in range(objects) for m in range(episodes))


def episode_rounds(world_object: np.ndarray, objects: int, episodes: int) -> list[np.ndarray]:
    """For every round the episode number of each world, -1 for none: a list of [N] arrays."""
    missing = sorted(set(range(objects)) - set(world_object.tolist()))
    if missing:
        raise ValueError(f"no world simulates object {missing[0]}; raise the number of worlds to {objects}")
    # The position of each world among those of its object.
    order = np.array([np.count_nonzero(world_object[:w] == k) for w, k in enumerate(world_object)])
    share = np.bincount(world_object, minlength=objects)
    count = int(np.ceil(episodes / share.min()))
    numbers = [turn * share[world_object] + order for turn in range(count)]
    return [np.where(number < episodes, number, -1) for number in numbers]


def _run_round(
    env: Any,
    policy: Policy,
    start: np.ndarray,
    goal: np.ndarray,
    world_episode: np.ndarray,
    recorded: dict[tuple[int, int], Episode],
    on_step: Callable[[int], object],
) -> None:
    """Run every world, just reset, to the end of its episode.

    Args:
        env: The environment.
        policy: What to evaluate.
        start: Orientations the objects have, shape [N, 4].
        goal: Goals of the worlds, shape [N, 4].
        world_episode: Number of each world's episode, -1 for none, shape [N].
        recorded: Gets the episodes by object and number.
        on_step: See :func:`collect`.
    """
    world_object = np.asarray(env.world_object)
    running = world_episode >= 0
    for step in range(1, env.max_episode_steps + 1):
        action = policy.act(wp.to_torch(env.observation))
        env.step(wp.from_torch(action.detach().contiguous().float(), dtype=wp.float32))
        ended = running & (env.done.numpy() != 0)
        if ended.any():
            pose = env.object_pose_end.numpy()
            success, fell = env.success.numpy() != 0, env.fell.numpy() != 0
            for w in np.flatnonzero(ended):
                k, m = int(world_object[w]), int(world_episode[w])
                symmetry = env.objects[k].symmetry
                recorded[k, m] = Episode(
                    object_index=k,
                    start_quat=_quat(start[w]),
                    goal_quat=_quat(goal[w]),
                    start_error_rad=float(symmetric_error(start[w], goal[w], symmetry)),
                    error_rad=float(symmetric_error(unit_quats(pose[w, 3:7]), goal[w], symmetry)),
                    exact_error_rad=float(rotation_angle(unit_quats(pose[w, 3:7]), goal[w])),
                    steps=step,
                    stopped=bool(success[w] and not fell[w]),
                    fell=bool(fell[w]),
                )
            running &= ~ended
        on_step(len(recorded))
        if not running.any():
            return
    raise RuntimeError(
        f"{np.count_nonzero(running)} worlds did not end within max_episode_steps = {env.max_episode_steps}"
    )


def unit_quats(quat: np.ndarray) -> np.ndarray:
    """Quaternions [.., 4] of length 1, in double precision."""
    quat = quat.astype(float)
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def _quat(values: Sequence[float] | np.ndarray) -> tuple[float, float, float, float]:
    x, y, z, w = (float(value) for value in values)
    return x, y, z, w
