"""Recorded motions of an object on a table: ``vd-recording/1`` whose model is ``contact``.

SI units, quaternions xyzw. What is read is in the table's frame: z up, the origin on its top.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from vd.command.files import atomic_path, write_json
from vd.logs.recording import CONTACT_MODEL, FORMAT, MIN_SAMPLES, numbers, read_header, read_table
from vd.logs.recording_checks import RecordingError

Kind = Literal["drop", "slide", "push", "press"]
TIME, POSE = ("t",), ("x", "y", "z", "qx", "qy", "qz", "qw")
PUSHER = ("pusher_x", "pusher_y", "pusher_z")
FORCE = ("force_x", "force_y", "force_z")
NEEDED: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "drop": (TIME, POSE),
    "slide": (TIME, POSE),
    "push": (TIME, POSE, FORCE),
    "press": (TIME, POSE, PUSHER, FORCE),
}
"""Columns of each kind of motion."""
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
UNIT_ERROR = 0.02
"""How far a quaternion's length may be from 1: rounding to two digits."""
FARTHEST_M = 10.0
"""Farther from the table's middle than any arm or camera reaches: the positions are in
millimetres.
"""


@dataclass(frozen=True, eq=False)
class ContactMotion:
    """One motion of the object, in the table's frame.

    Attributes:
        file: Name of the CSV file.
        kind: ``drop``: falls and bounces; ``slide``: slides freely until it rests; ``push``: is
            pushed along by a finger whose force is measured; ``press``: is pressed onto the table
            by it, and stays.
        time: Time stamps [T] [s].
        position: Origin of the object's USD frame [T, 3] [m].
        rotation: Orientation of the object's USD frame, [T].
        pusher: A point of the pusher's rigid part [T, 3] [m]; empty where not recorded.
        force: Force of the pusher on the object [T, 3] [N]; empty where not recorded.
    """

    file: str
    kind: Kind
    time: np.ndarray
    position: np.ndarray
    rotation: Rotation
    pusher: np.ndarray
    force: np.ndarray


@dataclass(frozen=True, eq=False)
class ContactRecording:
    """The folder and its motions."""

    path: Path
    motions: tuple[ContactMotion, ...]


def read_contact_recording(path: str | Path) -> ContactRecording:
    """Read and check a recording of an object's motions.

    Args:
        path: The folder, or its ``recording.json``.

    Raises:
        RecordingError: It cannot be used; names file, row (1 is the header), column and remedy.
    """
    path = Path(path)
    file = path if path.suffix == ".json" else path / "recording.json"
    header = read_header(file)
    if header.get("model") != CONTACT_MODEL:
        raise RecordingError(
            f"{file}: model must be {CONTACT_MODEL!r}; recordings of joints are for vd-gap run"
        )
    frames = [
        _frame(file, name, header.get(name, IDENTITY)) for name in ("table_pose", "object_pose")
    ]
    entries = header.get("trajectories")
    if not isinstance(entries, list) or not entries:
        raise RecordingError(
            f"{file}: 'trajectories' is empty; list at least one {{file, excitation}}"
        )
    for i, entry in enumerate(entries):
        name, kind = (
            entry.get(key) if isinstance(entry, dict) else None for key in ("file", "excitation")
        )
        if not isinstance(name, str) or kind not in get_args(Kind):
            raise RecordingError(
                f"{file}: trajectories[{i}]: give 'file', and 'excitation' out of "
                f"{', '.join(get_args(Kind))}"
            )
        if any(name == other["file"] for other in entries[:i]) or Path(name).name != name:
            raise RecordingError(
                f"{file}: trajectories[{i}]: list {name!r} once, a file of this folder"
            )
    motions = [
        _motion(file.parent / entry["file"], entry["excitation"], frames) for entry in entries
    ]
    return ContactRecording(file.parent, tuple(motions))


def write_contact_recording(folder: Path, motions: Sequence[ContactMotion]) -> None:
    """Write motions into a folder: each file atomically, ``recording.json`` last."""
    for motion in motions:
        columns = [
            motion.time[:, None],
            motion.position,
            motion.rotation.as_quat(),
            motion.pusher,
            motion.force,
        ]
        names = [
            *TIME,
            *POSE,
            *(PUSHER if motion.pusher.size else ()),
            *(FORCE if motion.force.size else ()),
        ]
        table = np.hstack([column for column in columns if column.size])
        with atomic_path(folder / motion.file) as temporary:
            np.savetxt(temporary, table, "%.6f", ",", header=",".join(names), comments="")
    entries = [{"file": motion.file, "excitation": motion.kind} for motion in motions]
    write_json(
        folder / "recording.json",
        {"format": FORMAT, "model": CONTACT_MODEL, "trajectories": entries},
    )


def _frame(where: Path, name: str, values: Any) -> tuple[np.ndarray, Rotation]:
    """A pose: position [3] and rotation."""
    try:
        pose = np.array(values, dtype=float)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (7,) or not abs(np.linalg.norm(pose[3:]) - 1.0) < UNIT_ERROR:
        raise RecordingError(
            f"{where}: {name!r} is {values!r}; give x y z in m and a quaternion xyzw of length 1"
        )
    return pose[:3], Rotation.from_quat(pose[3:])


def _motion(file: Path, kind: Kind, frames: Sequence[tuple[np.ndarray, Rotation]]) -> ContactMotion:
    columns = _columns(file, kind)

    def array(names: tuple[str, ...]) -> np.ndarray:
        found = [columns[name] for name in names if name in columns]
        return np.stack(found, axis=1) if len(found) == len(names) else np.empty((0, 3))

    pose, time = array(POSE), columns["t"]
    _check_values(file, time, pose)
    (place, table), (offset, turn) = frames
    tracked = Rotation.from_quat(pose[:, 3:])
    position, pusher = pose[:, :3] + tracked.apply(offset), array(PUSHER)
    return ContactMotion(
        file=file.name,
        kind=kind,
        time=time - time[0],
        position=table.inv().apply(position - place),
        rotation=table.inv() * tracked * turn,
        pusher=table.inv().apply(pusher - place) if len(pusher) else pusher,
        force=table.inv().apply(force) if len(force := array(FORCE)) else force,
    )


def _columns(file: Path, kind: Kind) -> dict[str, np.ndarray]:
    """The columns of a CSV file by name, all of them finite numbers."""
    names, rows = read_table(file)
    for name in (name for group in NEEDED[kind] for name in group):
        if names.count(name) != 1:
            raise RecordingError(
                f"{file}: row 1 has no one column {name!r}, which a {kind} needs; add it"
            )
    if len(rows) < MIN_SAMPLES:
        raise RecordingError(
            f"{file}: {len(rows)} samples; at least {MIN_SAMPLES} are needed, record it again"
        )
    used = [i for i, name in enumerate(names) if name in (*TIME, *POSE, *PUSHER, *FORCE)]
    return {names[i]: numbers(file, names[i], [row[i] for row in rows]) for i in used}


def _check_values(file: Path, time: np.ndarray, pose: np.ndarray) -> None:
    """Time increases, positions are in metres, quaternions are some."""
    for bad, column, remedy in (
        (
            np.diff(time, prepend=time[0] - 1.0) <= 0.0,
            "t",
            "time must increase; sort the rows, drop doubles",
        ),
        (
            np.abs(pose[:, :3]).max(1) > FARTHEST_M,
            "x",
            "positions are in metres; divide millimetres by 1000",
        ),
        (
            np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1.0) > UNIT_ERROR,
            "qx",
            "quaternions have length 1",
        ),
    ):
        if bad.any():
            raise RecordingError(
                f"{file}: row {int(bad.argmax()) + 2}, column {column!r}: {remedy}"
            )
