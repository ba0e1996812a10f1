"""What a recording must be to be analysed.

Possible values, one clock, one unit, an answer to the command.

The checks of :mod:`vd.logs.recording` on values, beside those on the form of the files.
"""

import math
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
    between = np.diff(time)
    i = int(np.argmin(between))
    require(
        between[i] > 0.0,
        f"{file}: row {i + 3}, column 't': time "
        f"{'repeats' if between[i] == 0.0 else 'runs backward'} "
        f"({time[i]:g} s, then {time[i + 1]:g} s); sort the rows and keep one per stamp",
    )
    typical, longest = float(np.median(between)), int(np.argmax(between))
    cut = "in which the motion is not known; cut the file there into two trajectories"
    require(
        between[longest] <= SLOWEST_S,
        f"{file}: row {longest + 3}, column 't': {between[longest]:.3g} s without a sample, "
        + (
            cut
            if typical <= SLOWEST_S
            else "as everywhere: these look like milliseconds; write seconds"
        ),
    )
    sent = columns.get(COMMAND_TIME, time)
    require(
        float(np.diff(sent).min()) >= 0.0 and abs(float(np.median(sent - time))) <= SLOWEST_S,
        f"{file}: {COMMAND_TIME!r} runs backward, or is of another unit or clock than 't'; write "
        "seconds on that clock, in the order of the rows, or drop it",
    )
    for name, values in columns.items():
        low, high, why = RANGES.get(name.partition(".")[0], (-np.inf, np.inf, ""))
        wrong = (values < low) | (values > high)
        if name.startswith("enabled."):
            wrong = ~np.isin(values, (low, high))
        i = int(np.argmax(np.where(wrong, np.abs(values), -1.0)))
        require(not wrong.any(), f"{file}: row {i + 2}, column {name!r}: {values[i]:g}: {why}")
        i = int(np.argmax(np.abs(np.diff(values))))
        require(
            not name.startswith("position.") or abs(values[i + 1] - values[i]) <= math.pi,
            f"{file}: row {i + 3}, column {name!r} jumps by a turn, as angles wrapped at pi do; "
            "unwrap it and its command (numpy.unwrap)",
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
        told = [
            t
            for t in recording.trajectories
            if np.ptp(t.command[:, j]) > MIN_SAMPLES * count and t.enabled[:, j].all()
        ]
        if not told:
            continue
        answers = np.array([np.ptp(t.position[:, j]) for t in told])
        least = int(np.argmin(answers))
        require(
            answers.max() > FLICKER_COUNTS * count and answers.min() > 0.0,
            f"{recording.path / told[least].file}: column 'position.{joint}' only flickers, by "
            f"{answers[least]:.2g} rad, while 'command.{joint}' moves by "
            f"{np.ptp(told[least].command[:, j]):.3g} rad: a dead encoder, or a servo that is "
            "off; record it again",
        )
        why = _answer_fault(told, j, count)
        require(not why, f"{recording.path}: column 'position.{joint}' {why}")


def _answer_fault(told: list[Trajectory], j: int, count: float) -> str:
    """What is wrong with a joint's positions as an answer to its commands, in every motion.

    Or nothing.
    """
    pairs = [(t.command[:, j], t.position[:, j]) for t in told]
    if any(
        all(np.abs(p[k:] - c[: len(c) - k]).max() <= count for c, p in pairs) for k in range(FEW)
    ):
        return "is a copy of its command in every motion: record the position that is measured"
    if max(np.corrcoef(c, p)[0, 1] for c, p in pairs) < -CLEARLY:
        return "moves against its command in every motion: the sign of one of them is wrong; turn it round"
    if (lead := float(np.median([_lead(t, j) for t in told]))) > 0.0:
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
    when = np.arange(0.0, t.time[-1], step)
    command, position = (
        np.interp(when, t.sent, t.command[:, j]),
        np.interp(when, t.time, t.position[:, j]),
    )
    command, position = command - command.mean(), position - position.mean()
    miss = 1.0 - correlate(command, position) / (np.linalg.norm(command) * np.linalg.norm(position))
    lead, best = int(correlation_lags(len(when), len(when))[np.argmin(miss)]), miss.min()
    return lead * step if lead >= FEW and best < CLEARLY * miss[: len(when)].min() else 0.0


def check_units(recording: Recording) -> None:
    """Small motions in degrees show in the size of a count, the least step between two readings."""
    count = recording.encoder_resolution_rad
    for column, joint in enumerate(recording.joints):
        levels = np.unique(
            np.concatenate([t.position[:, column] for t in recording.trajectories]).round(6)
        )
        step = float(np.diff(levels).min()) if len(levels) >= MIN_SAMPLES else 0.0
        require(
            step <= MIN_SAMPLES * count,
            f"{recording.path}: column 'position.{joint}' moves in steps of {step:.3g}, but "
            f"'encoder_resolution_rad' is {count:g}: these look like degrees or counts; write "
            f"radians",
        )


def cautions(recording: Recording) -> tuple[str, ...]:
    """Plain sentences about what the recording cannot show well, joints together where they share one."""
    found: list[str] = []
    kinds = {
        j: {t.excitation for t in recording.trajectories if j in t.joints} for j in recording.joints
    }
    idle = [joint for joint, names in kinds.items() if not names]
    few = [joint for joint, names in kinds.items() if 0 < len(names) < MIN_KINDS]
    if idle:
        found.append(f"No motion moves {', '.join(idle)}: nothing is said about it.")
    if few:
        found.append(
            f"Fewer than {MIN_KINDS} kinds of motion move {', '.join(few)}: little is left to fit "
            "when one is held out."
        )
    between = float(np.median(np.concatenate([np.diff(t.time) for t in recording.trajectories])))
    if between > SLOWEST_S / MIN_SAMPLES:
        found.append(
            f"Samples are {1e3 * between:.0f} ms apart: what a servo does at the beginning of a "
            f"step is not resolved; record at {MIN_SAMPLES / SLOWEST_S:.0f} Hz or more."
        )
    return tuple(found)
