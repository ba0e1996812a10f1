"""What a recording must be to be analysed: possible values, something that moves, radians and seconds.

The checks of :mod:`vd.gap.recording` on values, beside those on the form of the files.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from vd.gap.recording import Recording

COMMAND_TIME = "t_command"
"""Optional column: when the commands of a row were sent [s], if not at the row's time stamp."""
PLAUSIBLE_RAD = 2.2 * math.pi
"""Largest position or command [rad] of a servo in position mode: one turn, and a tenth for offsets."""
MOVING_COUNTS = 20.0
"""Encoder counts by which a command must move before the position has to answer."""
MIN_DISTINCT = 50
"""Distinct positions from which the smallest step between two of them tells the unit."""
FLICKER_COUNTS = 3.0
"""Encoder counts within which a reading at rest flickers; who never leaves them has not moved."""
AGAINST = -0.5
"""Correlation of command and position below which a joint turns the other way; lag alone spares slow ones."""
SLOWEST_S = 0.5
"""Median time between samples [s] that shows nothing of a servo; 2 ms are 2.0 if written in milliseconds."""
DEGREES_RATIO = 20.0
"""A smallest step above this many encoder counts is in another unit (degrees are 57 times radians)."""


class RecordingError(ValueError):
    """A recording that cannot be used; names file, row, column, why, and what to do."""


def check_values(file: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Time runs forward, and every value can be what its column says."""
    time = columns["t"]
    bad = np.flatnonzero(np.diff(time) <= 0.0)
    if len(bad):
        i = int(bad[0]) + 1
        how = "repeats" if time[i] == time[i - 1] else "runs backward"
        raise RecordingError(
            f"{file}: row {i + 2}, column 't': time {how} ({time[i - 1]:g} s, then {time[i]:g} s); "
            "sort the rows and keep one per stamp"
        )
    if (between := float(np.median(np.diff(time)))) > SLOWEST_S:
        raise RecordingError(
            f"{file}: column 't': {between:g} s between samples: these look like milliseconds, and as "
            "seconds would show nothing of a servo; write seconds"
        )
    back = np.flatnonzero(np.diff(columns.get(COMMAND_TIME, time)) < 0.0)
    if len(back):
        raise RecordingError(
            f"{file}: row {int(back[0]) + 3}, column {COMMAND_TIME!r}: sent before the commands of the row "
            "before; commands go out in the order of the rows: correct it"
        )
    for name, values in columns.items():
        channel = name.partition(".")[0]
        if channel in ("command", "position"):
            i, limit = int(np.argmax(np.abs(values))), PLAUSIBLE_RAD
            why = "more than a turn, so these look like degrees or counts; write radians"
        elif channel == "pwm":
            i, limit = int(np.argmax(np.abs(values))), 1.0
            why = "a duty cycle lies in [-1, 1]; divide by the full scale"
        elif channel == "enabled":
            i, limit = int(np.argmax(~np.isin(values, (0.0, 1.0)))), 0.0
            why = "it must be 0 or 1; correct it"
            if values[i] in (0.0, 1.0):
                continue
        else:
            continue
        if abs(values[i]) > limit:
            raise RecordingError(f"{file}: row {i + 2}, column {name!r}: {values[i]:g}: {why}")


def check_motion(recording: "Recording") -> None:
    """Some command moves, and where a command moves the encoder answers, in the same direction."""
    count = recording.encoder_resolution_rad
    moved = False
    for j, joint in enumerate(recording.joints):
        told = []
        for trajectory in recording.trajectories:
            travel = float(np.ptp(trajectory.command[:, j]))
            moved |= travel > 0.0
            if travel > MOVING_COUNTS * count and trajectory.enabled[:, j].all():
                told.append((trajectory, travel, float(np.ptp(trajectory.position[:, j]))))
        still = [each for each in told if each[2] == 0.0]
        if told and all(answer <= FLICKER_COUNTS * count for _, _, answer in told):
            still = told  # too little to be an answer in any motion
        if still:
            trajectory, travel, answer = still[0]
            how = "never changes" if answer == 0.0 else f"only flickers, by {answer:.2g} rad,"
            raise RecordingError(
                f"{recording.path / trajectory.file}: column 'position.{joint}' {how} while "
                f"'command.{joint}' moves by {travel:.3g} rad: a dead encoder, or a servo that is off; "
                "record it again"
            )
        against = [np.corrcoef(t.command[:, j], t.position[:, j])[0, 1] for t, _, _ in told]
        if told and max(against) < AGAINST:
            raise RecordingError(
                f"{recording.path}: column 'position.{joint}' moves against 'command.{joint}' in every "
                "motion: the sign of one of them is wrong; turn it round"
            )
    if not moved:
        raise RecordingError(
            f"{recording.path / 'recording.json'}: no 'command.' column moves in any trajectory, so nothing "
            "can be identified; record steps and sines"
        )


def check_units(recording: "Recording") -> None:
    """Small motions in degrees show in the size of an encoder count."""
    for j, joint in enumerate(recording.joints):
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
