"""What a reader of a report should know of the recording: what limits an analysis without forbidding it."""

import numpy as np

from vd.gap.recording import Recording

MIN_KINDS = 4
"""Kinds of motion below which little is left to fit when one is held out."""
SLOW_S = 0.025
"""Median time between samples [s] above which steps of a servo are not resolved: 50 Hz, a quarter late."""
COARSE = 1.5
"""Smallest step of a reading, in encoder counts, above which it is coarser than the recording says."""
MIN_LEVELS = 20
"""Distinct readings from which the smallest step between two of them is a count."""


def cautions(recording: Recording) -> tuple[str, ...]:
    """Plain sentences about what the recording cannot show well, joints together where they share one."""
    found: list[str] = []
    jumped = {joint: None for t in recording.trajectories for joint in t.unwrapped}
    if jumped:
        found.append(
            f"Command or position of {', '.join(jumped)} jumped by whole turns, as angles wrapped at pi do: "
            "they are analysed unwrapped."
        )
    kinds = {joint: _kinds(recording, joint) for joint in recording.joints}
    idle = [joint for joint, names in kinds.items() if not names]
    few = [joint for joint, names in kinds.items() if 0 < len(names) < MIN_KINDS]
    if idle:
        found.append(f"No motion moves {', '.join(idle)}: nothing is said about it.")
    if few:
        found.append(
            f"Fewer than {MIN_KINDS} kinds of motion move {', '.join(few)}: little is left to fit when one "
            "is held out."
        )
    between = float(np.median(np.concatenate([np.diff(t.time) for t in recording.trajectories])))
    if between > SLOW_S:
        found.append(
            f"Samples are {1e3 * between:.0f} ms apart: what a servo does at the beginning of a step is not "
            "resolved; record at 50 Hz or more."
        )
    coarse = {joint: step for joint in recording.joints if (step := _step(recording, joint)) is not None}
    for joint, step in coarse.items():
        if step > COARSE * recording.encoder_resolution_rad:
            found.append(
                f"Positions of {joint} come in steps of {1e3 * step:.3g} mrad, where recording.json says "
                f"{1e3 * recording.encoder_resolution_rad:.3g}: correct the size of a count, or the noise "
                "floor may be too low."
            )
    return tuple(found)


def _kinds(recording: Recording, joint: str) -> set[str]:
    return {t.excitation for t in recording.trajectories if joint in t.joints}


def _step(recording: Recording, joint: str) -> float | None:
    """Smallest step between two readings of a joint [rad]; None where there are too few to tell."""
    column = recording.joints.index(joint)
    levels = np.unique(np.concatenate([t.position[:, column] for t in recording.trajectories]).round(6))
    return float(np.diff(levels).min()) if len(levels) >= MIN_LEVELS else None
