"""The paper's identification of a hand's drives (Methods, identification of robot dynamics), in Newton.

CMA-ES over stiffness, damping and velocity limit by the squared error of trajectories, all candidates and
trajectories simulated at once in parallel worlds, a search for every finger.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_layer import write_layer
from vd.assets_usd.hand_model import HandModel
from vd.gap.close import counterparts
from vd.gap.newton import DEFAULT_DT, HandReplay
from vd.gap.recording import Recording
from vd.kernels.servo.actuators import KD, KP, VELOCITY_LIMIT
from vd.kernels.servo.effects import BASELINE

SEARCHED = (KP, KD, VELOCITY_LIMIT)
"""What the paper identifies, by column of a parameter row."""
SEARCH_SPREAD = 0.3
"""First standard deviation of the search, in logarithms of the parameters."""


@dataclasses.dataclass(frozen=True)
class Identified:
    """What the search found, for K identified joints."""

    joints: tuple[str, ...]
    """Names of the joints."""
    kp: np.ndarray
    """Stiffness [N m/rad], shape [K]."""
    kd: np.ndarray
    """Damping [N m s/rad], shape [K]."""
    velocity_limit: np.ndarray
    """Velocity limit [rad/s], shape [K]."""
    rmse: dict[str, float]
    """Root mean squared error over the trajectories that excite a finger, by finger [rad]."""
    start_rmse: dict[str, float]
    """The same of the values that the search started from [rad]."""
    rollouts: int
    """Trajectories simulated, of one finger each."""
    seconds: float
    """Time that took, without building the worlds and compiling kernels."""

    @property
    def rollouts_per_second(self) -> float:
        """Trajectories of one finger simulated in a second."""
        return self.rollouts / self.seconds


def pack_tracks(recording: Recording, hand: HandModel, fingers: Sequence[int]) -> np.ndarray:
    """Spread the trajectories that excite each finger over worlds, long ones together, shape [W, F].

    Fingers not in ``fingers`` and slots that are left over get -1.

    Raises:
        ValueError: A finger that is to be identified was never excited.
    """
    queues: list[list[int]] = []
    for finger in range(hand.num_fingers):
        names = set(finger_joints(hand, finger))
        excited = [i for i, t in enumerate(recording.trajectories) if names & set(t.joints)]
        if finger in fingers and not excited:
            raise ValueError(
                f"{recording.path}: no trajectory excites finger {finger} ({', '.join(sorted(names))}); "
                "record one, or leave its joints out"
            )
        order = sorted(excited, key=lambda i: -recording.trajectories[i].time[-1])
        queues.append(order if finger in fingers else [])
    tracks = np.full((max(map(len, queues)), hand.num_fingers), -1)
    for finger, queue in enumerate(queues):
        tracks[: len(queue), finger] = queue
    return tracks


def finger_joints(hand: HandModel, finger: int) -> tuple[str, ...]:
    """Names of the joints of a finger."""
    return hand.joint_names[hand.fingers[finger]]


def identify(
    recording: Recording,
    hand: HandModel,
    joints: Sequence[str] | None = None,
    *,
    generations: int = 100,
    population: int = 64,
    dt: float = DEFAULT_DT,
    device: str = "cpu",
    seed: int = 0,
    progress: Callable[[int, dict[str, float]], None] = lambda generation, best: None,
    working: Callable[[float], None] = lambda share: None,
) -> Identified:
    """Identify stiffness, damping and velocity limits as the paper does: CMA-ES on parallel simulations.

    Every finger has a search of its own; they advance together, in the same worlds. The score is the
    squared error of the finger's joints over the trajectories that excite one of them.

    Args:
        recording: A recording of the hand.
        hand: The hand.
        joints: Joints to identify; all that some motion excites by default.
        generations: Generations of the search.
        population: Candidates of a generation; times the trajectories of a finger: the worlds.
        dt: Physics step [s].
        device: Warp device.
        seed: Seed of the search.
        progress: Called after each generation with its number and the best error of each finger [rad].
        working: Called in each generation with the share that is done.

    Raises:
        ValueError: A joint is not recorded or its finger was never excited.
    """
    excited = {joint for trajectory in recording.trajectories for joint in trajectory.joints}
    names = tuple(name for name in recording.joints if name in excited) if joints is None else tuple(joints)
    missing = [name for name in names if name not in recording.joints]
    if missing:
        raise ValueError(f"{recording.path}: joints {', '.join(missing)} are not recorded; leave them out")
    base = np.array(hand.servo, dtype=float)
    chosen = [hand.joint_names.index(name) for name in names]
    fingers = sorted({int(hand.joint_finger[joint]) for joint in chosen})
    tracks = pack_tracks(recording, hand, fingers)
    slots = len(tracks)
    replay = HandReplay(recording, hand, np.tile(tracks, (population, 1)), dt=dt, device=device)

    members = {f: [j for j in chosen if hand.joint_finger[j] == f] for f in fingers}
    searches = {f: _search(base[members[f]], population, seed + f + 1) for f in fingers}
    samples = {
        f: sum(len(recording.trajectories[i].time) for i in tracks[:, f] if i >= 0) * len(scored)
        for f in fingers
        if (scored := [n for n in finger_joints(hand, f) if n in recording.joints])
    }

    def evaluate(rows: np.ndarray) -> dict[int, np.ndarray]:
        """Mean squared error of each finger for rows [population, D, P]."""
        replay.run(np.repeat(rows, slots, axis=0), working)
        error = replay.squared_error.numpy().reshape(population, slots, -1)
        error = np.nan_to_num(error.astype(float), nan=np.inf)
        return {f: error[:, :, hand.fingers[f]].sum(axis=(1, 2)) / samples[f] for f in fingers}

    first = evaluate(np.tile(base, (population, 1, 1)))  # also compiles every kernel
    start_rmse = {f"f{f}": float(np.sqrt(first[f][0])) for f in fingers}
    best = {f: (first[f][0], base[np.ix_(members[f], SEARCHED)]) for f in fingers}
    began, rollouts = time.perf_counter(), 0
    for generation in range(generations):
        rows = np.tile(base, (population, 1, 1))
        asked = {f: searches[f].ask() for f in fingers}
        for f in fingers:
            values = np.exp(np.array(asked[f])).reshape(population, len(members[f]), len(SEARCHED))
            rows[np.ix_(range(population), members[f], SEARCHED)] = values
        scores = evaluate(rows)
        rollouts += population * int(np.count_nonzero(tracks >= 0))
        for f in fingers:
            searches[f].tell(asked[f], scores[f].tolist())
            winner = int(np.argmin(scores[f]))
            if scores[f][winner] < best[f][0]:
                best[f] = (scores[f][winner], rows[winner][np.ix_(members[f], SEARCHED)])
        progress(generation + 1, {f"f{f}": float(np.sqrt(best[f][0])) for f in fingers})
    found = base.copy()
    for f in fingers:
        found[np.ix_(members[f], SEARCHED)] = best[f][1]
    return Identified(
        joints=names,
        kp=found[chosen, KP],
        kd=found[chosen, KD],
        velocity_limit=found[chosen, VELOCITY_LIMIT],
        rmse={f"f{f}": float(np.sqrt(best[f][0])) for f in fingers},
        start_rmse=start_rmse,
        rollouts=rollouts,
        seconds=time.perf_counter() - began,
    )


def _search(start: np.ndarray, population: int, seed: int) -> Any:
    """CMA-ES on the logarithms of the searched parameters of a finger's joints.

    Args:
        start: Servo parameters of its joints, shape [J, P].
        population: Candidates of a generation.
        seed: Seed of the search.
    """
    import cma

    bounds = {p.column: (p.lower, p.upper) for p in BASELINE}
    centre = np.log(start[:, SEARCHED]).flatten()
    low = np.log([bounds[c][0] for _ in start for c in SEARCHED])
    high = np.log([bounds[c][1] for _ in start for c in SEARCHED])
    options = {"popsize": population, "seed": seed, "bounds": [low, high], "verbose": -9}
    return cma.CMAEvolutionStrategy(np.clip(centre, low, high), SEARCH_SPREAD, options)


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
    columns = {"kp": found.kp, "kd": found.kd, "velocity_limit": found.velocity_limit}
    baseline = {
        joint: {name: float(values[found.joints.index(known)]) for name, values in columns.items()}
        for joint, known in source.items()
    }
    write_layer(
        path, hand, baseline=baseline, effects={}, tool="vd-gap identify", recording=str(recording.path)
    )
