"""Recordings of real machines: the format ``vd-recording/1``, read with every check and written.

A recording is a folder with ``recording.json`` and one CSV file per trajectory. SI units, radians,
seconds. A command holds from its row's time stamp on, or from when it was sent where the row says
that; stamps increase but need not be regular.
"""

import contextlib
import csv
import json
import math
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

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
    header = read_header(file)
    require(
        header.get("model") != CONTACT_MODEL,
        f"{file}: an object's motions; they are for vd-gap contact",
    )
    joints = _names(file, "joints", header.get("joints"))
    _check_model(file, header.get("model"), joints)
    resolution: Any = header.get("encoder_resolution_rad")
    require(
        _is_number(resolution) and 0.0 < resolution < math.radians(1.0),
        f"{file}: 'encoder_resolution_rad' is {resolution!r}, as if in degrees; give the size of "
        "one encoder count in rad, e.g. 0.001534 for 4096 counts a turn",
    )
    servo: Any = header.get("servo", {})
    entries: Any = header.get("trajectories")
    require(isinstance(servo, dict), f"{file}: 'servo' is {servo!r}; make it an object")
    _check_stiffness(file, servo.get(STIFFNESS), joints)
    require(
        isinstance(entries, list) and bool(entries),
        f"{file}: 'trajectories' is empty; list at least one {{file, excitation, joints}}",
    )
    trajectories = tuple(
        _read_trajectory(file, i, entry, joints) for i, entry in enumerate(entries)
    )
    names = [trajectory.file for trajectory in trajectories]
    twice = sorted({name for name in names if names.count(name) > 1})
    require(
        not twice,
        f"{file}: 'trajectories' lists {twice} twice; list each once, or it counts as evidence "
        f"twice",
    )
    recording = Recording(
        file.parent, header["model"], joints, servo, float(resolution), trajectories
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
        "trajectories": [entry_of(trajectory) for trajectory in recording.trajectories],
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
    found = header.get("format") if isinstance(header, dict) else None
    require(found == FORMAT, f"{file}: 'format' is {found!r}; only {FORMAT!r} is read: convert it")
    return header


def _is_number(value: Any) -> bool:
    largest = sys.float_info.max
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and -largest <= value <= largest
    )


def _names(file: Path, key: str, value: Any) -> tuple[str, ...]:
    strings = (
        isinstance(value, list) and bool(value) and all(isinstance(v, str) and v for v in value)
    )
    require(strings, f"{file}: {key!r} is {value!r}; make it a list of joint names")
    require(
        len({*value}) == len(value), f"{file}: {key!r} names a joint twice: {value}; name each once"
    )
    return tuple(value)


def _check_stiffness(file: Path, told: Any, joints: tuple[str, ...]) -> None:
    """What the servo's stiffness is said to be is a number, or one for some joints."""
    values = told if isinstance(told, dict) else {} if told is None else {joints[0]: told}
    for joint, value in values.items():
        require(
            joint in joints and _is_number(value) and value > 0.0,
            f"{file}: servo.{STIFFNESS} is {told!r}; give a positive number in N m/rad, or one by "
            f"joint: {', '.join(joints)}",
        )


def _check_model(file: Path, model: Any, joints: tuple[str, ...]) -> None:
    """The model is known, and has the joints."""
    if model in BARE_MODELS:
        return
    from vd.assets_usd.hands import load_hand

    try:
        known = load_hand(model_path(file.parent, str(model))).joint_names
    except ValueError as error:
        raise RecordingError(
            f"{file}: 'model': {error}; it is a hand, a USD file beside it, "
            f"{' or '.join(BARE_MODELS)}"
        ) from error
    _check_known(f"{file}: 'joints'", joints, known, str(model))


def _check_known(where: str, joints: tuple[str, ...], known: tuple[str, ...], whose: str) -> None:
    for joint in joints:
        require(
            joint in known,
            f"{where}: unknown joint {joint!r}: {whose} has {', '.join(known)}; add or rename it",
        )


def model_path(folder: Path, model: str) -> str:
    """The model of a recording: a hand's name, or the USD file beside ``recording.json``."""
    return str(folder / model) if model.endswith(USD_SUFFIXES) else model


def _read_trajectory(file: Path, number: int, entry: Any, joints: tuple[str, ...]) -> Trajectory:
    where = f"{file}: trajectories[{number}]"
    name: Any = entry.get("file") if isinstance(entry, dict) else None
    require(isinstance(name, str), f"{where}: no 'file'; name the CSV file of the trajectory")
    inside = not Path(name).is_absolute() and ".." not in Path(name).parts
    require(inside, f"{where}: 'file' is {name!r}; keep it in the recording's folder")
    excited = _names(file, f"trajectories[{number}].joints", entry.get("joints"))
    _check_known(where, excited, joints, "'joints'")
    conditions = entry.get("conditions", {})
    require(
        isinstance(conditions, dict)
        and all(isinstance(value, str) or _is_number(value) for value in conditions.values()),
        f"{where}: 'conditions' is {conditions!r}; map names to numbers or words",
    )
    for key in POSITIVE:
        value = conditions.get(key, 0.0)
        positive = not isinstance(value, str) and value >= 0.0
        require(positive, f"{where}: condition {key!r} is {value!r}; give a number, not negative")
    table = file.parent / name
    columns = _read_columns(table, joints)
    time = columns.pop("t")
    sent = columns.pop(COMMAND_TIME, None)
    channels = by_channel(columns, joints, len(time))
    enabled = (
        np.nan_to_num(channels.pop("enabled", np.ones((len(time), len(joints)))), nan=1.0) > 0.5
    )
    return Trajectory(
        file=name,
        excitation=str(entry.get("excitation", Path(name).stem)),
        joints=excited,
        conditions=conditions,
        time=time - time[0],
        command_time=None if sent is None else sent - time[0],
        enabled=enabled,
        **channels,
    )


def by_channel(
    columns: Mapping[str, np.ndarray], joints: tuple[str, ...], rows: int
) -> dict[str, np.ndarray]:
    """Columns ``channel.joint`` [T] as channels [T, J]; NaN for a joint without one."""
    channels = {}
    for channel in CHANNELS:
        found = [columns.get(f"{channel}.{joint}") for joint in joints]
        if any(values is not None for values in found):
            blank = np.full(rows, np.nan)
            channels[channel] = np.stack([blank if v is None else v for v in found], axis=1)
    return channels


def read_table(file: Path) -> tuple[list[str], list[list[str]]]:
    """Names of the columns and rows of cells of a CSV, separated by commas, semicolons or tabs.

    Beside semicolons a comma is the decimal point, as spreadsheets of many languages write it.

    Raises:
        RecordingError: There is none, it is empty, or a row has another number of cells than the
            header.
    """
    text = _read_text(file)
    separator = max(",;\t", key=text.partition("\n")[0].count)
    lines = (text.replace(",", ".") if separator == ";" else text).splitlines()
    rows = list(csv.reader(lines, delimiter=separator))
    while rows and not any(cell.strip() for cell in rows[-1]):
        rows.pop()
    require(bool(rows), f"{file}: empty; record it again or drop it")
    for i, row in enumerate(rows):
        said = (
            f"{file}: row {i + 1} has {len(row)} cells, the header {len(rows[0])}; correct the row"
        )
        require(len(row) == len(rows[0]), said)
    return [name.strip() for name in rows[0]], rows[1:]


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
    names, rows = read_table(file)
    kept = _check_columns(file, names, joints)
    require(
        len(rows) >= MIN_SAMPLES,
        f"{file}: {len(rows)} samples; at least {MIN_SAMPLES} are needed, better some seconds at "
        "100 Hz: record it again or drop it from 'trajectories'",
    )
    columns = {
        name: numbers(file, name, [row[index] for row in rows]) for name, index in kept.items()
    }
    if COMMAND_TIME in columns:
        # A log over a gap of the bus tells the state before once more.
        same = [
            np.diff(v) == 0.0
            for key, v in columns.items()
            if key == "t" or key.startswith("position.")
        ]
        new = np.concatenate([[True], ~np.all(same, axis=0)])
        columns = {name: values[new] for name, values in columns.items()}
    check_values(file, columns)
    return columns


def _check_columns(file: Path, names: list[str], joints: tuple[str, ...]) -> dict[str, int]:
    """Index of every column that is used; the required ones are there, and no joint is misspelt."""
    for name in filter(None, names):
        require(names.count(name) == 1, f"{file}: row 1 has column {name!r} twice; keep one")
        channel, dot, joint = name.partition(".")
        if dot and channel in CHANNELS:
            _check_known(f"{file}: row 1, column {name!r}", (joint,), joints, "recording.json")
    for name in (
        "t",
        *(f"{channel}.{joint}" for joint in joints for channel in ("command", "position")),
    ):
        require(name in names, f"{file}: row 1 has no column {name!r}; add it")
    wanted = {
        "t",
        COMMAND_TIME,
        *(f"{channel}.{joint}" for channel in CHANNELS for joint in joints),
    }
    return {name: index for index, name in enumerate(names) if name in wanted}


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
        each = zip(joints, np.asarray(values, dtype=float).T, strict=True)
        columns |= {
            f"{channel}.{joint}": column for joint, column in each if not np.isnan(column).all()
        }
    formats = ["%d" if name.startswith("enabled") else "%.6f" for name in columns]
    table, header = np.stack([*columns.values()], axis=1), ",".join(columns)
    with atomic_path(file) as temporary:
        np.savetxt(temporary, table, formats, ",", header=header, comments="")
