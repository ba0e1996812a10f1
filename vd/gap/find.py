"""Where simulation and measurement disagree.

Per joint and phase of motion, in plain words and numbers.
"""

from collections.abc import Mapping

import numpy as np

from vd.gap.result import Misfit
from vd.gap.statistics import HOLD_S, REPEATABLE, SMOOTH_S, held, speed_of
from vd.logs.recording import Recording, Trajectory

PHASES = {
    "onset": f"for {1e3 * HOLD_S:.0f} ms after the command starts to move",
    "reversal": f"for {1e3 * HOLD_S:.0f} ms after each reversal",
    "hold": "while holding still",
    "fast": "in fast motion",
    "slow": "in slow motion",
    "load": "when the servo pulls hard",
}
"""Phase -> when."""


def phases(
    trajectory: Trajectory, joint: int, resolution: float, top: float
) -> dict[str, np.ndarray]:
    """Samples of each phase of motion of a joint, [T] bool each; phases overlap.

    Args:
        trajectory: The trajectory.
        joint: Column of the joint.
        resolution: Encoder count [rad].
        top: The joint's largest speed in the recording [rad/s].
    """
    time = trajectory.time
    command = trajectory.command[:, joint]
    position = trajectory.position[:, joint]
    speed = speed_of(time, position)
    rest = held(trajectory, joint, resolution)
    moving = np.abs(speed) > max(0.02 * top, resolution / SMOOTH_S)
    # The last direction of motion, carried through rests.
    last = (moving * np.sign(speed))[np.maximum.accumulate(moving * np.arange(len(time)))]
    changed = np.diff(command, prepend=command[0]) != 0.0
    count = np.cumsum(changed)
    onset = changed & (count - 1 == count[np.searchsorted(time, time - HOLD_S)])
    # More than half of the largest is fast, or a hard pull.
    pull = np.abs(command - position)
    fast = np.abs(speed) > 0.5 * top

    def after(events: np.ndarray) -> np.ndarray:
        return time - np.maximum.accumulate(np.where(events, time, -np.inf)) <= HOLD_S

    return {
        "onset": after(onset),
        "reversal": after(np.diff(last, prepend=last[0]) != 0.0),
        "hold": rest,
        "fast": fast,
        "slow": moving & ~fast & ~rest,
        "load": pull > 0.5 * max(float(pull.max()), 1e-12),
    }


def findings(
    recording: Recording, predicted: np.ndarray, floors: Mapping[str, float]
) -> list[Misfit]:
    """Findings of all joints: the two worst phases of each, the worst first.

    Args:
        recording: The recording.
        predicted: The baseline's positions of all trajectories, one after the other [S, J] [rad].
        floors: Noise floor of each joint that was fitted [rad].
    """
    found = []
    for column, name in enumerate(recording.joints):
        if name not in floors:
            continue
        own = []
        end = 0
        for trajectory in recording.trajectories:
            first = end
            end += len(trajectory.time)
            if name in trajectory.joints:
                left = trajectory.position[:, column] - predicted[first:end, column]
                own.append((trajectory, left))
        found += _joint(name, own, column, recording.encoder_resolution_rad, floors[name])
    return found


def _joint(
    name: str,
    pairs: list[tuple[Trajectory, np.ndarray]],
    column: int,
    resolution: float,
    floor: float,
) -> list[Misfit]:
    """Findings of a joint from its trajectories and what the model leaves of each [T] [rad]."""
    speeds = []
    residuals = []
    for trajectory, left in pairs:
        speeds.append(speed_of(trajectory.time, trajectory.position[:, column]))
        residuals.append(left)
    residual = np.concatenate(residuals)
    speed = np.concatenate(speeds)
    top = float(np.percentile(np.abs(speed), 99.5)) + 1e-9
    masks = [phases(trajectory, column, resolution, top) for trajectory, _ in pairs]
    rows = []
    for phase, when in PHASES.items():
        mask = np.concatenate([inside[phase] for inside in masks])
        if mask.any() and _rms(residual[mask]) > REPEATABLE * floor:
            left = residual[mask]
            direction = np.sign(speed[mask])
            signature = {
                "rms_rad": _rms(left),
                "mean_rad": float(np.mean(left)),
                "along_motion_rad": float(np.mean(left * direction)),
                "noise_floor_rad": floor,
            }
            rows.append(Misfit(name, f"{name}: {when} the joint {_does(signature)}", signature))
    return sorted(rows, key=lambda row: -row.signature["rms_rad"])[:2]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _does(signature: Mapping[str, float]) -> str:
    """What a joint does in a phase.

    An error without a sign that stands for half of it goes both ways.
    """
    rms, mean, along = (signature[key] for key in ("rms_rad", "mean_rad", "along_motion_rad"))
    if 2.0 * abs(along) > rms:
        verb = "runs ahead of" if along > 0.0 else "lags behind"
        size = abs(along)
    elif 2.0 * abs(mean) > rms:
        verb = "sits above" if mean > 0.0 else "sits below"
        size = abs(mean)
    else:
        return f"is off by {1e3 * rms:.1f} mrad, either way"
    return f"{verb} the model by {1e3 * size:.1f} mrad"
