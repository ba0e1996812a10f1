"""Which trajectories speak about a joint, and how they are held out."""

import numpy as np

from vd.gap.recording import Recording, Trajectory
from vd.gap.rollout import Chain

MAX_FOLDS = 6
BYSTANDERS = 2
"""Trajectories of each other joint of the chain in which a joint's own rest is fitted too."""
CONDITION_VALUES = 3
"""Values of a condition from which on its values, not the motions, are held out."""
MAX_SAMPLES = 15_000
"""Samples of a joint that are fitted; the rest is held out for good."""


def design(recording: Recording, chain: Chain, joint: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Trajectories of a joint and their folds.

    Those that excite it, and the largest motions of the other joints of its chain, in which it should
    hold. Folds are values of a condition that was varied (gain, payload, supply), or kinds of motion.

    Returns:
        ``(trajectories, folds)``, both empty for a joint that nothing excites.
    """
    name = chain.joints[joint]
    column = int(chain.columns[joint])
    own = [
        i
        for i, t in enumerate(recording.trajectories)
        if name in t.joints and float(np.ptp(t.command[:, column])) > 0.0
    ]
    own = _within_budget(recording, own)
    if not own:
        return (), ()
    chosen = set(own)
    for other in range(len(chain.joints)):
        if other != joint:
            chosen |= set(_largest(recording, chain.joints[other], int(chain.columns[other]))[:BYSTANDERS])
    trajectories = sorted(chosen)
    condition = _varied([recording.trajectories[i] for i in own])
    labels = [_label(recording.trajectories[i], condition) for i in trajectories]
    kinds = sorted(set(labels))
    if len(kinds) < 2:
        labels, kinds = [str(i) for i in trajectories], [str(i) for i in trajectories]
    return tuple(trajectories), tuple(kinds.index(label) % MAX_FOLDS for label in labels)


def _largest(recording: Recording, name: str, column: int) -> list[int]:
    """Trajectories that excite a joint alone, by the size of the motion."""
    alone = [i for i, t in enumerate(recording.trajectories) if t.joints == (name,)]
    return sorted(alone, key=lambda i: -float(np.ptp(recording.trajectories[i].command[:, column])))


def _within_budget(recording: Recording, own: list[int]) -> list[int]:
    """As many trajectories as the budget of samples allows, spread over the recording."""
    total = sum(len(recording.trajectories[i].time) for i in own)
    if total <= MAX_SAMPLES:
        return own
    # Short ones first: different motions say more than long ones.
    kept: list[int] = []
    used = 0
    for i in sorted(own, key=lambda i: len(recording.trajectories[i].time)):
        used += len(recording.trajectories[i].time)
        if used > MAX_SAMPLES and len(kept) >= MAX_FOLDS:
            break
        kept.append(i)
    return sorted(kept)


def _varied(trajectories: list[Trajectory]) -> str | None:
    """The condition whose values are held out: the one with the most values, if they are enough."""
    names = sorted({name for t in trajectories for name in t.conditions})
    counts = {
        name: len({str(t.conditions[name]) for t in trajectories if name in t.conditions}) for name in names
    }
    best = max(names, key=lambda name: counts[name], default=None)
    return best if best is not None and counts[best] >= CONDITION_VALUES else None


def _label(trajectory: Trajectory, condition: str | None) -> str:
    """What is held out together."""
    return str(trajectory.conditions.get(condition)) if condition else trajectory.excitation
