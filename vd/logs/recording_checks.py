"""What a recording must be to be analysed.

Possible values, one clock, one unit, an answer to the command.

The checks of :mod:`vd.logs.recording` on values, beside those on the form of the files.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.signal import correlate, correlation_lags

from vd.logs.motions import FLICKER_COUNTS, Recording, Trajectory

COMMAND_TIME = "t_command"
"""Optional column: when the commands of a row were sent [s], if not at the row's time stamp."""
RADIANS = "more than a turn, so these look like degrees or counts; write radians"
RANGES = {
    "command": (-1.1 * math.tau, 1.1 * math.tau, RADIANS),
    "position": (-1.1 * math.tau, 1.1 * math.tau, RADIANS),
    "velocity": (
        -100.0,
        100.0,
        "no servo is that fast, so these look like rpm or deg/s; write rad/s",
    ),
    "current": (-50.0, 50.0, "no servo draws that much, so these look like mA or counts; write A"),
    "pwm": (-1.0, 1.0, "a duty cycle lies in [-1, 1]; divide by the full scale"),
    "voltage": (
        0.0,
        60.0,
        "servos run on 4 to 48 V, so these look like tenths of a volt or mV; write V",
    ),
    "temperature": (
        -40.0,
        150.0,
        "no motor survives that, so these look like kelvin or counts; write deg C",
    ),
    "enabled": (0.0, 1.0, "it must be 0 or 1; correct it"),
}
"""Least and largest value that a channel can have, and what one outside looks like. A servo in
position mode turns once, and a tenth for offsets."""
MIN_SAMPLES = 16
"""Samples of a trajectory, of a piece of it, and distinct positions, below which nothing is told.
Counts by which a command must move before the position has to answer, and of a step that is another
unit (degrees are 57 times radians). Not tuned."""
FEW = 3
"""Rows within which an echo of the command comes back, or stamps let a position lead. Not tuned."""
SLOWEST_S = 0.5
"""Time between samples [s] that shows nothing of a servo (2 ms are 2.0 if written in milliseconds):
a step is over. Of fewer than ``MIN_SAMPLES`` in it the beginning is not resolved. Not tuned."""
CLEARLY = 0.5
"""Correlation against its command at which a joint turns the other way: lag alone spares slow
motions. What a lead must leave of one less the correlation, in that of any lag: luck leaves 0.7."""
MIN_KINDS = 3
"""Kinds of motion, and motions, below which one alone is left to fit when one is held out. Not
tuned.
"""


class RecordingError(ValueError):
    """A recording that cannot be used; names file, row, column, why, and what to do."""


def require(ok: bool, why_not: str) -> None:
    """Refuse a recording that is not as it has to be.

    Raises:
        RecordingError: With ``why_not``.
    """
    if not ok:
        raise RecordingError(why_not)


def check_values(file: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Time runs forward without gaps, and every value can be what its column says."""
    time = columns["t"]
    _check_time(file, time)
    late = columns.get(COMMAND_TIME, time) - time
    require(
        float(np.diff(late + time).min()) >= 0.0 and abs(float(np.median(late))) <= SLOWEST_S,
        f"{file}: {COMMAND_TIME!r} runs backward, or is of another unit or clock than 't'; write "
        "seconds on that clock, in the order of the rows, or drop it",
    )
    for name, values in columns.items():
        channel = name.partition(".")[0]
        if channel in RANGES:
            low, high, remedy = RANGES[channel]
            wrong = (values < low) | (values > high)
            if channel == "enabled":
                wrong = ~np.isin(values, (low, high))
            worst = int(np.argmax(np.where(wrong, np.abs(values), -1.0)))
            require(
                not wrong.any(),
                f"{file}: row {worst + 2}, column {name!r}: {values[worst]:g}: {remedy}",
            )
        if channel == "position":
            jumps = np.abs(np.diff(values))
            require(
                jumps.max() <= math.pi,
                f"{file}: row {jumps.argmax() + 3}, column {name!r} jumps by a turn, as angles "
                "wrapped at pi do; unwrap it and its command (numpy.unwrap)",
            )


def _check_time(file: Path, time: np.ndarray) -> None:
    """Time stamps increase without gaps."""
    steps = np.diff(time)
    row = int(np.argmin(steps))
    problem = "repeats" if steps[row] == 0.0 else "runs backward"
    require(
        steps[row] > 0.0,
        f"{file}: row {row + 3}, column 't': time {problem} "
        f"({time[row]:g} s, then {time[row + 1]:g} s); sort the rows and keep one per stamp",
    )
    row = int(np.argmax(steps))
    problem = "in which the motion is not known; cut the file there into two trajectories"
    if np.median(steps) > SLOWEST_S:
        problem = "as everywhere: these look like milliseconds; write seconds"
    require(
        steps[row] <= SLOWEST_S,
        f"{file}: row {row + 3}, column 't': {steps[row]:.3g} s without a sample, {problem}",
    )


def check_motion(recording: Recording) -> None:
    """Some command moves, and where one does the position answers it.

    Not dead, not before it, not a copy.
    """
    require(
        any(np.ptp(t.command, axis=0).any() for t in recording.trajectories),
        f"{recording.path / 'recording.json'}: no 'command.' column moves in any trajectory, so "
        "nothing can be identified; record steps and sines",
    )
    count = recording.encoder_resolution_rad
    for j, joint in enumerate(recording.joints):
        moved = [
            t
            for t in recording.trajectories
            if t.enabled[:, j].all() and np.ptp(t.command[:, j]) > MIN_SAMPLES * count
        ]
        if not moved:
            continue
        answers = np.array([np.ptp(t.position[:, j]) for t in moved])
        least = moved[int(np.argmin(answers))]
        require(
            answers.max() > FLICKER_COUNTS * count and answers.min() > 0.0,
            f"{recording.path / least.file}: column 'position.{joint}' only flickers, by "
            f"{answers.min():.2g} rad, while 'command.{joint}' moves by "
            f"{np.ptp(least.command[:, j]):.3g} rad: a dead encoder, or a servo that is "
            "off; record it again",
        )
        fault = _answer_fault(moved, j, count)
        require(not fault, f"{recording.path}: column 'position.{joint}' {fault}")


def _answer_fault(moved: list[Trajectory], j: int, count: float) -> str:
    """What is wrong with a joint's positions as an answer to its commands, in every motion.

    Or nothing.
    """
    likenesses = []
    copies = np.ones(FEW, dtype=bool)  # by the rows within which the command comes back
    for t in moved:
        command = t.command[:, j]
        position = t.position[:, j]
        likenesses.append(np.corrcoef(command, position)[0, 1])
        for late in range(FEW):
            copies[late] &= np.abs(position[late:] - command[: len(command) - late]).max() <= count
    if copies.any():
        return "is a copy of its command in every motion: record the position that is measured"
    if max(likenesses) < -CLEARLY:
        return "moves against its command in every motion: turn the sign of one of them round"
    lead = float(np.median([_lead(t, j) for t in moved]))
    if lead > 0.0:
        return (
            f"moves {1e3 * lead:.0f} ms before its command: the two columns are swapped, or their "
            "stamps are of two clocks; rename the columns, or correct the stamps"
        )
    return ""


def _lead(t: Trajectory, j: int) -> float:
    """By how much the positions of a joint come before its commands [s].

    0 if they do not, clearly.
    """
    step = float(np.median(np.diff(t.time)))
    time = np.arange(0.0, t.time[-1], step)
    command = np.interp(time, t.sent, t.command[:, j])
    position = np.interp(time, t.time, t.position[:, j])
    command -= command.mean()
    position -= position.mean()
    size = np.linalg.norm(command) * np.linalg.norm(position)
    miss = 1.0 - correlate(command, position) / size
    lead = int(correlation_lags(len(time), len(time))[np.argmin(miss)])
    if lead >= FEW and miss.min() < CLEARLY * miss[: len(time)].min():
        return lead * step
    return 0.0


def check_units(recording: Recording) -> None:
    """Small motions in degrees show in the size of a count, the least step between two readings."""
    count = recording.encoder_resolution_rad
    positions = np.concatenate([t.position for t in recording.trajectories]).round(6)
    for j, joint in enumerate(recording.joints):
        levels = np.unique(positions[:, j])
        if len(levels) < MIN_SAMPLES:
            continue
        step = float(np.diff(levels).min())
        require(
            step <= MIN_SAMPLES * count,
            f"{recording.path}: column 'position.{joint}' moves in steps of {step:.3g}, but "
            f"'encoder_resolution_rad' is {count:g}: these look like degrees or counts; write "
            f"radians",
        )


def cautions(recording: Recording) -> tuple[str, ...]:
    """Plain sentences about what the recording cannot show well."""
    sentences = []
    kinds: defaultdict[str, set[str]] = defaultdict(set)
    steps = []
    for t in recording.trajectories:
        steps.append(np.diff(t.time))
        for joint in t.joints:
            kinds[joint].add(t.excitation)
    idle = []
    few = []
    for joint in recording.joints:
        if not kinds[joint]:
            idle.append(joint)
        elif len(kinds[joint]) < MIN_KINDS:
            few.append(joint)
    if idle:
        sentences.append(f"No motion moves {', '.join(idle)}: nothing is said about it.")
    if few:
        sentences.append(
            f"Fewer than {MIN_KINDS} kinds of motion move {', '.join(few)}: little is left to fit "
            "when one is held out."
        )
    step = float(np.median(np.concatenate(steps)))
    if step > SLOWEST_S / MIN_SAMPLES:
        sentences.append(
            f"Samples are {1e3 * step:.0f} ms apart: what a servo does at the beginning of a "
            f"step is not resolved; record at {MIN_SAMPLES / SLOWEST_S:.0f} Hz or more."
        )
    return tuple(sentences)
