"""Recordings of real machines: the format ``vd-recording/1``, read with every check and written.

A recording is a folder with ``recording.json`` and one CSV file per trajectory. SI units, radians,
seconds. A command holds from its row's time stamp on, or from when it was sent where the row says that;
stamps increase but need not be regular.
"""

import csv
import json
import math
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from vd.files import atomic_path, write_json
from vd.gap.motions import CHANNELS, Recording, Trajectory
from vd.gap.recording_checks import (
    COMMAND_TIME,
    RecordingError,
    check_motion,
    check_units,
    check_values,
    unwrapped,
)

FORMAT = "vd-recording/1"
BARE_MODELS = ("servo", "pendulum")
"""Models that need no articulation: an unknown inertia and gravity load, a point mass on an arm."""
USD_SUFFIXES = (".usd", ".usda", ".usdc")

MIN_SAMPLES = 20
"""Samples of a trajectory below which no motion can be told from noise."""
COARSEST_RAD = 2.0 * math.pi / 256
"""Largest encoder count [rad]: eight bits a turn. Twelve bits a turn are 0.088 if written in degrees."""
POSITIVE = ("p_gain", "payload_kg", "arm_length_m")
"""Conditions that the model computes with: numbers, not negative."""
STIFFNESS = "kp_nm_rad"
"""Key of ``servo``: the drive's stiffness at the largest P gain recorded [N m/rad], one or by joint."""
TEXT = "utf-8-sig"
"""Encoding of the files; spreadsheets put a mark in front."""
CSV_DIGITS = 6


def read_recording(path: str | Path) -> Recording:
    """Read and check a recording.

    Args:
        path: The folder, or its ``recording.json``.

    Raises:
        RecordingError: It cannot be used; names file, row (1 is the header), column, why, and the remedy.
    """
    path = Path(path)
    file = path if path.suffix == ".json" else path / "recording.json"
    header = _read_header(file)
    joints = _names(file, "joints", header.get("joints"))
    _check_model(file, header.get("model"), joints)
    resolution: Any = header.get("encoder_resolution_rad")
    if not _is_number(resolution) or resolution <= 0.0:
        raise RecordingError(
            f"{file}: 'encoder_resolution_rad' is {resolution!r}; give the size of one encoder count in rad, "
            "e.g. 0.001534 for 4096 counts a turn"
        )
    if resolution > COARSEST_RAD:
        raise RecordingError(
            f"{file}: 'encoder_resolution_rad' is {resolution:g}, {2.0 * math.pi / resolution:.3g} counts a "
            "turn: this looks like degrees, or like counts a turn; write radians a count, e.g. 0.001534"
        )
    servo = header.get("servo", {})
    if not isinstance(servo, dict):
        raise RecordingError(f"{file}: 'servo' is {servo!r}; make it an object such as {{\"model\": ..}}")
    _check_stiffness(file, servo.get(STIFFNESS), joints)
    entries = header.get("trajectories")
    if not isinstance(entries, list) or not entries:
        raise RecordingError(
            f"{file}: 'trajectories' is empty; list at least one {{file, excitation, joints}}"
        )
    trajectories = tuple(_read_trajectory(file, i, entry, joints) for i, entry in enumerate(entries))
    names = [trajectory.file for trajectory in trajectories]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise RecordingError(
                f"{file}: trajectories[{i}]: {name!r} is listed before as trajectories[{names.index(name)}]; "
                "list each file once, or it counts twice as evidence"
            )
    recording = Recording(file.parent, header["model"], joints, servo, float(resolution), trajectories)
    check_motion(recording)
    check_units(recording)
    return recording


def write_recording(recording: Recording, folder: str | Path, *, only: Collection[str] | None = None) -> Path:
    """Write a recording into a folder: each file atomically, ``recording.json`` last.

    Args:
        recording: The recording.
        folder: Where.
        only: CSV files to write, where the others are there from before; all by default.

    Returns:
        The folder.
    """
    folder = Path(folder)
    entries = []
    for trajectory in recording.trajectories:
        if only is None or trajectory.file in only:
            _write_csv(folder / trajectory.file, trajectory, recording.joints)
        entries.append(
            {
                "file": trajectory.file,
                "excitation": trajectory.excitation,
                "joints": list(trajectory.joints),
                "duration_s": round(float(trajectory.time[-1]), CSV_DIGITS),
                "conditions": trajectory.conditions,
            }
        )
    header = {
        "format": FORMAT,
        "model": recording.model,
        "joints": list(recording.joints),
        "servo": recording.servo,
        "encoder_resolution_rad": recording.encoder_resolution_rad,
        "trajectories": entries,
    }
    write_json(folder / "recording.json", header)
    return folder


def _read_header(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise RecordingError(f"{file}: no such file; give a folder with recording.json and its CSV files")
    try:
        header = json.loads(file.read_text(encoding=TEXT))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(f"{file}: not JSON ({error}); correct it at that place") from error
    if not isinstance(header, dict):
        raise RecordingError(f'{file}: the top level is no object; start it with {{"format": "{FORMAT}"}}')
    if header.get("format") != FORMAT:
        raise RecordingError(
            f"{file}: 'format' is {header.get('format')!r}; only {FORMAT!r} is read: convert it"
        )
    return header


def _is_number(value: Any) -> bool:
    largest = sys.float_info.max
    return isinstance(value, int | float) and not isinstance(value, bool) and -largest <= value <= largest


def _names(file: Path, key: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not all(isinstance(v, str) and v for v in value):
        raise RecordingError(f"{file}: {key!r} is {value!r}; make it a list of joint names")
    if len(set(value)) != len(value):
        raise RecordingError(f"{file}: {key!r} names a joint twice: {', '.join(value)}; name each once")
    return tuple(value)


def _check_stiffness(file: Path, told: Any, joints: tuple[str, ...]) -> None:
    """What the servo's stiffness is said to be is a number, or one for some joints."""
    values = told if isinstance(told, dict) else {} if told is None else {joints[0]: told}
    for joint, value in values.items():
        if joint not in joints or not _is_number(value) or value <= 0.0:
            raise RecordingError(
                f"{file}: servo.{STIFFNESS} is {told!r}; give a positive number in N m/rad, or one by joint: "
                f"{', '.join(joints)}"
            )


def _check_model(file: Path, model: Any, joints: tuple[str, ...]) -> None:
    """The model is known, and has the joints."""
    if not isinstance(model, str) or not model:
        raise RecordingError(f"{file}: 'model' is {model!r}; name a hand, a USD file, 'servo' or 'pendulum'")
    if model in BARE_MODELS:
        return
    from vd.assets_usd.hands import load_hand

    name = str(file.parent / model) if model.endswith(USD_SUFFIXES) else model
    try:
        known = list(load_hand(name).joint_names)
    except ValueError as error:
        raise RecordingError(
            f"{file}: 'model': {error}; it is a hand, a USD file beside it, {' or '.join(BARE_MODELS)}"
        ) from error
    for joint in joints:
        if joint not in known:
            raise RecordingError(
                f"{file}: unknown joint {joint!r} in 'joints': {model} has {', '.join(known)}; rename it"
            )


def _read_trajectory(file: Path, number: int, entry: Any, joints: tuple[str, ...]) -> Trajectory:
    where = f"{file}: trajectories[{number}]"
    if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
        raise RecordingError(f"{where}: no 'file'; name the CSV file of the trajectory")
    name = entry["file"]
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise RecordingError(f"{where}: 'file' is {name!r}; keep it in the recording's folder")
    excited = _names(file, f"trajectories[{number}].joints", entry.get("joints"))
    for joint in excited:
        if joint not in joints:
            raise RecordingError(
                f"{where}: unknown joint {joint!r}: 'joints' has {', '.join(joints)}; add or rename it"
            )
    conditions = entry.get("conditions", {})
    if not isinstance(conditions, dict) or not all(
        isinstance(value, str) or _is_number(value) for value in conditions.values()
    ):
        raise RecordingError(f"{where}: 'conditions' is {conditions!r}; map names to numbers or words")
    for key in POSITIVE:
        value = conditions.get(key, 0.0)
        if isinstance(value, str) or value < 0.0:
            raise RecordingError(f"{where}: condition {key!r} is {value!r}; give a number, not negative")
    table = file.parent / name
    columns = _read_csv(table, joints)
    time = columns.pop("t")
    sent = columns.pop(COMMAND_TIME, None)
    channels: dict[str, Any] = {}
    for channel in CHANNELS:
        found = [columns.get(f"{channel}.{joint}") for joint in joints]
        if any(values is not None for values in found):
            blank = np.full(len(time), np.nan)
            channels[channel] = np.stack([blank if v is None else v for v in found], axis=1)
    enabled = np.nan_to_num(channels.pop("enabled", np.ones((len(time), len(joints)))), nan=1.0) > 0.5
    jumped = _unwrap(table, joints, channels["command"], channels["position"], enabled)
    return Trajectory(
        file=name,
        excitation=str(entry.get("excitation", Path(name).stem)),
        joints=excited,
        conditions=conditions,
        time=time - time[0],
        command_time=None if sent is None else sent - time[0],
        enabled=enabled,
        unwrapped=jumped,
        **channels,
    )


def _unwrap(
    file: Path, joints: tuple[str, ...], command: np.ndarray, position: np.ndarray, enabled: np.ndarray
) -> tuple[str, ...]:
    """Take jumps by whole turns out of commands and positions [T, J], in place; returns the joints."""
    jumped = []
    for j, joint in enumerate(joints):
        where = f"{file}: joint {joint!r}"
        if whole := unwrapped(where, command[:, j], position[:, j], enabled[:, j]):
            command[:, j], position[:, j] = whole
            jumped.append(joint)
    return tuple(jumped)


def _read_csv(file: Path, joints: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The columns ``t`` and ``channel.joint`` of a trajectory, checked."""
    if not file.is_file():
        raise RecordingError(f"{file}: no such file; put it there or drop it from 'trajectories'")
    try:
        with file.open(newline="", encoding=TEXT) as stream:
            rows = list(csv.reader(stream))
    except UnicodeDecodeError as error:
        raise RecordingError(f"{file}: not a text file ({error}); export it as CSV in UTF-8") from error
    if not rows:
        raise RecordingError(f"{file}: empty; record it again or drop it from 'trajectories'")
    names = [name.strip() for name in rows[0]]
    kept = _check_columns(file, names, joints)
    body = rows[1:]
    while body and not any(cell.strip() for cell in body[-1]):
        body.pop()
    if len(body) < MIN_SAMPLES:
        raise RecordingError(
            f"{file}: {len(body)} samples; at least {MIN_SAMPLES} are needed, better some seconds at 100 Hz: "
            "record it again or drop it from 'trajectories'"
        )
    for i, row in enumerate(body):
        if len(row) != len(names):
            raise RecordingError(
                f"{file}: row {i + 2} has {len(row)} cells, the header {len(names)}; correct the row"
            )
    columns = {name: _numbers(file, name, [row[index] for row in body]) for name, index in kept.items()}
    if COMMAND_TIME in columns:
        columns = _told_once(columns)
    check_values(file, columns)
    return columns


def _told_once(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns without rows that tell the state before once more, as a log does over a gap of the bus."""
    same = [np.diff(v) == 0.0 for name, v in columns.items() if name == "t" or name.startswith("position.")]
    new = np.concatenate([[True], ~np.all(same, axis=0)])
    return {name: values[new] for name, values in columns.items()}


def _check_columns(file: Path, names: list[str], joints: tuple[str, ...]) -> dict[str, int]:
    """Index of every column that is used; the required ones are there, and no joint is misspelt."""
    for name in names:
        if name and names.count(name) > 1:
            raise RecordingError(f"{file}: row 1 has column {name!r} twice; keep one")
        channel, dot, joint = name.partition(".")
        if dot and channel in CHANNELS and joint not in joints:
            raise RecordingError(
                f"{file}: row 1, column {name!r}: unknown joint {joint!r}; recording.json has "
                f"{', '.join(joints)}: rename the column or add the joint"
            )
    required = ["t", *(f"{channel}.{joint}" for joint in joints for channel in ("command", "position"))]
    for name in required:
        if name not in names:
            remedy = "separate columns by commas" if set(";\t") & set("".join(names)) else "add it"
            raise RecordingError(f"{file}: row 1 has no column {name!r}; {remedy}")
    wanted = {"t", COMMAND_TIME, *(f"{channel}.{joint}" for channel in CHANNELS for joint in joints)}
    return {name: index for index, name in enumerate(names) if name in wanted}


def _numbers(file: Path, name: str, cells: list[str]) -> np.ndarray:
    values = np.empty(len(cells))
    for i, cell in enumerate(cells):
        try:
            values[i] = float(cell)
        except ValueError:
            values[i] = np.nan
        if not math.isfinite(values[i]):
            raise RecordingError(
                f"{file}: row {i + 2}, column {name!r}: {cell.strip() or 'an empty cell'} is not a finite "
                "number; drop the row, or the column if it is optional"
            )
    return values


def _write_csv(file: Path, trajectory: Trajectory, joints: tuple[str, ...]) -> None:
    """The CSV of one trajectory; telemetry that is NaN throughout is left out."""
    columns = {"t": trajectory.time}
    if trajectory.command_time is not None:
        columns[COMMAND_TIME] = trajectory.command_time
    for channel in CHANNELS:
        values = getattr(trajectory, channel)
        if values is None or (channel == "enabled" and values.all()):
            continue
        for j, joint in enumerate(joints):
            if not np.isnan(np.asarray(values[:, j], dtype=float)).all():
                columns[f"{channel}.{joint}"] = values[:, j]
    formats = ["%d" if name.startswith("enabled") else f"%.{CSV_DIGITS}f" for name in columns]
    with atomic_path(file) as temporary:
        np.savetxt(
            temporary,
            np.stack([np.asarray(values, dtype=float) for values in columns.values()], axis=1),
            fmt=formats,
            delimiter=",",
            header=",".join(columns),
            comments="",
        )
