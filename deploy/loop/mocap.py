"""Exports of motion capture: where an object was, beside what the policy thought.

Two layouts of CSV. The plain one has the columns ``time, x, y, z, qx, qy, qz, qw`` and, if it
likes, ``tracked`` (1 or 0); seconds, metres, xyzw. OptiTrack's Motive exports a head of several
rows and, for every rigid body, columns of its rotation and position by name; where markers were
lost, the cells are empty.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

PLAIN = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
POSE = [f"position {axis}" for axis in "xyz"] + [f"rotation {axis}" for axis in "xyzw"]
"""Columns of a rigid body in OptiTrack's layout."""
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
            rows = [[cell.strip() for cell in row] for row in csv.reader(stream) if row] or [[""]]
        of_optitrack = rows[0][0].lower() == "format version"
        values = _optitrack(rows, body) if of_optitrack else _plain(rows)
        mocap = Mocap(path, values[:, 0], values[:, 1:])
        if len(values) < 2 or not (np.diff(mocap.time_s) > 0.0).all():  # NaN does not rise
            raise ValueError(
                "there must be at least two samples, and times must rise; export it again"
            )
        length = np.linalg.norm(mocap.pose[mocap.tracked, 3:], axis=1)
        if (np.abs(length - 1.0) > UNIT_TOLERANCE).any():
            raise ValueError("a quaternion's length is not 1; export rotations as quaternions")
    except OSError as error:
        raise MocapError(
            f"{path}: {error.strerror}; name the export of the motion capture"
        ) from error
    except (ValueError, csv.Error) as error:  # of text and numbers too
        raise MocapError(f"{path}: {error}") from error
    return mocap


def _number(cell: str) -> float:
    """A cell as a number, NaN where it is empty."""
    return float(cell or "nan")


def _numbers(rows: Sequence[Sequence[str]], columns: Sequence[int]) -> np.ndarray:
    """Cells of some columns as numbers, NaN where a row is too short [T, C]."""
    values = np.full((len(rows), len(columns)), np.nan)
    for index, row in enumerate(rows):
        for place, column in enumerate(columns):
            if column < len(row):
                values[index, place] = _number(row[column])
    return values


def _plain(rows: list[list[str]]) -> np.ndarray:
    """Times and poses [T, 8] of the plain layout."""
    header = [cell.lower() for cell in rows[0]]
    for name in PLAIN:
        if name not in header:
            raise ValueError(
                f"there is no column {name!r}; the first line must name {', '.join(PLAIN)} "
                "(and tracked), or the file be OptiTrack's export"
            )
    values = _numbers(rows[1:], [header.index(name) for name in PLAIN])
    if "tracked" in header:
        tracked = _numbers(rows[1:], [header.index("tracked")])[:, 0]
        values[tracked < 0.5, 1:] = np.nan
    return values


def _optitrack(rows: list[list[str]], body: str | None) -> np.ndarray:
    """Times and poses [T, 8] of OptiTrack's layout."""
    head = [cell.lower() for cell in rows[0]]
    settings = dict(zip(head[::2], head[1::2], strict=False))
    rotation = settings.get("rotation type", "quaternion")
    unit = settings.get("length units", "meters")
    if rotation != "quaternion":
        raise ValueError(f"rotations are {rotation}; export them as quaternions")
    if unit not in UNITS_M:
        raise ValueError(f"lengths are in {unit!r}; export them in {' or '.join(UNITS_M)}")
    names: list[str] = []
    start = 0
    for index, row in enumerate(rows):
        if "Name" in row[:2] and not names:
            names = row
        if row[0] == "Frame":
            start = index
            break
    if not names or start == 0:
        raise ValueError("no rows Name and Frame in the head; export it from Motive again")
    bodies = _bodies(names, rows[start - 1], rows[start])
    if body is None and len(bodies) == 1:
        body = next(iter(bodies))
    if body not in bodies:
        raise ValueError(
            f"it has the rigid bodies {', '.join(bodies) or '(none)'}; name one of them with --body"
        )
    values = _numbers(rows[start + 1 :], [1, *bodies[body]])
    values[:, 1:4] *= UNITS_M[unit]
    return values


def _bodies(
    names: Sequence[str], kinds: Sequence[str], axes: Sequence[str]
) -> dict[str, list[int]]:
    """Columns of the position and quaternion of every rigid body that has them all, by its name."""
    columns: dict[str, dict[str, int]] = {}
    for column, (name, kind, axis) in enumerate(zip(names, kinds, axes, strict=False)):
        columns.setdefault(name, {}).setdefault(f"{kind} {axis}".lower(), column)
    bodies = {}
    for name, places in columns.items():
        if set(POSE) <= places.keys():
            bodies[name] = [places[key] for key in POSE]
    return bodies
