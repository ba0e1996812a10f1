"""Motions in files of other programs.

LeRobot datasets, ROS bags and MCAP, BAM's logs, CSV with units.

Every reader yields a :class:`SourceMotion` for each episode, bag or file. ``FORMATS`` has them by name.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vd.command.interrupt import need
from vd.logs.recording import by_channel, numbers, read_table
from vd.logs.recording_checks import RecordingError

ANGLES = {"rad": 1.0, "deg": math.pi / 180.0}
UNITS: dict[str, Mapping[str, float]] = {
    "t": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "command": ANGLES,
    "position": ANGLES,
    "velocity": {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0},
    "current": {"A": 1.0, "mA": 1e-3},
    "pwm": {"1": 1.0, "%": 0.01},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "temperature": {"degC": 1.0},
    "enabled": {"1": 1.0},
}
"""Units that a column may have, and how many of ours one of them is."""
JOINT_STATE, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
_Heard = tuple[float, float, Any]
"""A message, after its own stamp and the bag's [s]."""


@dataclass(frozen=True, eq=False)
class SourceMotion:
    """One motion of a file, in SI units.

    Attributes:
        name: Of its episode or file.
        joints: J names.
        time: Time stamps [T] [s].
        channels: ``command`` and ``position`` [T, J] [rad], and telemetry as :mod:`vd.logs.motions`
            has it.
        command_time: When the command of a row was sent [T] [s]; None: at its time stamp.
        conditions: What was varied on purpose.
        kind: Kind of motion, the unit of held-out splits; empty: of its own.
    """

    name: str
    joints: tuple[str, ...]
    time: np.ndarray
    channels: Mapping[str, np.ndarray]
    command_time: np.ndarray | None = None
    conditions: Mapping[str, Any] = field(default_factory=dict)
    kind: str = ""


@dataclass(frozen=True)
class Told:
    """What a user says that files do not.

    Attributes:
        unit: Unit of angles, where the file has none.
        rename: Column or joint of the file -> our name.
        state_topic: Topic of the measured joints.
        command_topic: Topic of the commands.
        joints: Joints that are wanted, by our names; empty: all.
        used: What of ``rename`` the file had.
    """

    unit: str | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    state_topic: str | None = None
    command_topic: str | None = None
    joints: tuple[str, ...] = ()
    used: set[str] = field(default_factory=set)

    def called(self, old: str, default: str) -> str:
        """Our name of what the file calls ``old``."""
        if old in self.rename:
            self.used.add(old)
        return self.rename.get(old, default)


def read_csv(path: Path, told: Told) -> Iterator[SourceMotion]:
    """A CSV whose header names ``t [ms]``, ``position.JOINT [deg]``, ....

    A folder: every CSV in it.
    """
    for file in _files(path, ".csv"):
        header, rows = read_table(file)
        columns: dict[str, np.ndarray] = {}
        for i, text in enumerate(header):
            name, scale = _column(file, text, told)
            if scale is not None:
                if name in columns:
                    raise RecordingError(
                        f"{file}: two columns are {name!r}; --rename one to 'unused'"
                    )
                columns[name] = scale * numbers(file, text, [row[i] for row in rows])
        if "t" not in columns:
            raise RecordingError(
                f"{file}: no column 't'; give --rename 'ITS TIME=t' with its unit: 't [ms]'"
            )
        joints = tuple(dict.fromkeys(name.partition(".")[2] for name in columns if "." in name))
        yield SourceMotion(file.stem, joints, columns["t"], by_channel(columns, joints, len(rows)))


def _column(file: Path, text: str, told: Told) -> tuple[str, float | None]:
    """Our name of a column, and its unit in ours; None: it is not used."""
    bare, own = _name_and_unit(text)
    name, given = _name_and_unit(told.called(text, told.called(bare, bare)))
    channel = name.partition(".")[0]
    if channel not in UNITS or (channel == "t") == ("." in name):
        return name, None
    units = UNITS[channel]
    stated = told.unit if units is ANGLES else next(iter(units)) if len(units) == 1 else None
    unit = given or own or stated
    if unit is None or unit not in units:
        said = f"has the unit {unit!r}" if unit else "has no unit"
        raise RecordingError(
            f"{file}: column {text!r} {said}; write '{name} [{'] or ['.join(units)}]'"
        )
    return name, units[unit]


def _name_and_unit(text: str) -> tuple[str, str]:
    """``elbow [deg]`` as ``elbow`` and ``deg``; the unit may be empty."""
    name, _, unit = text.replace("(", "[").replace(")", "]").partition("[")
    return name.strip(), unit.rstrip("]").strip()


def read_bam(path: Path, told: Told) -> Iterator[SourceMotion]:
    """Logs of BAM's pendulum, one JSON file for each; a folder: every JSON in it."""
    for file in _files(path, ".json"):
        try:
            log = json.loads(file.read_text())
            rows = log["entries"]
            time, *both = (
                np.array([float(row[key]) for row in rows])
                for key in ("timestamp", "goal_position", "position")
            )
            names = {"speed": "velocity", "input_volts": "voltage", "temp": "temperature"}
            channels = dict(zip(("command", "position"), both, strict=True)) | {
                ours: np.array([float(row[key]) for row in rows])
                for key, ours in names.items()
                if all(key in row for row in rows)
            }
            channels["enabled"] = np.array([float(row.get("torque_enable", 1)) for row in rows])
            conditions = {
                "p_gain": log["kp"],
                "payload_kg": log["mass"],
                "arm_length_m": log["length"],
            }
            conditions |= {"supply_v": log["vin"]} if "vin" in log else {}
            name = f"{log['trajectory']}_p{log['kp']:g}_{file.stem}".replace("/", "_")
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(
                f"{file}: no log of BAM ({error!r}); it has mass, length, kp, trajectory, and "
                "entries of timestamp, position and goal_position"
            ) from error
        joint = told.called("pendulum", "pendulum")
        values = {channel: of_joint[:, None] for channel, of_joint in channels.items()}
        yield SourceMotion(name, (joint,), time, values, None, conditions, str(log["trajectory"]))


def read_lerobot(path: Path, told: Told) -> Iterator[SourceMotion]:
    """Episodes of a LeRobot dataset, v2 or v3.

    ``action`` commands, ``observation.state`` is measured.
    """
    need("pyarrow")
    info = path / "meta" / "info.json"
    try:
        features = json.loads(info.read_text())["features"]
        names = [_lerobot_names(features[key]) for key in ("action", "observation.state")]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"{info}: no LeRobot dataset ({error!r}); it names 'action' and 'observation.state'"
        ) from error
    if told.unit is None:
        raise RecordingError(
            f"{info}: LeRobot does not say the unit of joints; give --unit deg or rad. Values "
            "normalised to -100 to 100 are no angles: record with use_degrees=True"
        )
    joints = [joint for joint in names[1] if joint in names[0]]
    if not joints:
        raise RecordingError(
            f"{info}: 'action' has {names[0]}, 'observation.state' {names[1]}: none in both"
        )
    index, time, action, state = _lerobot_rows(path, names)
    scale = ANGLES[told.unit]
    ours = tuple(told.called(joint, joint.removesuffix(".pos")) for joint in joints)
    picked = [[each.index(joint) for joint in joints] for each in names]
    for episode in np.unique(index):
        rows = index == episode
        both = {"command": action[rows][:, picked[0]], "position": state[rows][:, picked[1]]}
        yield SourceMotion(
            f"episode_{int(episode):06d}",
            ours,
            time[rows],
            {key: scale * v for key, v in both.items()},
        )


def _lerobot_rows(path: Path, names: Sequence[list[str]]) -> list[np.ndarray]:
    """Episodes [T], time [T], commands [T, J] and measured [T, J], which ``names`` name."""
    import pyarrow.parquet as pq

    wanted = ["episode_index", "timestamp", "action", "observation.state"]
    columns: dict[str, list[np.ndarray]] = {name: [] for name in wanted}
    for file in sorted(path.glob("data/**/*.parquet")):
        try:
            table = pq.read_table(file, columns=wanted)
            found = [np.array(table[name].to_pylist(), dtype=float) for name in wanted]
        except (ValueError, OSError, KeyError) as error:
            raise RecordingError(f"{file} cannot be read ({error}); download it again") from error
        for name, values in zip(wanted, found, strict=True):
            if len(values):
                columns[name].append(values)
    if not columns["timestamp"]:
        raise RecordingError(
            f"{path}: no rows in data/**/*.parquet; download the dataset's data folder"
        )
    rows = [np.concatenate(columns[name]) for name in wanted]
    for values, of in zip(rows[2:], names, strict=True):
        if values.shape[1:] != (len(of),):
            raise RecordingError(f"{path}: {len(of)} names for values of shape {values.shape[1:]}")
    return rows


def _lerobot_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of a vector's elements, which versions write as a list or below a key."""
    names = feature["names"]
    return list(next(iter(names.values())) if isinstance(names, Mapping) else names)


def read_ros(path: Path, told: Told) -> Iterator[SourceMotion]:
    """A ROS 1 bag, a ROS 2 bag's folder or file, or an MCAP of ROS 2 messages.

    Measured are JointState, commanded JointState, JointTrajectory of one point, or
    Float64MultiArray in the order of the measured joints. A command holds until the next. Stamps
    are those of the headers where all have one, else of the bag. Of a topic that several devices
    share, states of the joints that are asked for are taken, or of those in its first message.
    """
    need("rosbags")
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            kinds = {connection.topic: connection.msgtype for connection in reader.connections}
            state = _topic(path, "state", told.state_topic, kinds, (JOINT_STATE,), ())
            allowed = (JOINT_STATE, TRAJECTORY, ARRAY)
            command = _topic(path, "command", told.command_topic, kinds, allowed, (state,))
            heard: dict[str, list[_Heard]] = {state: [], command: []}
            chosen = [one for one in reader.connections if one.topic in heard]
            for connection, stamp, raw in reader.messages(connections=chosen):
                message: Any = reader.deserialize(raw, connection.msgtype)
                header = getattr(message, "header", None)
                own = header.stamp.sec + 1e-9 * header.stamp.nanosec if header else 0.0
                heard[connection.topic].append((own, 1e-9 * stamp, message))
    except (AnyReaderError, OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: no bag that can be read: {error}") from error
    if empty := [topic for topic, messages in heard.items() if not messages]:
        raise RecordingError(f"{path}: no message on {empty[0]}; record it, or name another topic")
    yield _held(path, heard[state], heard[command], told)


def _topic(
    path: Path,
    which: str,
    given: str | None,
    kinds: Mapping[str, str],
    allowed: tuple[str, ...],
    no: tuple,
) -> str:
    """The topic that is given, or the only one that can be meant."""
    fit = [topic for topic, kind in kinds.items() if kind in allowed and topic not in no]
    if given is None and len(fit) == 1:
        return fit[0]
    if given in fit:
        return str(given)
    there = ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items())
    found = f"{given} is none" if given else "there is none" if not fit else "there are several"
    raise RecordingError(
        f"{path}: {which} topic: {found}; give --{which}-topic one of {' or '.join(allowed)}; it "
        f"has {there}"
    )


def _held(path: Path, states: list[_Heard], commands: list[_Heard], told: Told) -> SourceMotion:
    """The measured rows, each with the command that was sent last."""
    ours = [{told.called(name, name) for name in message.name} for *_, message in states]
    first = next((i for i, names in enumerate(ours) if names.issuperset(told.joints)), None)
    if first is None:
        raise RecordingError(
            f"{path}: no state of {', '.join(told.joints)}; there are {sorted(ours[0])}"
        )
    joints = list(states[first][2].name)
    states = [row for row, names in zip(states, ours, strict=True) if names & ours[first]]
    stamped = all(own > 0.0 for own, _, _ in (*states, *commands))
    time = np.array([row[0 if stamped else 1] for row in states])
    position, velocity = (
        np.stack([_in_order(path, m.name, getattr(m, key), joints) for *_, m in states])
        for key in ("position", "velocity")
    )
    sent = np.array([row[0 if stamped else 1] for row in commands])
    wanted = np.stack([_goal(path, message, joints) for *_, message in commands])
    order = np.argsort(sent, kind="stable")
    sent, wanted = sent[order], wanted[order]
    order = np.argsort(time, kind="stable")
    last = np.searchsorted(sent, time[order], side="right") - 1
    kept = order[last >= 0]
    last = last[last >= 0]
    new = np.concatenate([[True], np.diff(last) > 0])
    time = time[kept]
    channels = {"command": wanted[last], "position": position[kept], "velocity": velocity[kept]}
    named = tuple(told.called(joint, joint) for joint in joints)
    # A command is new in one row; in those after it, it is held.
    return SourceMotion(
        path.stem, named, time, channels, np.where(new, np.minimum(sent[last], time), time)
    )


def _goal(path: Path, message: Any, joints: list[str]) -> np.ndarray:
    """The positions that a message commands, in the order of the joints.

    NaN for those it leaves out.
    """
    if hasattr(message, "data"):
        names, values = joints, message.data
    elif hasattr(message, "points"):
        names, points = message.joint_names, message.points
        if len(points) != 1:
            raise RecordingError(
                f"{path}: a JointTrajectory of {len(points)} points says what a controller is to "
                "make of it, not what was sent; give a --command-topic of positions"
            )
        values = points[0].positions
    else:
        names, values = message.name, message.position
    return _in_order(path, names, values, joints)


def _in_order(path: Path, names: Sequence[str], values: Any, joints: Sequence[str]) -> np.ndarray:
    """Values of a message in the order of the joints; NaN for those it leaves out."""
    if len(values) not in (0, len(names)):
        raise RecordingError(f"{path}: a message has {len(values)} values for {len(names)} joints")
    told = dict(zip(names, values, strict=False))
    return np.array([told.get(joint, np.nan) for joint in joints])


def _files(path: Path, suffix: str) -> list[Path]:
    files = sorted(path.glob(f"*{suffix}")) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise RecordingError(f"{path}: no {suffix} file there; name one, or a folder of them")
    return files


FORMATS: dict[str, Callable[[Path, Told], Iterator[SourceMotion]]] = {
    "csv": read_csv,
    "bam": read_bam,
    "lerobot": read_lerobot,
    "ros": read_ros,
}


def format_of(path: Path) -> str:
    """The format that a path is most likely of.

    Raises:
        RecordingError: It is of none.
    """
    if (path / "meta" / "info.json").is_file():
        return "lerobot"
    if path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file():
        return "ros"
    for suffix, name in ((".csv", "csv"), (".json", "bam")):
        if path.suffix == suffix or (path.is_dir() and any(path.glob(f"*{suffix}"))):
            return name
    raise RecordingError(
        f"{path}: not there, or no LeRobot dataset (meta/info.json), ROS bag (.bag, .db3, .mcap or "
        "metadata.yaml), CSV file, or JSON of BAM"
    )
