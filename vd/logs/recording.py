"""Recordings of real machines: the format ``vd-recording/1``, read with every check and written.

A recording is a folder with ``recording.json`` and one CSV file per trajectory. SI units, radians,
seconds. A command holds from its row's time stamp on, or from when it was sent where the row says
that; stamps increase but need not be regular.
"""

import contextlib
import csv
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vd.command.config import from_dict
from vd.command.files import atomic_path, write_json
from vd.logs.motions import CHANNELS, Recording, Trajectory
from vd.logs.recording_checks import (
    COMMAND_TIME,
    MIN_SAMPLES,
    RecordingError,
    check_motion,
    check_units,
    check_values,
    require,
)

T = TypeVar("T")
FORMAT = "vd-recording/1"
CONTACT_MODEL = "contact"
"""Model of a recording of an object's motions, not of joints."""
BARE_MODELS = ("servo", "pendulum")
"""Models that need no articulation: an unknown inertia and gravity load, a point mass on an arm."""
USD_SUFFIXES = (".usd", ".usda", ".usdc")
POSITIVE = ("p_gain", "payload_kg", "arm_length_m")
"""Conditions that the model computes with: numbers, not negative."""
STIFFNESS = "kp_nm_rad"
"""Key of ``servo``: the drive's stiffness at the largest P gain recorded [N m/rad], one or by
joint.
"""


@dataclass(frozen=True)
class RecordingHeader:
    """What of ``recording.json`` is read."""

    model: str = ""
    joints: tuple[str, ...] = ()
    encoder_resolution_rad: float = 0.0
    servo: dict[str, Any] = field(default_factory=dict)
    trajectories: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class TrajectoryHeader:
    """What of its entry of a trajectory is read."""

    file: str
    joints: tuple[str, ...]
    excitation: str = ""
    conditions: dict[str, float | str] = field(default_factory=dict)


def read_recording(path: str | Path) -> Recording:
    """Read and check a recording.

    Args:
        path: The folder, or its ``recording.json``.

    Raises:
        RecordingError: It cannot be used; names file, row (1 is the header), column, why, and the
            remedy.
    """
    path = Path(path)
    file = path if path.suffix == ".json" else path / "recording.json"
    header = _known(RecordingHeader, read_header(file), f"{file}: recording")
    require(
        header.model != CONTACT_MODEL,
        f"{file}: an object's motions; they are for vd-gap contact",
    )
    _check_joints(f"{file}: 'joints'", header.joints, header.joints)
    _check_model(file, header)
    require(
        0.0 < header.encoder_resolution_rad < math.radians(1.0),
        f"{file}: 'encoder_resolution_rad' is {header.encoder_resolution_rad!r}, as if in degrees; "
        "give the size of one encoder count in rad, e.g. 0.001534 for 4096 counts a turn",
    )
    _check_stiffness(file, header)
    require(
        bool(header.trajectories),
        f"{file}: 'trajectories' is empty; list at least one {{file, excitation, joints}}",
    )
    trajectories: dict[str, Trajectory] = {}
    for number, values in enumerate(header.trajectories):
        where = f"{file}: trajectories[{number}]"
        entry = _known(TrajectoryHeader, values, where)
        require(
            entry.file not in trajectories,
            f"{where}: {entry.file!r} is listed twice; list each once, or it counts as evidence "
            "twice",
        )
        trajectories[entry.file] = _read_trajectory(file, where, entry, header.joints)
    recording = Recording(
        file.parent,
        header.model,
        header.joints,
        header.servo,
        header.encoder_resolution_rad,
        tuple(trajectories.values()),
    )
    check_motion(recording)
    check_units(recording)
    return recording


def write_recording(
    recording: Recording, folder: str | Path, *, only: Collection[str] | None = None
) -> Path:
    """Write a recording into a folder: each file atomically, ``recording.json`` last.

    Args:
        recording: The recording.
        folder: Where.
        only: CSV files to write, where the others are there from before; all by default.

    Returns:
        The folder.
    """
    folder = Path(folder)
    for trajectory in recording.trajectories:
        if only is None or trajectory.file in only:
            write_table(folder / trajectory.file, trajectory, recording.joints)
    header = {
        "format": FORMAT,
        "model": recording.model,
        "joints": list(recording.joints),
        "servo": recording.servo,
        "encoder_resolution_rad": recording.encoder_resolution_rad,
        "trajectories": list(map(entry_of, recording.trajectories)),
    }
    write_json(folder / "recording.json", header)
    return folder


def entry_of(trajectory: Trajectory) -> dict[str, Any]:
    """What ``recording.json`` says of a trajectory."""
    return {
        "file": trajectory.file,
        "excitation": trajectory.excitation,
        "joints": list(trajectory.joints),
        "duration_s": round(trajectory.duration, 6),
        "conditions": trajectory.conditions,
    }


def _read_text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig")  # spreadsheets put a mark in front
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise RecordingError(
            f"{file}: no such file; give a folder with recording.json and the CSV files that it "
            f"lists"
        ) from None
    except UnicodeDecodeError as error:
        raise RecordingError(f"{file}: not a text file ({error}); export it in UTF-8") from error


def read_header(file: Path) -> dict[str, Any]:
    """What ``recording.json`` says.

    Raises:
        RecordingError: It is missing, no JSON, or of another format.
    """
    try:
        header = json.loads(_read_text(file))
    except json.JSONDecodeError as error:
        raise RecordingError(f"{file}: not JSON ({error}); correct it at that place") from error
    version = header.get("format") if isinstance(header, dict) else None
    require(
        version == FORMAT, f"{file}: 'format' is {version!r}; only {FORMAT!r} is read: convert it"
    )
    return header


def _known(cls: type[T], values: dict[str, Any], where: str) -> T:
    """The fields of ``values`` that are read; people add notes of their own."""
    names = {field.name for field in fields(cls)}  # type: ignore[arg-type]
    try:
        return from_dict(cls, {k: v for k, v in values.items() if k in names}, where=where)
    except ValueError as error:
        raise RecordingError(f"{error}; correct it") from error


def _check_joints(where: str, joints: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Joints are some, once each, and known."""
    require(bool(joints), f"{where} is empty; name the joints")
    for joint in joints:
        require(joints.count(joint) == 1, f"{where} names {joint!r} twice; name each once")
        require(joint in known, f"{where}: unknown joint {joint!r}; there are {', '.join(known)}")


def _check_stiffness(file: Path, header: RecordingHeader) -> None:
    """What the servo's stiffness is said to be is a number, or one for some joints."""
    stiffness = header.servo.get(STIFFNESS, {})
    if not isinstance(stiffness, dict):
        stiffness = {header.joints[0]: stiffness}
    for joint, value in stiffness.items():
        require(
            joint in header.joints and isinstance(value, float | int) and 0.0 < value < math.inf,
            f"{file}: servo.{STIFFNESS} is {value!r}; give a positive number in N m/rad, or one by "
            f"joint: {', '.join(header.joints)}",
        )


def _check_model(file: Path, header: RecordingHeader) -> None:
    """The model is known, and has the joints."""
    if header.model in BARE_MODELS:
        return
    from vd.assets_usd.hands import load_hand

    try:
        hand = load_hand(model_path(file.parent, header.model))
    except ValueError as error:
        raise RecordingError(
            f"{file}: 'model': {error}; it is a hand, a USD file beside it, "
            f"{' or '.join(BARE_MODELS)}"
        ) from error
    _check_joints(f"{file}: 'joints'", header.joints, hand.joint_names)


def model_path(folder: Path, model: str) -> str:
    """The model of a recording: a hand's name, or the USD file beside ``recording.json``."""
    return str(folder / model) if model.endswith(USD_SUFFIXES) else model


def _read_trajectory(
    file: Path, where: str, entry: TrajectoryHeader, joints: tuple[str, ...]
) -> Trajectory:
    path = Path(entry.file)
    require(
        not path.is_absolute() and ".." not in path.parts,
        f"{where}: 'file' is {entry.file!r}; keep it in the recording's folder",
    )
    _check_joints(f"{where}: 'joints'", entry.joints, joints)
    for key in POSITIVE:
        value = entry.conditions.get(key, 0.0)
        require(
            isinstance(value, float) and 0.0 <= value < math.inf,
            f"{where}: condition {key!r} is {value!r}; give a number, not negative",
        )
    columns = _read_columns(file.parent / path, joints)
    time = columns.pop("t")
    sent = columns.pop(COMMAND_TIME, None)
    channels = by_channel(columns, joints, len(time))
    enabled = channels.pop("enabled", np.ones((len(time), len(joints))))
    return Trajectory(
        file=entry.file,
        excitation=entry.excitation or path.stem,
        joints=entry.joints,
        conditions=entry.conditions,
        time=time - time[0],
        command_time=None if sent is None else sent - time[0],
        enabled=np.nan_to_num(enabled, nan=1.0) > 0.5,
        **channels,
    )


def by_channel(
    columns: Mapping[str, np.ndarray], joints: tuple[str, ...], rows: int
) -> dict[str, np.ndarray]:
    """Columns ``channel.joint`` [T] as channels [T, J]; NaN for a joint without one."""
    channels = {}
    for channel in CHANNELS:
        values = np.full((rows, len(joints)), np.nan)
        for j, joint in enumerate(joints):
            values[:, j] = columns.get(f"{channel}.{joint}", np.nan)
        if not np.isnan(values).all():
            channels[channel] = values
    return channels


def read_table(file: Path) -> list[tuple[str, list[str]]]:
    """Name and cells of each column of a CSV, separated by commas, semicolons or tabs.

    Beside semicolons a comma is the decimal point, as spreadsheets of many languages write it.

    Raises:
        RecordingError: There is none, it is empty, or a row has another number of cells than the
            header.
    """
    text = _read_text(file)
    header = text.partition("\n")[0]
    separator = max(",;\t", key=header.count)
    if separator == ";":
        text = text.replace(",", ".")
    rows = list(csv.reader(text.splitlines(), delimiter=separator))
    while rows and not "".join(rows[-1]).strip():
        rows.pop()
    require(bool(rows), f"{file}: empty; record it again or drop it")
    width = len(rows[0])
    for number, row in enumerate(rows, 1):
        require(
            len(row) == width,
            f"{file}: row {number} has {len(row)} cells, the header {width}; correct the row",
        )
    return [(name.strip(), cells) for name, *cells in zip(*rows, strict=True)]


def numbers(file: Path, name: str, cells: list[str]) -> np.ndarray:
    """The numbers of a column [T].

    Raises:
        RecordingError: A cell is no finite number.
    """
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        with contextlib.suppress(ValueError):
            values[i] = float(cell)
        if not math.isfinite(values[i]):
            raise RecordingError(
                f"{file}: row {i + 2}, column {name!r}: {cell.strip() or 'an empty cell'} is not a "
                "finite number; drop the row, or the column if it is optional"
            )
    return values


def _read_columns(file: Path, joints: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The columns ``t`` and ``channel.joint`` of a trajectory, checked."""
    table = read_table(file)
    _check_columns(file, [name for name, _ in table], joints)
    samples = len(table[0][1])
    require(
        samples >= MIN_SAMPLES,
        f"{file}: {samples} samples; at least {MIN_SAMPLES} are needed, better some seconds at "
        "100 Hz: record it again or drop it from 'trajectories'",
    )
    columns = {}
    for name, cells in table:
        if name in ("t", COMMAND_TIME) or name.partition(".")[0] in CHANNELS:
            columns[name] = numbers(file, name, cells)
    if COMMAND_TIME in columns:
        columns = _without_repeats(columns)
    check_values(file, columns)
    return columns


def _without_repeats(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns without rows that tell the state before once more: a log's, over a gap of the bus."""
    new = np.zeros(len(columns["t"]), dtype=bool)
    new[0] = True
    for name, values in columns.items():
        if name == "t" or name.startswith("position."):
            new[1:] |= np.diff(values) != 0.0
    return {name: values[new] for name, values in columns.items()}


def _check_columns(file: Path, names: list[str], joints: tuple[str, ...]) -> None:
    """The required columns are there, once each, and no joint is misspelt."""
    where = f"{file}: row 1"
    for name in filter(None, names):
        require(names.count(name) == 1, f"{where} has column {name!r} twice; keep one")
        channel, dot, joint = name.partition(".")
        if dot and channel in CHANNELS:
            _check_joints(f"{where}, column {name!r}", (joint,), joints)
    needed = ["t"]
    for joint in joints:
        needed += [f"command.{joint}", f"position.{joint}"]
    for name in needed:
        require(name in names, f"{where} has no column {name!r}; add it")


def write_table(
    file: Path, trajectory: Trajectory, joints: tuple[str, ...], channels: Sequence[str] = CHANNELS
) -> None:
    """Write the CSV of one trajectory, atomically; telemetry that is NaN throughout is left out.

    Args:
        file: Where.
        trajectory: The trajectory.
        joints: Names of its columns.
        channels: Which of its arrays to write.
    """
    columns = {"t": trajectory.time}
    if trajectory.command_time is not None:
        columns[COMMAND_TIME] = trajectory.command_time
    for channel in channels:
        values = getattr(trajectory, channel)
        if values is None or (channel == "enabled" and values.all()):
            continue
        for joint, column in zip(joints, np.asarray(values, dtype=float).T, strict=True):
            if not np.isnan(column).all():
                columns[f"{channel}.{joint}"] = column
    formats = ["%d" if name.startswith("enabled") else "%.6f" for name in columns]
    table = np.stack([*columns.values()], axis=1)
    with atomic_path(file) as temporary:
        np.savetxt(temporary, table, formats, ",", header=",".join(columns), comments="")
