"""Exports of motion capture: where an object was, beside what the policy thought.

Two layouts of CSV. The plain one has the columns ``time, x, y, z, qx, qy, qz, qw`` and, if it likes,
``tracked`` (1 or 0); seconds, metres, xyzw. OptiTrack's Motive exports a head of several rows and, for every
rigid body, columns of its rotation and position by name; where markers were lost, the cells are empty.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

PLAIN = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
UNIX_S = 1e9
"""Times beyond this are seconds since 1970; a clock of its own does not run for 30 years."""
UNIT_TOLERANCE = 1e-2
"""Deviation of a quaternion's length from 1, above which it is none."""
UNITS_M = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}


class MocapError(ValueError):
    """An export that cannot be used; names file and remedy."""


@dataclass(frozen=True, eq=False)
class Mocap:
    """An object's track, T samples."""

    path: Path
    """The file."""
    time_s: np.ndarray
    """Time of each sample [s], rising [T]."""
    pose: np.ndarray
    """Position [m] and quaternion xyzw, NaN where it was lost [T, 7]."""

    @property
    def tracked(self) -> np.ndarray:
        """Where the object was tracked [T]."""
        return np.isfinite(self.pose).all(axis=1)

    @property
    def unix(self) -> bool:
        """Whether times are seconds since 1970, not those of a clock of its own."""
        return bool(self.time_s[0] > UNIX_S)


def read_mocap(path: Path, body: str | None = None) -> Mocap:
    """Read an export.

    Args:
        path: CSV, plain or OptiTrack's.
        body: Rigid body, of an OptiTrack export with several.

    Raises:
        MocapError: It is none; says what is wrong and the remedy.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise MocapError(f"{path} cannot be read as CSV ({error}); export it again") from error
    if rows and rows[0] and rows[0][0].strip().lower() == "format version":
        time_s, pose = _optitrack(path, rows, body)
    else:
        time_s, pose = _plain(path, rows)
    if len(time_s) < 2 or not np.isfinite(time_s).all() or not (np.diff(time_s) > 0.0).all():
        raise MocapError(f"{path}: there must be at least two samples, and times must rise; export it again")
    mocap = Mocap(path, time_s, pose)
    length = np.linalg.norm(pose[mocap.tracked, 3:], axis=1)
    if len(length) and np.abs(length - 1.0).max() > UNIT_TOLERANCE:
        raise MocapError(
            f"{path}: a quaternion is {length[np.argmax(np.abs(length - 1.0))]:.3f} long, not 1; "
            "export rotations as quaternions"
        )
    return mocap


def _numbers(path: Path, rows: list[list[str]], first_line: int) -> np.ndarray:
    """Cells as numbers, empty ones NaN."""
    width = max((len(row) for row in rows), default=0)
    values = np.full((len(rows), width), np.nan)
    for line, row in enumerate(rows):
        for column, cell in enumerate(row):
            if cell.strip():
                try:
                    values[line, column] = float(cell)
                except ValueError:
                    raise MocapError(f"{path}, line {first_line + line}: {cell!r} is no number") from None
    return values


def _plain(path: Path, rows: list[list[str]]) -> tuple[np.ndarray, np.ndarray]:
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    missing = [name for name in PLAIN if name not in header]
    if missing:
        raise MocapError(
            f"{path}: there is no column {missing[0]!r}; the first line must name {', '.join(PLAIN)} "
            "(and tracked), or the file be OptiTrack's export"
        )
    values = _numbers(path, [row for row in rows[1:] if row], 2)
    if values.size == 0 or values.shape[1] < len(header):
        raise MocapError(f"{path} has no samples")
    columns = [header.index(name) for name in PLAIN]
    time_s, pose = values[:, columns[0]], values[:, columns[1:]]
    if "tracked" in header:
        pose = np.where(values[:, [header.index("tracked")]] > 0.5, pose, np.nan)
    return time_s, pose


def _optitrack(path: Path, rows: list[list[str]], body: str | None) -> tuple[np.ndarray, np.ndarray]:
    head = {
        key.strip().lower(): value.strip() for key, value in zip(rows[0][::2], rows[0][1::2], strict=False)
    }
    if head.get("rotation type", "quaternion").lower() != "quaternion":
        raise MocapError(f"{path}: rotations are {head['rotation type']}; export them as quaternions")
    unit = head.get("length units", "meters").lower()
    if unit not in UNITS_M:
        raise MocapError(f"{path}: lengths are in {unit!r}; export them in {' or '.join(UNITS_M)}")
    names = next((row for row in rows if len(row) > 1 and "Name" in row[:2]), None)
    start = next((i for i, row in enumerate(rows) if row and row[0].strip() == "Frame"), None)
    if names is None or start is None or start == 0:
        raise MocapError(f"{path}: no rows Name and Frame in the head; export it from Motive again")
    kinds, axes = rows[start - 1], rows[start]
    found: dict[str, dict[tuple[str, str], int]] = {}
    for column in range(2, min(len(names), len(kinds), len(axes))):
        key = (kinds[column].strip().lower(), axes[column].strip().lower())
        found.setdefault(names[column].strip(), {}).setdefault(key, column)
    wanted = [("position", axis) for axis in "xyz"] + [("rotation", axis) for axis in "xyzw"]
    bodies = {name: columns for name, columns in found.items() if all(key in columns for key in wanted)}
    if body is None and len(bodies) == 1:
        body = next(iter(bodies))
    if body not in bodies:
        raise MocapError(
            f"{path} has the rigid bodies {', '.join(bodies) or '(none)'}; name one of them with --body"
        )
    values = _numbers(path, [row for row in rows[start + 1 :] if row], start + 2)
    columns = [bodies[body][key] for key in wanted]
    if values.size == 0 or values.shape[1] <= max(columns):
        raise MocapError(f"{path} has no samples of {body}")
    pose = values[:, columns]
    pose[:, :3] *= UNITS_M[unit]
    return values[:, 1], pose
