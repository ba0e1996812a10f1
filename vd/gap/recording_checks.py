"""What a recording must be to be analysed: possible values, one clock, one unit, an answer to the command.

The checks of :mod:`vd.gap.recording` on values, beside those on the form of the files.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vd.gap.motions import Recording, Trajectory

COMMAND_TIME = "t_command"
"""Optional column: when the commands of a row were sent [s], if not at the row's time stamp."""
TURN = 2.0 * math.pi
PLAUSIBLE_RAD = 1.1 * TURN
"""Largest position or command [rad] of a servo in position mode: one turn, and a tenth for offsets."""
RADIANS = "more than a turn, so these look like degrees or counts; write radians"
RANGES = {
    "command": (-PLAUSIBLE_RAD, PLAUSIBLE_RAD, RADIANS),
    "position": (-PLAUSIBLE_RAD, PLAUSIBLE_RAD, RADIANS),
    "velocity": (-100.0, 100.0, "no servo is that fast, so these look like rpm or deg/s; write rad/s"),
    "current": (-50.0, 50.0, "no servo draws that much, so these look like mA or counts; write A"),
    "pwm": (-1.0, 1.0, "a duty cycle lies in [-1, 1]; divide by the full scale"),
    "voltage": (0.0, 60.0, "servos run on 4 to 48 V, so these look like tenths of a volt or mV; write V"),
    "temperature": (-40.0, 150.0, "no motor survives that, so these look like kelvin or counts; write deg C"),
}
"""Least and largest value that a channel can have, and what one outside looks like."""
MOVING_COUNTS = 20.0
"""Encoder counts by which a command must move before the position has to answer."""
MIN_DISTINCT = 50
"""Distinct positions from which the smallest step between two of them tells the unit."""
FLICKER_COUNTS = 3.0
"""Encoder counts within which a reading at rest flickers; who never leaves them has not moved."""
AGAINST = -0.5
"""Correlation of command and position below which a joint turns the other way; lag alone spares slow ones."""
SLOWEST_S = 0.5
"""Time between samples [s] that shows nothing of a servo; 2 ms are 2.0 if written in milliseconds."""
DEGREES_RATIO = 20.0
"""A smallest step above this many encoder counts is in another unit (degrees are 57 times radians)."""
ARRIVED_RAD = math.pi / 4.0
"""Distance within which a position is at its command, or at one a turn away."""
TRAVEL_RATIO = 10.0
"""A position that travels so many times as far as its command is in another unit, not overshoot."""
COPY_ROWS = 3
"""Rows within which an echo of the command comes back."""
LEAD_S = 0.5
"""Longest lead of the position that is looked for [s]; a longer one of a sine may be its next period."""
LEAD_STEP_S = 5e-3
"""Finest step at which a lead is looked for [s]: a fraction of any that matters, and cheap at 1 kHz."""
LEAD_SAMPLES = 2.0
"""Samples by which stamps alone may let a position lead."""
LEAD_MISS = 0.5
"""What a lead must leave of one less the correlation, in that of any lag: luck leaves 0.7."""
SPEED_RATIO = 2.0
"""How many times too fast or slow a velocity must be for its unit to be another (rpm are 9.5 rad/s)."""
FOLLOWS = 0.9
"""Correlation above which two curves tell the ratio of their units."""


class RecordingError(ValueError):
    """A recording that cannot be used; names file, row, column, why, and what to do."""


def check_values(file: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Time runs forward without gaps, and every value can be what its column says."""
    time = columns["t"]
    between = np.diff(time)
    bad = np.flatnonzero(between <= 0.0)
    if len(bad):
        i = int(bad[0]) + 1
        how = "repeats" if time[i] == time[i - 1] else "runs backward"
        raise RecordingError(
            f"{file}: row {i + 2}, column 't': time {how} ({time[i - 1]:g} s, then {time[i]:g} s); "
            "sort the rows and keep one per stamp"
        )
    if (typical := float(np.median(between))) > SLOWEST_S:
        raise RecordingError(
            f"{file}: column 't': {typical:g} s between samples: these look like milliseconds, and as "
            "seconds would show nothing of a servo; write seconds"
        )
    longest = int(np.argmax(between))
    if between[longest] > SLOWEST_S:
        raise RecordingError(
            f"{file}: row {longest + 3}, column 't': {between[longest]:.3g} s without a sample, in which the "
            "motion is not known; cut the file there into two trajectories"
        )
    _check_sent(file, time, columns.get(COMMAND_TIME, time))
    for name, values in columns.items():
        channel = name.partition(".")[0]
        if channel == "enabled":
            wrong, why = ~np.isin(values, (0.0, 1.0)), "it must be 0 or 1; correct it"
        elif channel in RANGES:
            low, high, why = RANGES[channel]
            wrong = (values < low) | (values > high)
        else:
            continue
        if wrong.any():
            i = int(np.argmax(np.where(wrong, np.abs(values), -1.0)))
            raise RecordingError(f"{file}: row {i + 2}, column {name!r}: {values[i]:g}: {why}")


def _check_sent(file: Path, time: np.ndarray, sent: np.ndarray) -> None:
    """Commands went out in the order of the rows, on the clock of the rows."""
    back = np.flatnonzero(np.diff(sent) < 0.0)
    if len(back):
        raise RecordingError(
            f"{file}: row {int(back[0]) + 3}, column {COMMAND_TIME!r}: sent before the commands of the row "
            "before; commands go out in the order of the rows: correct it"
        )
    apart = float(np.median(sent - time))
    if abs(apart) > SLOWEST_S:
        rate = np.ptp(sent) / np.ptp(time)
        why = f"runs {rate:.3g} times as fast as 't'" if rate > 2.0 else f"is {apart:.3g} s off from 't'"
        unit = "these look like milliseconds" if rate > 2.0 else "it is of another clock"
        raise RecordingError(
            f"{file}: column {COMMAND_TIME!r} {why}: {unit}; write seconds on the clock of 't', or drop the "
            "column"
        )


def unwrapped(
    where: str, command: np.ndarray, position: np.ndarray, on: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Command and position without jumps by a whole turn, the position beside its command.

    Args:
        where: File and joint, for the error.
        command: Commands of the joint [T] [rad].
        position: Its positions [T] [rad].
        on: Where its torque is on [T] bool.

    Returns:
        Both [T], or None where nothing jumps.

    Raises:
        RecordingError: The commands are wrapped, but their steps are too large to tell the turn.
    """
    if not on.any() or np.abs(command - position)[on].max() <= math.pi >= np.abs(np.diff(position)).max():
        return None
    whole = np.unwrap(position)
    whole += TURN * np.round(np.median((command - whole)[on]) / TURN)
    apart = command - whole
    near = apart - TURN * np.round(apart / TURN)
    far = on & (np.abs(apart) > math.pi)
    # A large step is far from its position for a moment, a wrapped command where it has arrived, too.
    if far.any() and np.median(np.abs(near[far])) < ARRIVED_RAD:
        if np.abs(near[on]).max() > math.pi - ARRIVED_RAD:
            raise RecordingError(
                f"{where}: the command is wrapped at a turn, and its steps are too large to tell which; "
                "unwrap it beside the position (numpy.unwrap)"
            )
        apart = near
    moved = whole - position, apart + whole - command
    return (whole + apart, whole) if max(np.abs(shift).max() for shift in moved) > math.pi else None


def check_motion(recording: Recording) -> None:
    """Some command moves, and where one does the position answers it: not dead, not before it, not a copy."""
    if not any(np.ptp(t.command, axis=0).any() for t in recording.trajectories):
        raise RecordingError(
            f"{recording.path / 'recording.json'}: no 'command.' column moves in any trajectory, so nothing "
            "can be identified; record steps and sines"
        )
    count = recording.encoder_resolution_rad
    for j, joint in enumerate(recording.joints):
        told = [
            t
            for t in recording.trajectories
            if np.ptp(t.command[:, j]) > MOVING_COUNTS * count and t.enabled[:, j].all()
        ]
        if told:
            _check_alive(recording, told, j)
            if why := _answer_fault(told, j, count):
                raise RecordingError(f"{recording.path}: column 'position.{joint}' {why}")


def _check_alive(recording: Recording, told: list[Trajectory], j: int) -> None:
    """The encoder of a joint answers commands that move."""
    count, joint = recording.encoder_resolution_rad, recording.joints[j]
    answers = np.array([np.ptp(t.position[:, j]) for t in told])
    if answers.max() > FLICKER_COUNTS * count and answers.min() > 0.0:
        return
    first = int(np.argmin(answers))
    t, answer = told[first], answers[first]
    how = "never changes" if answer == 0.0 else f"only flickers, by {answer:.2g} rad,"
    raise RecordingError(
        f"{recording.path / t.file}: column 'position.{joint}' {how} while 'command.{joint}' moves by "
        f"{np.ptp(t.command[:, j]):.3g} rad: a dead encoder, or a servo that is off; record it again"
    )


def _answer_fault(told: list[Trajectory], j: int, count: float) -> str:
    """What is wrong with a joint's positions as an answer to its commands, in every motion; or nothing."""
    pairs = [(t.command[:, j], t.position[:, j]) for t in told]
    if any(all(np.abs(p[k:] - c[: len(c) - k]).max() <= count for c, p in pairs) for k in range(COPY_ROWS)):
        return "is a copy of its command in every motion: record the position that is measured"
    if max(np.corrcoef(c, p)[0, 1] for c, p in pairs) < AGAINST:
        return "moves against its command in every motion: the sign of one of them is wrong; turn it round"
    ratios = [float(np.ptp(p) / np.ptp(c)) for c, p in pairs]
    if (ratio := float(np.median(ratios))) > TRAVEL_RATIO:
        return f"travels {ratio:.3g} times as far as its command: these look like degrees; write radians"
    if (lead := float(np.median([_lead(t, j) for t in told]))) > 0.0:
        return (
            f"moves {1e3 * lead:.0f} ms before its command: the two columns are swapped, or their stamps are "
            "of two clocks; rename the columns, or correct the stamps"
        )
    return ""


def _lead(t: Trajectory, j: int) -> float:
    """By how much the positions of a joint come before its commands [s]; 0 if they do not, clearly."""
    step = max(float(np.median(np.diff(t.time))), LEAD_STEP_S)
    reach = int(LEAD_S / step)
    when = np.arange(0.0, t.time[-1], step)
    if len(when) < 4 * reach:
        return 0.0
    c = np.interp(when, t.sent, t.command[:, j])[reach:-reach]
    p = np.lib.stride_tricks.sliding_window_view(np.interp(when, t.time, t.position[:, j]), len(c))
    c, p = c - c.mean(), p - p.mean(axis=1, keepdims=True)
    size = np.linalg.norm(c) * np.linalg.norm(p, axis=1)
    if not size.all():
        return 0.0
    miss = 1.0 - p @ c / size
    best = int(np.argmin(miss))
    lead = reach - best
    return lead * step if lead > LEAD_SAMPLES and miss[best] < LEAD_MISS * miss[reach:].min() else 0.0


def check_units(recording: Recording) -> None:
    """Small motions in degrees show in the size of a count, other units of speed in the positions."""
    for j, joint in enumerate(recording.joints):
        _check_speed(recording, j)
        levels = np.unique(np.concatenate([t.position[:, j] for t in recording.trajectories]))
        if len(levels) < MIN_DISTINCT:
            continue
        steps = np.diff(levels)
        step = float(steps[steps > 1e-9].min())
        if step > DEGREES_RATIO * recording.encoder_resolution_rad:
            raise RecordingError(
                f"{recording.path}: column 'position.{joint}' moves in steps of {step:.3g}, but "
                f"'encoder_resolution_rad' is {recording.encoder_resolution_rad:g}: these look like degrees "
                "or counts; write radians"
            )


def _check_speed(recording: Recording, j: int) -> None:
    """The recorded velocity of a joint adds up to its motion."""
    sums, moved = [np.zeros(0)], [np.zeros(0)]
    for t in recording.trajectories:
        if t.velocity is None or np.isnan(t.velocity[:, j]).any():
            continue
        v = t.velocity[:, j]
        total = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t.time))])
        for values, kept in ((total, sums), (t.position[:, j], moved)):
            kept.append(values - np.polyval(np.polyfit(t.time, values, 1), t.time))
    total, motion = np.concatenate(sums), np.concatenate(moved)
    size = float(np.linalg.norm(total) * np.linalg.norm(motion))
    if size == 0.0 or abs(total @ motion) < FOLLOWS * size:
        return
    ratio = float(total @ motion / (motion @ motion))
    if not 1.0 / SPEED_RATIO < ratio < SPEED_RATIO:
        raise RecordingError(
            f"{recording.path}: column 'velocity.{recording.joints[j]}' is {ratio:.3g} times the speed of "
            "its position (rpm are 9.55 times, deg/s 57.3 times): write rad/s, or drop the column"
        )


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
