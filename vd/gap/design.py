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
    name = chain.joints[joint]
    column = int(chain.columns[joint])
    moving = []
    for i, trajectory in enumerate(recording.trajectories):
        if name in trajectory.joints and np.ptp(trajectory.command[:, column]) > 0.0:
            moving.append(i)
    if not moving:
        return (), (), None
    spread = np.linspace(0, len(moving) - 1, MAX_MOTIONS).round().astype(int)
    own = [moving[i] for i in np.unique(spread)]
    aside = None
    if len(own) >= ENOUGH:
        sizes = [np.ptp(recording.trajectories[i].command[:, column]) for i in own]
        aside = own.pop(int(np.argsort(sizes, kind="stable")[len(own) // 2]))
    chosen = set(own)
    for other in range(len(chain.joints)):
        if other != joint:
            size = {}
            for i, t in enumerate(recording.trajectories):
                if t.joints == (chain.joints[other],):
                    size[i] = np.ptp(t.command[:, chain.columns[other]])
            chosen |= set(sorted(size, key=lambda i: -size[i])[:BYSTANDERS])
    trajectories = sorted(chosen)
    condition = varied([recording.trajectories[i] for i in own])
    parts = [recording.trajectories[i] for i in trajectories]
    labels = [str(t.conditions.get(condition)) if condition else t.excitation for t in parts]
    kinds = sorted(set(labels))
    if len(kinds) < 2:
        labels = [str(i) for i in trajectories]
        kinds = [str(i) for i in trajectories]
    folds = tuple(kinds.index(label) % MAX_FOLDS for label in labels)
    return tuple(trajectories), folds, aside


def pieces(
    recording: Recording, chain: Chain, trajectories: Sequence[int]
) -> tuple[tuple[int, int], ...]:
    """What is analysed of each trajectory, samples ``(first, end)``.

    Empty for a recording taken whole.

    Different motions say more than long ones: of a long recording, a piece of every trajectory, the
    one that covers the widest range of those that begin at rest, as a simulation must.
    """
    lengths = np.array([recording.trajectories[i].time[-1] for i in trajectories])
    if lengths.sum() <= MAX_MOTION_S:
        return ()
    left = MAX_MOTION_S
    share = 0.0
    for done, length in enumerate(np.sort(lengths)):
        share = left / (len(lengths) - done)
        if length > share:
            break
        left -= length
    return tuple(_widest(recording, chain, recording.trajectories[i], share) for i in trajectories)


def _widest(
    recording: Recording, chain: Chain, trajectory: Trajectory, share: float
) -> tuple[int, int]:
    """The first piece of ``share`` seconds from rest in which the joints cover about the most they do."""
    time = trajectory.time
    if time[-1] <= share:
        return 0, len(time)
    columns = [int(column) for column in chain.columns]
    rest = np.logical_and.reduce(
        [held(trajectory, c, recording.encoder_resolution_rad) for c in columns]
    )
    rest[0] = True
    starts = np.flatnonzero(rest & (time <= time[-1] - share))
    ends = np.searchsorted(time, time[starts] + share)
    position = trajectory.position[:, columns]
    parts = zip(starts, ends, strict=True)
    covered = np.array([np.ptp(position[first:end], axis=0).sum() for first, end in parts])
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
