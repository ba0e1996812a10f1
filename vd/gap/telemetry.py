"""What recorded voltage and duty cycle say of a joint; :mod:`vd.gap.rules` says what that rules out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vd.gap.chain import Chain
from vd.logs.motions import Recording, Trajectory
from vd.logs.recording_checks import MIN_SAMPLES


@dataclass(frozen=True)
class Telemetry:
    """What the recorded voltage and duty cycle of a joint say.

    Attributes:
        fall: How far the voltage falls at full pull, and its value idle [V]; None where too little
            is recorded.
        follows: Share of the duty cycle that follows the plain error; 0 where none is recorded.
    """

    fall: tuple[float, float] | None
    follows: float


def telemetry_of(
    recording: Recording, chain: Chain, joint: int, trajectories: Sequence[int]
) -> Telemetry:
    """What is recorded of a joint besides commands and positions.

    Args:
        recording: The recording.
        chain: The joint's chain.
        joint: Index of the joint in the chain.
        trajectories: Indices of the trajectories that are used.
    """
    parts = [recording.trajectories[i] for i in trajectories]
    driven = [t for t in parts if chain.joints[joint] in t.joints]
    fall = _voltage_fall(driven, int(chain.columns[joint]))
    return Telemetry(fall, _follows(driven, chain, joint))


def _recorded(values: np.ndarray | None, column: int) -> np.ndarray | None:
    """What a channel has of a joint [T], where it is recorded throughout."""
    own = None if values is None else values[:, column]
    return own if own is not None and np.isfinite(own).all() else None


def _follows(trajectories: list[Trajectory], chain: Chain, joint: int) -> float:
    """Share of a joint's duty cycle that follows the plain error."""
    pairs = [np.zeros((2, 0))]
    column = chain.columns[joint]
    reference = chain.reference_p_gain
    for t in trajectories:
        duty = _recorded(t.pwm, column)
        if duty is not None:
            sent = np.maximum(np.searchsorted(t.sent, t.time, side="right") - 1, 0)
            gain = float(t.conditions.get("p_gain", reference)) / reference if reference else 1.0
            used = t.enabled[:, column] & (np.abs(duty) < 1.0)
            pairs.append(
                np.array([gain * (t.command[sent, column] - t.position[:, column]), duty])[:, used]
            )
    error, duty = np.concatenate(pairs, axis=1)
    if len(error) < MIN_SAMPLES:
        return 0.0
    slope = float(error @ duty) / max(float(error @ error), 1e-300)
    return 1.0 - float(np.sum((duty - slope * error) ** 2)) / max(float(duty @ duty), 1e-300)


def _voltage_fall(trajectories: list[Trajectory], column: int) -> tuple[float, float] | None:
    """How far the voltage falls at full pull, and its value idle [V]; None where it is not told."""
    pairs = [np.zeros((2, 0))]
    for t in trajectories:
        voltage = _recorded(t.voltage, column)
        if voltage is not None:
            pull = _recorded(t.pwm, column)
            pull = (t.command - t.position)[:, column] if pull is None else pull
            pairs.append(np.array([np.abs(pull), voltage])[:, t.enabled[:, column]])
    pull, volt = np.concatenate(pairs, axis=1)
    if len(volt) < MIN_SAMPLES:
        return None
    slope, idle = np.polyfit(pull, volt, 1)
    return max(-slope * float(np.percentile(pull, 99.0)), 0.0), idle
