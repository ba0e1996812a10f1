"""Where simulation and measurement disagree: per joint and phase of motion, in plain words and numbers."""

from collections.abc import Mapping

import numpy as np

from vd.gap.recording import Recording, Trajectory
from vd.gap.result import Finding
from vd.gap.statistics import HOLD_S, held

SMOOTH_S = 0.05
"""Window over which speeds are taken [s]: longer than an encoder count at low speed."""
AFTER_S = 0.15
"""Time after a command starts to move from rest, or a joint turns [s]."""
FAST = 0.6
"""Share of the joint's largest speed above which motion is fast."""
SLOW = 0.1
"""Share of it below which motion is slow."""
HEAVY = 0.7
"""Share of the largest pull (command minus position) above which the servo works hard."""
NOTABLE = 2.0
"""A phase is reported if its RMS is this many noise floors."""
MAX_FINDINGS = 2
"""Findings of a joint."""
SYSTEMATIC = 0.5
"""Share of the RMS that the mean must have for a sign to be reported."""

PHASES: dict[str, tuple[str, str]] = {
    "onset": ("when the command starts to move", f"for {1e3 * AFTER_S:.0f} ms"),
    "reversal": ("after each reversal", f"for {1e3 * AFTER_S:.0f} ms"),
    "hold": ("while holding still", ""),
    "fast": ("in fast motion", ""),
    "slow": ("in slow motion", ""),
    "load": ("when the servo pulls hard", ""),
}
"""Phase -> when, and for how long."""


def speed_of(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Speed over ``SMOOTH_S`` [T] [rad/s], without the noise of encoder counts."""
    half = 0.5 * SMOOTH_S
    ahead = np.interp(time + half, time, position)
    behind = np.interp(time - half, time, position)
    return (ahead - behind) / SMOOTH_S


def _after(events: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Samples soon after an event."""
    when = np.where(events, time, -np.inf)
    return time - np.maximum.accumulate(when) <= AFTER_S


def phases(trajectory: Trajectory, joint: int, resolution: float, top: float) -> dict[str, np.ndarray]:
    """Samples of each phase of motion of a joint, [T] bool each; phases overlap.

    Args:
        trajectory: The trajectory.
        joint: Column of the joint.
        resolution: Encoder count [rad].
        top: The joint's largest speed in the recording [rad/s].
    """
    time, position = trajectory.time, trajectory.position[:, joint]
    command = trajectory.command[:, joint]
    speed = speed_of(time, position)
    rest = held(trajectory, joint, resolution)
    moving = np.abs(speed) > max(0.02 * top, resolution / SMOOTH_S)
    direction = np.where(moving, np.sign(speed), 0.0)
    # The last direction of motion, carried through rests.
    index = np.maximum.accumulate(np.where(direction != 0.0, np.arange(len(time)), 0))
    carried = direction[index]
    reversed_ = np.diff(carried, prepend=carried[0]) != 0.0
    changed = np.diff(command, prepend=command[0]) != 0.0
    first = np.searchsorted(time, time - HOLD_S)
    count = np.cumsum(changed)
    before = np.concatenate([[0], count[:-1]])
    onset = changed & (before - count[first] == 0) & (time > 0.0)
    pull = np.abs(command - position)
    return {
        "onset": _after(onset, time),
        "reversal": _after(reversed_, time),
        "hold": rest,
        "fast": np.abs(speed) > FAST * top,
        "slow": moving & (np.abs(speed) < SLOW * top) & ~rest,
        "load": pull > HEAVY * max(float(pull.max()), 1e-12),
    }


def findings(recording: Recording, predicted: np.ndarray, floors: Mapping[str, float]) -> list[Finding]:
    """Findings of all joints, the worst phase of each first.

    Args:
        recording: The recording.
        predicted: The baseline's positions of all trajectories, one after the other [S, J] [rad].
        floors: Noise floor of each joint that was fitted [rad].
    """
    ends = np.cumsum([len(t.time) for t in recording.trajectories])[:-1]
    parts = np.split(predicted, ends)
    found = []
    for column, name in enumerate(recording.joints):
        if name in floors:
            found += _joint(recording, parts, column, floors[name])
    return found


def _joint(recording: Recording, parts: list[np.ndarray], column: int, floor: float) -> list[Finding]:
    name = recording.joints[column]
    pairs = [(t, p) for t, p in zip(recording.trajectories, parts, strict=True) if name in t.joints]
    speeds = [speed_of(t.time, t.position[:, column]) for t, _ in pairs]
    top = float(np.percentile(np.abs(np.concatenate(speeds)), 99.5)) + 1e-9
    residual = np.concatenate([t.position[:, column] - p[:, column] for t, p in pairs])
    speed = np.concatenate(speeds)
    masks = [phases(t, column, recording.encoder_resolution_rad, top) for t, _ in pairs]
    overall = float(np.sqrt(np.mean(residual**2)))
    rows = []
    for phase in PHASES:
        mask = np.concatenate([m[phase] for m in masks])
        if not mask.any():
            continue
        part, direction = residual[mask], np.sign(speed[mask])
        rms = float(np.sqrt(np.mean(part**2)))
        rows.append((rms, phase, part, direction, float(mask.mean())))
    rows.sort(key=lambda row: -row[0])
    chosen = [row for row in rows if row[0] > NOTABLE * floor][:MAX_FINDINGS]
    return [_finding(name, row, overall, floor) for row in chosen]


def _finding(
    name: str, row: tuple[float, str, np.ndarray, np.ndarray, float], overall: float, floor: float
) -> Finding:
    """One phase in words."""
    rms, phase, residual, direction, share = row
    mean, along = float(np.mean(residual)), float(np.mean(residual * direction))
    when, span = PHASES[phase]
    if abs(along) > SYSTEMATIC * rms:
        verb, size = ("runs ahead of the model" if along > 0.0 else "lags behind the model"), abs(along)
    elif abs(mean) > SYSTEMATIC * rms:
        verb, size = ("sits above the model" if mean > 0.0 else "sits below the model"), abs(mean)
    else:
        verb, size = "departs from the model, both ways,", rms
    text = f"{name}: {when} the joint {verb} by {1e3 * size:.1f} mrad{' ' + span if span else ''}"
    signature = {
        "rms_rad": rms,
        "mean_rad": mean,
        "along_motion_rad": along,
        "share_of_time": share,
        "overall_rms_rad": overall,
        "noise_floor_rad": floor,
    }
    return Finding(name, text, signature)
