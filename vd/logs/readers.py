"""Motions in files of other programs.

LeRobot datasets, ROS bags and MCAP, BAM's logs, CSV with units.

Every reader yields a :class:`SourceMotion` for each episode, bag or file. ``FORMATS`` has them by
name.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vd.command.interrupt import need
from vd.logs.recording import by_channel, numbers, read_table
from vd.logs.recording_checks import RecordingError, require

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
BAM_CHANNELS = {
    "command": "goal_position",
    "position": "position",
    "velocity": "speed",
    "voltage": "input_volts",
    "temperature": "temp",
    "enabled": "torque_enable",
}
"""Our channels, and what they are called in a log of BAM; the first two are always there."""
JOINT_STATE = "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


class StampedMessage(NamedTuple):
    """A ROS message and when it was sent."""

    header_s: float
    """By its own header [s]; 0: it has none."""
    bag_s: float
    """By the bag [s]."""
    message: Any


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
class ReaderOptions:
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

    def renamed(self, old: str, default: str) -> str:
        """Our name of what the file calls ``old``."""
        if old in self.rename:
            self.used.add(old)
        return self.rename.get(old, default)


def read_csv(path: Path, options: ReaderOptions) -> Iterator[SourceMotion]:
    """A CSV whose header names ``t [ms]``, ``position.JOINT [deg]``, ....

    A folder: every CSV in it.
    """
    for file in _files(path, ".csv"):
        columns: dict[str, np.ndarray] = {}
        joints: dict[str, None] = {}
        for text, cells in read_table(file):
            name, scale = _column(file, text, options)
            if scale is None:
                continue
            require(
                name not in columns, f"{file}: two columns are {name!r}; --rename one to 'unused'"
            )
            columns[name] = scale * numbers(file, text, cells)
            _, dot, joint = name.partition(".")
            if dot:
                joints[joint] = None
        require(
            "t" in columns,
            f"{file}: no column 't'; give --rename 'ITS TIME=t' with its unit: 't [ms]'",
        )
        channels = by_channel(columns, tuple(joints), len(columns["t"]))
        yield SourceMotion(file.stem, tuple(joints), columns["t"], channels)


def _column(file: Path, text: str, options: ReaderOptions) -> tuple[str, float | None]:
    """Our name of a column, and its unit in ours; None: it is not used."""
    bare, unit = _name_and_unit(text)
    name, renamed_unit = _name_and_unit(options.renamed(text, options.renamed(bare, bare)))
    channel, dot, _ = name.partition(".")
    if channel not in UNITS or (channel == "t") == bool(dot):
        return name, None
    units = UNITS[channel]
    unit = renamed_unit or unit
    if not unit and units is ANGLES:
        unit = options.unit or ""
    elif not unit and len(units) == 1:
        (unit,) = units
    problem = f"has the unit {unit!r}" if unit else "has no unit"
    require(
        unit in units,
        f"{file}: column {text!r} {problem}; write '{name} [{'] or ['.join(units)}]'",
    )
    return name, units[unit]


def _name_and_unit(text: str) -> tuple[str, str]:
    """``elbow [deg]`` as ``elbow`` and ``deg``; the unit may be empty."""
    name, _, unit = text.replace("(", "[").replace(")", "]").partition("[")
    return name.strip(), unit.rstrip("]").strip()


def read_bam(path: Path, options: ReaderOptions) -> Iterator[SourceMotion]:
    """Logs of BAM's pendulum, one JSON file for each; a folder: every JSON in it."""
    for file in _files(path, ".json"):
        try:
            log = json.loads(file.read_text())
            rows = log["entries"]
            time = np.array([float(row["timestamp"]) for row in rows])
            channels = {}
            for name, key in BAM_CHANNELS.items():
                if name in ("command", "position") or all(key in row for row in rows):
                    channels[name] = np.array([[float(row[key])] for row in rows])
            conditions = {
                "p_gain": log["kp"],
                "payload_kg": log["mass"],
                "arm_length_m": log["length"],
            }
            if "vin" in log:
                conditions["supply_v"] = log["vin"]
            motion = str(log["trajectory"])
            name = f"{motion}_p{log['kp']:g}_{file.stem}".replace("/", "_")
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(
                f"{file}: no log of BAM ({error!r}); it has mass, length, kp, trajectory, and "
                "entries of timestamp, position and goal_position"
            ) from error
        joint = options.renamed("pendulum", "pendulum")
        yield SourceMotion(name, (joint,), time, channels, None, conditions, motion)


def read_lerobot(path: Path, options: ReaderOptions) -> Iterator[SourceMotion]:
    """Episodes of a LeRobot dataset, v2 or v3.

    ``action`` commands, ``observation.state`` is measured.
    """
    need("pyarrow")
    info = path / "meta" / "info.json"
    try:
        features = json.loads(info.read_text())["features"]
        commanded = _lerobot_names(features["action"])
        measured = _lerobot_names(features["observation.state"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"{info}: no LeRobot dataset ({error!r}); it names 'action' and 'observation.state'"
        ) from error
    if options.unit is None:
        raise RecordingError(
            f"{info}: LeRobot does not say the unit of joints; give --unit deg or rad. Values "
            "normalised to -100 to 100 are no angles: record with use_degrees=True"
        )
    joints = [joint for joint in measured if joint in commanded]
    require(
        bool(joints),
        f"{info}: 'action' has {commanded}, 'observation.state' {measured}: none in both",
    )
    columns = _lerobot_columns(path)
    scale = ANGLES[options.unit]
    command = scale * _lerobot_joints(path, columns["action"], commanded, joints)
    position = scale * _lerobot_joints(path, columns["observation.state"], measured, joints)
    names = tuple(options.renamed(joint, joint.removesuffix(".pos")) for joint in joints)
    for episode in np.unique(columns["episode_index"]):
        rows = columns["episode_index"] == episode
        channels = {"command": command[rows], "position": position[rows]}
        time = columns["timestamp"][rows]
        yield SourceMotion(f"episode_{int(episode):06d}", names, time, channels)


def _lerobot_columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of a dataset that are read, with a row for each step of all episodes."""
    from pyarrow import dataset

    names = ["episode_index", "timestamp", "action", "observation.state"]
    try:
        files = sorted(map(str, path.glob("data/**/*.parquet")))
        table = dataset.dataset(files, format="parquet").to_table(columns=names)
        columns = {name: np.array(table[name].to_pylist(), dtype=float) for name in names}
    except (ValueError, TypeError, OSError, KeyError) as error:
        raise RecordingError(
            f"{path}: data/**/*.parquet cannot be read ({error}); download the data again"
        ) from error
    require(
        len(columns["timestamp"]) > 0,
        f"{path}: no rows in data/**/*.parquet; download the dataset's data folder",
    )
    return columns


def _lerobot_joints(
    path: Path, values: np.ndarray, names: Sequence[str], joints: Sequence[str]
) -> np.ndarray:
    """Values [T, J] of the joints of a column, whose elements have ``names``."""
    require(
        values.shape[1:] == (len(names),),
        f"{path}: {len(names)} names for values of shape {values.shape[1:]}",
    )
    return values[:, list(map(names.index, joints))]


def _lerobot_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of a vector's elements, which versions write as a list or below a key."""
    names = feature["names"]
    if isinstance(names, Mapping):
        (names,) = names.values()
    return list(names)


def read_ros(path: Path, options: ReaderOptions) -> Iterator[SourceMotion]:
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
            state = _topic(path, "state", options.state_topic, kinds, (JOINT_STATE,))
            del kinds[state]
            allowed = (JOINT_STATE, TRAJECTORY, ARRAY)
            command = _topic(path, "command", options.command_topic, kinds, allowed)
            messages: dict[str, list[StampedMessage]] = {state: [], command: []}
            connections = [c for c in reader.connections if c.topic in messages]
            for connection, bag_ns, raw in reader.messages(connections=connections):
                message: Any = reader.deserialize(raw, connection.msgtype)
                messages[connection.topic].append(_stamped(message, bag_ns))
    except (AnyReaderError, OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: no bag that can be read: {error}") from error
    for topic, heard in messages.items():
        require(bool(heard), f"{path}: no message on {topic}; record it, or name another topic")
    yield _held(path, messages[state], messages[command], options)


def _stamped(message: Any, bag_ns: int) -> StampedMessage:
    header = getattr(message, "header", None)
    header_s = 0.0
    if header is not None:
        header_s = header.stamp.sec + 1e-9 * header.stamp.nanosec
    return StampedMessage(header_s, 1e-9 * bag_ns, message)


def _topic(
    path: Path, which: str, given: str | None, kinds: Mapping[str, str], allowed: tuple[str, ...]
) -> str:
    """The topic that is given, or the only one that can be meant."""
    possible = [topic for topic, kind in kinds.items() if kind in allowed]
    if given in possible:
        return str(given)
    problem = f"{given} is none"
    if given is None:
        if len(possible) == 1:
            return possible[0]
        problem = "there are several" if possible else "there is none"
    present = ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items())
    raise RecordingError(
        f"{path}: {which} topic: {problem}; give --{which}-topic one of {' or '.join(allowed)}; it "
        f"has {present}"
    )


def _held(
    path: Path,
    states: list[StampedMessage],
    commands: list[StampedMessage],
    options: ReaderOptions,
) -> SourceMotion:
    """The measured rows, each with the command that was sent last."""
    joints = _device_joints(path, states, options)
    states = [state for state in states if set(state.message.name) & set(joints)]
    stamped = all(message.header_s > 0.0 for message in (*states, *commands))
    clock = attrgetter("header_s" if stamped else "bag_s")
    states = sorted(states, key=clock)
    commands = sorted(commands, key=clock)
    time = np.array(list(map(clock, states)))
    sent = np.array(list(map(clock, commands)))
    position = []
    velocity = []
    for state in states:
        names = state.message.name
        position.append(_in_order(path, names, state.message.position, joints))
        velocity.append(_in_order(path, names, state.message.velocity, joints))
    goals = np.stack([_goal(path, command.message, joints) for command in commands])
    last = np.searchsorted(sent, time, side="right") - 1
    kept = last >= 0  # before the first command there is none
    time = time[kept]
    last = last[kept]
    channels = {
        "command": goals[last],
        "position": np.stack(position)[kept],
        "velocity": np.stack(velocity)[kept],
    }
    # A command is new in one row; in those after it, it is held.
    new = np.diff(last, prepend=-1) > 0
    command_time = np.where(new, np.minimum(sent[last], time), time)
    names = tuple(options.renamed(joint, joint) for joint in joints)
    return SourceMotion(path.stem, names, time, channels, command_time)


def _device_joints(path: Path, states: list[StampedMessage], options: ReaderOptions) -> list[str]:
    """Joints of the first state that has those which are asked for."""
    for state in states:
        names = {options.renamed(name, name) for name in state.message.name}
        if names.issuperset(options.joints):
            return list(state.message.name)
    raise RecordingError(
        f"{path}: no state of {', '.join(options.joints)}; there are {list(states[0].message.name)}"
    )


def _goal(path: Path, message: Any, joints: list[str]) -> np.ndarray:
    """The positions that a message commands, in the order of the joints.

    NaN for those it leaves out.
    """
    if hasattr(message, "data"):
        return _in_order(path, joints, message.data, joints)
    if not hasattr(message, "points"):
        return _in_order(path, message.name, message.position, joints)
    points = message.points
    require(
        len(points) == 1,
        f"{path}: a JointTrajectory of {len(points)} points says what a controller is to "
        "make of it, not what was sent; give a --command-topic of positions",
    )
    return _in_order(path, message.joint_names, points[0].positions, joints)


def _in_order(path: Path, names: Sequence[str], values: Any, joints: Sequence[str]) -> np.ndarray:
    """Values of a message in the order of the joints; NaN for those it leaves out."""
    require(
        len(values) in (0, len(names)),
        f"{path}: a message has {len(values)} values for {len(names)} joints",
    )
    value_of = dict(zip(names, values, strict=False))
    return np.array([value_of.get(joint, np.nan) for joint in joints])


def _files(path: Path, suffix: str) -> list[Path]:
    files = sorted(path.glob(f"*{suffix}")) if path.is_dir() else [path]
    require(
        bool(files) and files[0].is_file(),
        f"{path}: no {suffix} file there; name one, or a folder of them",
    )
    return files


FORMATS: dict[str, Callable[[Path, ReaderOptions], Iterator[SourceMotion]]] = {
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
        in_folder = path.is_dir() and any(path.glob(f"*{suffix}"))
        if path.suffix == suffix or in_folder:
            return name
    raise RecordingError(
        f"{path}: not there, or no LeRobot dataset (meta/info.json), ROS bag (.bag, .db3, .mcap or "
        "metadata.yaml), CSV file, or JSON of BAM"
    )
