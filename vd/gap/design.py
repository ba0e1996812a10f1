"""Which trajectories speak about a joint, and how they are held out."""

from collections.abc import Sequence

import numpy as np

from vd.gap.chain import Chain
from vd.gap.statistics import held
from vd.logs.recording import Recording, Trajectory
from vd.logs.recording_checks import MIN_KINDS

MAX_FOLDS = 6
"""Groups of motions that are held out in turn: each costs a refit of every model. Not tuned."""
BYSTANDERS = 2
"""Trajectories of each other joint of the chain in which a joint's own rest is fitted too; of one,
a coupling would have no interval. More were not tried."""
MAX_MOTION_S = 150.0
"""Motion of a joint that is fitted [s], twice what the paper records: for time. Not tuned."""
MAX_MOTIONS = 30
"""Trajectories of a joint that are fitted, spread over the recording: 5 s of each. Not tuned."""
NEARLY = 0.95
"""Share of the widest range that a piece must cover to be taken for being the earliest. Of the
SO-101's elbow the widest piece alone (1 in its place) names asymmetric friction for gravity and
Coulomb friction.
"""

ENOUGH = 10
"""Motions of a joint from which one is kept from every fit, to judge what is delivered. Not tuned."""


def design(
    recording: Recording, chain: Chain, joint: int
) -> tuple[tuple[int, ...], tuple[int, ...], int | None]:
    """Trajectories of a joint, their folds, and the one that no fit sees.

    Those that excite it, and the largest motions of the other joints of its chain, in which it
    should hold. Folds are values of a condition that was varied (gain, payload, supply), or kinds
    of motion. No fit sees the motion of middle size, where there are :data:`ENOUGH`.

    Returns:
        ``(trajectories, folds, aside)``, empty and None for a joint that nothing excites.
    """
    column = int(chain.columns[joint])
    own = _moving(recording, chain, joint)
    if not own:
        return (), (), None
    spread = np.linspace(0, len(own) - 1, MAX_MOTIONS).round().astype(int)
    own = [own[i] for i in np.unique(spread)]
    aside = None
    if len(own) >= ENOUGH:
        ranked = sorted(own, key=lambda i: np.ptp(recording.trajectories[i].command[:, column]))
        aside = ranked[len(own) // 2]
        own.remove(aside)
    trajectories = sorted({*own, *_bystanders(recording, chain, joint)})
    condition = varied([recording.trajectories[i] for i in own])
    labels = []
    for i in trajectories:
        trajectory = recording.trajectories[i]
        value = trajectory.conditions.get(condition) if condition else trajectory.excitation
        labels.append(str(value))
    kinds = sorted({*labels})
    if len(kinds) < 2:
        kinds = labels = [*map(str, trajectories)]
    folds = tuple(kinds.index(label) % MAX_FOLDS for label in labels)
    return tuple(trajectories), folds, aside


def _moving(recording: Recording, chain: Chain, joint: int) -> list[int]:
    """Trajectories that excite a joint."""
    result = []
    for i, trajectory in enumerate(recording.trajectories):
        command = trajectory.command[:, chain.columns[joint]]
        if chain.joints[joint] in trajectory.joints and np.ptp(command) > 0.0:
            result.append(i)
    return result


def _bystanders(recording: Recording, chain: Chain, joint: int) -> list[int]:
    """Trajectories of the largest motions of each other joint alone."""
    result: list[int] = []
    for other, column in enumerate(chain.columns):
        size = {}
        for i, trajectory in enumerate(recording.trajectories):
            if other != joint and trajectory.joints == (chain.joints[other],):
                size[i] = -np.ptp(trajectory.command[:, column])
        result += sorted(size, key=size.__getitem__)[:BYSTANDERS]
    return result


def pieces(
    recording: Recording, chain: Chain, trajectories: Sequence[int]
) -> tuple[tuple[int, int], ...]:
    """What is analysed of each trajectory, samples ``(first, end)``.

    Empty for a recording taken whole.

    Different motions say more than long ones: of a long recording, a piece of every trajectory, the
    one that covers the widest range of those that begin at rest, as a simulation must.
    """
    chosen = [recording.trajectories[i] for i in trajectories]
    left = MAX_MOTION_S
    for done, trajectory in enumerate(sorted(chosen, key=lambda t: t.duration)):
        share = left / (len(chosen) - done)
        if trajectory.duration > share:
            return tuple(_widest(recording, chain, each, share) for each in chosen)
        left -= trajectory.duration
    return ()


def _widest(
    recording: Recording, chain: Chain, trajectory: Trajectory, share: float
) -> tuple[int, int]:
    """The first piece of ``share`` seconds from rest in which the joints cover about the most they do."""
    time = trajectory.time
    if time[-1] <= share:
        return 0, len(time)
    rest = np.ones(len(time), bool)
    for column in chain.columns:
        rest &= held(trajectory, int(column), recording.encoder_resolution_rad)
    rest[0] = True
    starts = np.flatnonzero(rest & (time <= time[-1] - share))
    ends = np.searchsorted(time, time[starts] + share)
    covered = np.zeros(len(starts))
    for k, (first, end) in enumerate(zip(starts, ends, strict=True)):
        covered[k] = np.ptp(trajectory.position[first:end, chain.columns], axis=0).sum()
    best = int(np.argmax(covered >= NEARLY * covered.max()))
    return int(starts[best]), int(ends[best])


def varied(trajectories: list[Trajectory]) -> str | None:
    """The condition whose values are held out.

    That with the most, if two are left when one is held out.
    """
    values: dict[str, set[str]] = {}
    for trajectory in trajectories:
        for name, value in trajectory.conditions.items():
            values.setdefault(name, set()).add(str(value))
    best = max(sorted(values), key=lambda name: len(values[name]), default=None)
    return best if best is not None and len(values[best]) >= MIN_KINDS else None
