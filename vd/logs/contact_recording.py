"""Recorded motions of an object on a table: ``vd-recording/1`` whose model is ``contact``.

SI units, quaternions xyzw. What is read is in the table's frame: z up, the origin on its top.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from vd.command.files import atomic_path, write_json
from vd.logs.log_format import POSE
from vd.logs.recording import CONTACT_MODEL, FORMAT, MIN_SAMPLES, numbers, read_header, read_table
from vd.logs.recording_checks import RecordingError, require

Kind = Literal["drop", "slide", "push", "press"]
PUSHER = ("pusher_x", "pusher_y", "pusher_z")
FORCE = ("force_x", "force_y", "force_z")
NEEDED: Mapping[str, tuple[str, ...]] = {
    "drop": ("t", *POSE),
    "slide": ("t", *POSE),
    "push": ("t", *POSE, *FORCE),
    "press": ("t", *POSE, *PUSHER, *FORCE),
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
    require(
        header.get("model") == CONTACT_MODEL,
        f"{file}: model must be {CONTACT_MODEL!r}; recordings of joints are for vd-gap run",
    )
    table = _frame(file, "table_pose", header)
    tracked = _frame(file, "object_pose", header)
    entries = header.get("trajectories", [])
    require(
        bool(entries) and isinstance(entries, list),
        f"{file}: 'trajectories' is empty; list at least one {{file, excitation}}",
    )
    motions: dict[str, ContactMotion] = {}
    for i, entry in enumerate(entries):
        where = f"{file}: trajectories[{i}]"
        try:
            name = Path(entry["file"])
            kind = entry["excitation"]
            NEEDED[kind]
        except (TypeError, KeyError) as error:
            raise RecordingError(
                f"{where}: give 'file', and 'excitation' out of {', '.join(NEEDED)}"
            ) from error
        require(
            name.name == str(name) and name.name not in motions,
            f"{where}: list '{name}' once, a file of this folder",
        )
        motions[name.name] = _motion(file.parent / name, kind, table, tracked)
    return ContactRecording(file.parent, tuple(motions.values()))


def write_contact_recording(folder: Path, motions: Sequence[ContactMotion]) -> None:
    """Write motions into a folder: each file atomically, ``recording.json`` last."""
    for motion in motions:
        names = ["t", *POSE]
        columns = [motion.time[:, None], motion.position, motion.rotation.as_quat()]
        for optional, values in ((PUSHER, motion.pusher), (FORCE, motion.force)):
            if values.size:
                names += optional
                columns.append(values)
        with atomic_path(folder / motion.file) as temporary:
            header = ",".join(names)
            np.savetxt(temporary, np.hstack(columns), "%.6f", ",", header=header, comments="")
    entries = [{"file": motion.file, "excitation": motion.kind} for motion in motions]
    write_json(
        folder / "recording.json",
        {"format": FORMAT, "model": CONTACT_MODEL, "trajectories": entries},
    )


def _frame(file: Path, name: str, header: Mapping[str, Any]) -> tuple[np.ndarray, Rotation]:
    """A pose of the header: position [3] and rotation."""
    values = header.get(name, IDENTITY)
    try:
        pose = np.array(values, dtype=float)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (7,) or not abs(np.linalg.norm(pose[3:]) - 1.0) < UNIT_ERROR:
        raise RecordingError(
            f"{file}: {name!r} is {values!r}; give x y z in m and a quaternion xyzw of length 1"
        )
    return pose[:3], Rotation.from_quat(pose[3:])


def _motion(
    file: Path,
    kind: Kind,
    table_frame: tuple[np.ndarray, Rotation],
    object_frame: tuple[np.ndarray, Rotation],
) -> ContactMotion:
    table = read_table(file)
    names = [name for name, _ in table]
    for name in NEEDED[kind]:
        require(
            names.count(name) == 1,
            f"{file}: row 1 has no one column {name!r}, which a {kind} needs; add it",
        )
    cells = dict(table)
    samples = len(cells["t"])
    require(
        samples >= MIN_SAMPLES,
        f"{file}: {samples} samples; at least {MIN_SAMPLES} are needed, record it again",
    )

    def vectors(wanted: tuple[str, ...]) -> np.ndarray:
        """Columns side by side [T, n], or empty [0, 3] where they were not recorded."""
        if not cells.keys() >= set(wanted):
            return np.empty((0, 3))
        return np.stack([numbers(file, name, cells[name]) for name in wanted], axis=1)

    time = vectors(("t",))[:, 0]
    pose = vectors(POSE)
    _check_values(file, time, pose)
    origin, table = table_frame
    offset, turn = object_frame
    to_table = table.inv()
    tracked = Rotation.from_quat(pose[:, 3:])
    position = pose[:, :3] + tracked.apply(offset)
    pusher = vectors(PUSHER)
    force = vectors(FORCE)
    if len(pusher):
        pusher = to_table.apply(pusher - origin)
    if len(force):
        force = to_table.apply(force)
    return ContactMotion(
        file=file.name,
        kind=kind,
        time=time - time[0],
        position=to_table.apply(position - origin),
        rotation=to_table * tracked * turn,
        pusher=pusher,
        force=force,
    )


def _check_values(file: Path, time: np.ndarray, pose: np.ndarray) -> None:
    """Time increases, positions are in metres, quaternions are some."""
    lengths = np.linalg.norm(pose[:, 3:], axis=1)
    for column, wrong, remedy in (
        ("t", np.diff(time, prepend=-np.inf) <= 0.0, "time must increase; sort the rows"),
        (
            "x",
            np.abs(pose[:, :3]).max(1) > FARTHEST_M,
            "positions are in metres; divide mm by 1000",
        ),
        ("qx", np.abs(lengths - 1.0) > UNIT_ERROR, "quaternions have length 1"),
    ):
        row = wrong.argmax() + 2
        require(not wrong.any(), f"{file}: row {row}, column {column!r}: {remedy}")
