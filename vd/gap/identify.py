"""The paper's identification of a hand's drives (Methods, identification of robot dynamics): CMA-ES alone.

Stiffness, damping and velocity limit of a finger's joints by the squared error of its trajectories, all of
them with every candidate at once (:mod:`vd.gap.rollout`).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_layer import write_layer
from vd.assets_usd.hand_model import HandModel
from vd.gap.chain import chains
from vd.gap.close import counterparts
from vd.gap.recording import Recording
from vd.gap.rollout import STEP_S, Rollouts
from vd.kernels.servo.effects import BASELINE

SEARCHED = BASELINE[:3]
"""What the paper identifies: stiffness, damping, velocity limit."""
SEARCH_SPREAD = 0.3
"""First standard deviation of the search, in logarithms of the parameters."""


@dataclass(frozen=True)
class Identified:
    """What the search found, for K identified joints."""

    joints: tuple[str, ...]
    """Names of the joints."""
    kp: list[float]
    """Stiffness [N m/rad] [K]."""
    kd: list[float]
    """Damping [N m s/rad] [K]."""
    velocity_limit: list[float]
    """Velocity limit [rad/s] [K]."""
    rmse: dict[str, float]
    """Root mean squared error over the trajectories that excite a finger, by finger [rad]."""
    start_rmse: dict[str, float]
    """The same of the values that the search started from [rad]."""
    rollouts: int
    """Trajectories simulated."""
    seconds: float
    """Time that took."""


def identify(
    recording: Recording,
    hand: HandModel,
    *,
    generations: int = 100,
    population: int = 64,
    dt: float = STEP_S,
    device: str = "cpu",
    seed: int = 0,
    progress: Callable[[int, str, float], None] = lambda generation, finger, best: None,
) -> Identified:
    """Identify stiffness, damping and velocity limits of all joints that some motion excites.

    Args:
        recording: A recording of the hand.
        hand: The hand.
        generations: Generations of each finger's search.
        population: Candidates of a generation.
        dt: Physics step [s].
        device: Warp device.
        seed: Seed of the search.
        progress: Called after each generation with its number, the finger and its best error [rad].

    Raises:
        ValueError: The recording is not of this hand.
    """
    began, count = time.perf_counter(), 0
    columns: dict[str, list[float]] = {}
    rmse: dict[str, float] = {}
    start_rmse: dict[str, float] = {}
    for chain in chains(recording, hand):
        parts = [i for i, t in enumerate(recording.trajectories) if {*chain.joints} & {*t.joints}]
        moved = [j for j, n in enumerate(chain.joints) if any(n in t.joints for t in recording.trajectories)]
        if not parts:
            continue
        finger = chain.name
        rollouts = Rollouts(chain, recording, dt=dt, device=device)
        measured = rollouts.measured[np.isin(rollouts.sample_trajectory, parts)]
        places = np.ix_(range(population), moved, [p.column for p in SEARCHED])
        rows = np.repeat(chain.start_row[None], population, axis=0)
        best = rows[places][0]
        error = start_rmse[finger] = _errors(rollouts, rows[:1], parts, measured)[0]
        search = _search(best, population, seed + len(rmse) + 1)
        for generation in range(generations):
            asked = search.ask()
            rows[places] = np.exp(np.array(asked)).reshape(population, *best.shape)
            errors = _errors(rollouts, rows, parts, measured)
            search.tell(asked, (errors**2).tolist())
            if errors.min() < error:
                error, best = float(errors.min()), rows[places][np.argmin(errors)]
            progress(generation + 1, finger, error)
        count += generations * population * len(parts)
        rmse[finger] = error
        columns |= {chain.joints[j]: values for j, values in zip(moved, best.tolist(), strict=True)}
    kp, kd, limit = (list(values) for values in zip(*columns.values(), strict=True))
    return Identified(tuple(columns), kp, kd, limit, rmse, start_rmse, count, time.perf_counter() - began)


def _errors(rollouts: Rollouts, rows: np.ndarray, parts: list[int], measured: np.ndarray) -> np.ndarray:
    """RMSE [C] [rad] of chains with rows [C, n, P] on trajectories whose positions are ``measured``."""
    error = rollouts.predict(rows, parts) - measured
    return np.sqrt(np.einsum("csj,csj->c", error, error) / measured.size)


def _search(start: np.ndarray, population: int, seed: int) -> Any:
    """CMA-ES on the logarithms of the searched parameters [J, 3] of a finger's joints."""
    import cma

    low, high = ([np.log(getattr(p, end)) for _ in start for p in SEARCHED] for end in ("lower", "upper"))
    options = {"popsize": population, "seed": seed, "bounds": [low, high], "verbose": -9}
    return cma.CMAEvolutionStrategy(np.clip(np.log(start.ravel()), low, high), SEARCH_SPREAD, options)


def write_drives(
    found: Identified, path: Path, hand: HandModel, recording: Recording, *, every_finger: bool = False
) -> None:
    """Write what was found as a layer over the hand.

    Args:
        found: What the search found.
        path: File to write, ``.usda``.
        hand: The hand.
        recording: What it was identified from.
        every_finger: Give the joints of other fingers the drive of their counterpart, as the paper does.

    Raises:
        HandError: The path has another suffix.
    """
    source = {joint: joint for joint in found.joints}
    if every_finger:
        source |= counterparts(hand, found.joints)
    own = {
        joint: {p.name: float(getattr(found, p.name)[i]) for p in SEARCHED}
        for i, joint in enumerate(found.joints)
    }
    baseline = {joint: own[known] for joint, known in source.items()}
    write_layer(
        path, hand, baseline=baseline, effects={}, tool="vd-gap identify", recording=str(recording.path)
    )
