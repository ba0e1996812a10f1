"""How much of each of two hidden effects shows beside the other, on the plant in which they are hidden.

A pair can be named only if the recording holds both: beside a profile that accelerates slowly, a limit of
torque does not act. What an effect adds to the motion is compared with what the base parameters and the other
effect's own can imitate, to first order, as the sizes of single effects are (:mod:`vd.bench.gap_sizes`).
"""

from dataclasses import replace

import numpy as np

from vd.bench.gap_sizes import CALIBRATION_STEP_S, nudged
from vd.bench.hidden_plant import Plant, Run, simulate
from vd.bench.hide import Hiding, machine, noise_floor
from vd.gap.excitations import excitation_set

NUDGE = 0.05
"""Relative change of an effect's parameter for its sensitivity."""
BATCH = 8
"""Motions simulated together."""


def beside(hiding: Hiding) -> dict[str, float]:
    """The gap that each hidden effect leaves beside the others, in noise floors.

    Args:
        hiding: The recording, with two effects or more.

    Returns:
        Root-mean-square difference that the effect makes and nothing else in the machine imitates, by name;
        the noise adds its own floor, so that 1 is nothing.
    """
    reach, full = machine(hiding, np.random.default_rng(hiding.seed))
    variants, first = [full], {}
    for name in full.effects:
        without = replace(full, effects={k: v for k, v in full.effects.items() if k != name})
        first[name] = len(variants)
        variants += [without, *nudged(without), *_effects_nudged(without)]
    ends = [*list(first.values())[1:], len(variants)]
    motions = sorted(excitation_set(reach, hiding.excitations), key=lambda motion: motion.duration)
    parts, owner = [], []
    for start in range(0, len(motions), BATCH):
        group = motions[start : start + BATCH]
        runs = [
            Run(plant, m.time, m.command, m.enabled, m.conditions, seed=start + i)
            for i, m in enumerate(group)
            for plant in variants
        ]
        paths = simulate(runs, dt=CALIBRATION_STEP_S)
        for i, motion in enumerate(group):
            joint = full.joints.index(motion.joints[0])
            own = paths[i * len(variants) : (i + 1) * len(variants)]
            parts.append(np.stack([path[:, joint] for path in own]))
            owner.append(np.full(parts[-1].shape[1], joint))
    answers, of = np.concatenate(parts, axis=1), np.concatenate(owner)
    result = {}
    for (name, begin), end in zip(first.items(), ends, strict=True):
        without, changed = answers[begin], answers[begin + 1 : end] - answers[begin]
        columns = np.concatenate([changed * (of == joint) for joint in range(len(full.joints))])
        columns = columns[np.abs(columns).max(axis=1) > 0.0].T
        difference = answers[0] - without
        left = difference - columns @ np.linalg.lstsq(columns, difference, rcond=None)[0]
        result[name] = float(np.hypot(np.sqrt(np.mean(left**2)) / noise_floor(hiding.noise_rad), 1.0))
    return result


def _effects_nudged(plant: Plant) -> list[Plant]:
    """The plant with each parameter of its effects raised a little."""
    return [
        replace(plant, effects={**plant.effects, name: {**values, key: value * (1.0 + NUDGE)}})
        for name, values in plant.effects.items()
        for key, value in values.items()
    ]
