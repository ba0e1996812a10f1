"""The motions of one machine, as they are commanded and recorded. SI units, radians, seconds."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

TELEMETRY = ("velocity", "current", "pwm", "voltage", "temperature")
"""Optional columns per joint: rad/s, A, [-1, 1], V, deg C."""
CHANNELS = ("command", "position", *TELEMETRY, "enabled")
FLICKER_COUNTS = 3.0
"""Encoder counts within which a reading at rest flickers. Not tuned."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One excitation and its answer; arrays have a row per time stamp and a column per joint.

    Attributes:
        file: Name of the CSV file in the recording's folder.
        excitation: Kind of motion (steps, sine_0.50hz ...); the unit of held-out splits.
        joints: Joints that were excited, a subset of the recording's.
        conditions: What was varied on purpose (``p_gain``, ``payload_kg``, ``supply_v`` ...).
        time: Time stamps [T] [s], float64, starting at 0 (:meth:`piece`: later).
        command: Commanded positions [T, J] [rad].
        position: Measured positions [T, J] [rad]; the commands of a motion that is still to be
            recorded.
        velocity: Measured velocities [T, J] [rad/s], or None; NaN for joints without the column.
        current: Motor currents [T, J] [A], or None, as all telemetry.
        pwm: Duty cycles [T, J] in [-1, 1], or None.
        voltage: Supply voltages [T, J] [V], or None.
        temperature: Motor temperatures [T, J] [deg C], or None.
        command_time: When the commands were sent [T] [s], in the time of ``time``; None: at the
            time stamps.
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
    command_time: np.ndarray | None = None

    @property
    def sent(self) -> np.ndarray:
        """When the commands were sent [T] [s]."""
        return self.time if self.command_time is None else self.command_time

    @property
    def stream(self) -> int:
        """Number of its stream of random delays, the same in every simulation and copy."""
        return zlib.crc32(self.file.encode()) & 0xFFFFFFF  # a signed integer of 32 bits holds it

    @property
    def duration(self) -> float:
        """Time of the last sample [s]."""
        return float(self.time[-1])

    def piece(self, first: int, end: int) -> "Trajectory":
        """Samples ``first`` to ``end`` (not included), with their times in the whole."""
        arrays = {}
        for name in ("time", "command_time", *CHANNELS):
            values = getattr(self, name)
            if values is not None:
                arrays[name] = values[first:end]
        return replace(self, **arrays)


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

    def cut(self, pieces: Mapping[int, tuple[int, int]]) -> "Recording":
        """The same recording with pieces in the place of some trajectories.

        Args:
            pieces: Index of the trajectory -> samples ``(first, end)``.
        """
        trajectories = list(self.trajectories)
        for i, piece in pieces.items():
            trajectories[i] = trajectories[i].piece(*piece)
        return replace(self, trajectories=tuple(trajectories))
