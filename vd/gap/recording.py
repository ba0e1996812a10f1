"""Recordings of real machines: the format ``vd-recording/1``, read with every check and written.

A recording is a folder with ``recording.json`` and one CSV file per trajectory. SI units, radians,
seconds. A command holds from its time stamp on; stamps increase but need not be regular.
"""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vd.files import atomic_path, write_json

FORMAT = "vd-recording/1"
BARE_MODELS = ("servo", "pendulum")
"""Models that need no articulation: an unknown inertia and gravity load, a point mass on an arm."""
TELEMETRY = ("velocity", "current", "pwm", "voltage", "temperature")
"""Optional columns per joint: rad/s, A, [-1, 1], V, deg C."""
CHANNELS = ("command", "position", *TELEMETRY, "enabled")
USD_SUFFIXES = (".usd", ".usda", ".usdc")

MIN_SAMPLES = 20
"""Samples of a trajectory below which no motion can be told from noise."""
PLAUSIBLE_RAD = 2.2 * math.pi
"""Largest position or command [rad] of a servo in position mode: one turn, and a tenth for offsets."""
MOVING_COUNTS = 20.0
"""Encoder counts by which a command must move before the position has to answer."""
MIN_DISTINCT = 50
"""Distinct positions from which the smallest step between two of them tells the unit."""
DEGREES_RATIO = 20.0
"""A smallest step above this many encoder counts is in another unit (degrees are 57 times radians)."""
CSV_DIGITS = 6


class RecordingError(ValueError):
    """A recording that cannot be used; names file, row, column, why, and what to do."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One excitation and its answer; arrays have a row per time stamp and a column per joint.

    Attributes:
        file: Name of the CSV file in the recording's folder.
        excitation: Kind of motion (steps, sine_0.50hz ...); the unit of held-out splits.
        joints: Joints that were excited, a subset of the recording's.
        conditions: What was varied on purpose (``p_gain``, ``payload_kg``, ``supply_v`` ...).
        time: Time stamps [T] [s], float64, starting at 0.
        command: Commanded positions [T, J] [rad].
        position: Measured positions [T, J] [rad].
        velocity: Measured velocities [T, J] [rad/s], or None; NaN for joints without the column.
        current: Motor currents [T, J] [A], or None, as all telemetry.
        pwm: Duty cycles [T, J] in [-1, 1], or None.
        voltage: Supply voltages [T, J] [V], or None.
        temperature: Motor temperatures [T, J] [deg C], or None.
        enabled: Whether the servo's torque is on [T, J] bool; all true where not recorded.
    """

    file: str
    excitation: str
    joints: tuple[str, ...]
    conditions: dict[str, float | str]
    time: np.ndarray
    command: np.ndarray
    position: np.ndarray
    enabled: np.ndarray
    velocity: np.ndarray | None = None
    current: np.ndarray | None = None
    pwm: np.ndarray | None = None
    voltage: np.ndarray | None = None
    temperature: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """Trajectories of one machine.

    Attributes:
        path: Folder.
        model: ``servo``, ``pendulum``, a hand's name, or a USD file beside ``recording.json``.
        joints: Names of the columns.
        servo: What is known of the servo (model, gains, supply ...).
        encoder_resolution_rad: Size of an encoder count [rad].
        trajectories: The trajectories.
    """

    path: Path
    model: str
    joints: tuple[str, ...]
    servo: dict[str, Any]
    encoder_resolution_rad: float
    trajectories: tuple[Trajectory, ...]

    def subset(self, indices: Sequence[int]) -> "Recording":
        """The same recording with only these trajectories, in this order."""
        return replace(self, trajectories=tuple(self.trajectories[i] for i in indices))
