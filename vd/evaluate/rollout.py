"""Starts and goals of an evaluation, and the rounds in which many environments run them."""

import zlib
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

# Points of the inverse of the cumulative distribution of goal angles; linear between them.
ANGLE_GRID = 4096


def draw_starts_and_goals(
    names: Sequence[str], episodes: int, *, seed: int, max_goal_angle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the initial and goal orientations of objects.

    They depend on an object's name, the seed and the number of the episode alone: not on the other
    objects, the number of environments or the device. Starts are uniform on SO(3); goals are
    uniform on the part of SO(3) within ``max_goal_angle`` [rad], in (0, pi], of the start.

    Returns:
        Starts and goals, quaternions xyzw, shapes [K, M, 4].
    """
    starts = []
    goals = []
    for name in names:
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        start = Rotation.random(episodes, rng=rng).as_quat()
        starts.append(start)
        goals.append(draw_goals(start, rng, max_goal_angle))
    return np.stack(starts), np.stack(goals)


def draw_goals(start: np.ndarray, rng: np.random.Generator, max_goal_angle: float) -> np.ndarray:
    """Orientations xyzw [n, 4], uniform on SO(3) within ``max_goal_angle`` [rad] of ``start``."""
    axis = rng.normal(size=(len(start), 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    # The angle of a uniform rotation has density (1 - cos)/pi: invert its cumulative distribution.
    grid = np.linspace(0.0, max_goal_angle, ANGLE_GRID)
    cumulative = grid - np.sin(grid)
    share = rng.random(len(start)) * cumulative[-1]
    angle = np.interp(share, cumulative, grid)
    turn = Rotation.from_rotvec(axis * angle[:, None])
    return (turn * Rotation.from_quat(start)).as_quat()


def draw_turns(
    names: Sequence[str], episodes: int, most: int, *, seed: int, max_goal_angle: float
) -> np.ndarray:
    """Rotations from where objects are to their goals in a row [K, M, most, 4].

    They depend on name, seed and episode.
    """
    turns = []
    for name in names:
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), most])
        identity = np.tile([0.0, 0.0, 0.0, 1.0], (episodes * most, 1))
        turn = draw_goals(identity, rng, max_goal_angle)
        turns.append(turn.reshape(episodes, most, 4))
    return np.stack(turns)


def episode_rounds(world_object: np.ndarray, objects: int, episodes: int) -> list[np.ndarray]:
    """For every round the episode number of each environment, -1 for none: a list of [N] arrays."""
    envs_of = np.bincount(world_object, minlength=objects)
    if not envs_of.all():
        raise ValueError(
            f"no environment simulates object {envs_of.argmin()}; raise the number of environments "
            f"to {objects}"
        )
    place = place_of(world_object)
    rounds = []
    for turn in range(int(np.ceil(episodes / envs_of.min()))):
        number = turn * envs_of[world_object] + place
        rounds.append(np.where(number < episodes, number, -1))
    return rounds


def place_of(world_object: np.ndarray) -> np.ndarray:
    """Place of each environment among those of its object, from 0, shape [N]."""
    place = np.zeros_like(world_object)
    for k in np.unique(world_object):
        same = world_object == k
        place[same] = np.arange(same.sum())
    return place


def unit_quats(quat: np.ndarray) -> np.ndarray:
    """Quaternions [.., 4] of length 1, in double precision."""
    quat = quat.astype(float)
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)
