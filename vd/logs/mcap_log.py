"""The log of a run in one MCAP file of ROS 2 messages, which Foxglove, PlotJuggler and ``ros2 bag`` read too.

For them are ``/joint_states``, ``/joint_commands``, ``/object_pose`` (a twin's), ``/found_pose``
(as the policy finds it), ``/goal_pose`` and ``/depth`` [mm]. :func:`vd.logs.hand_log.read_log` reads
``/step``, each row of steps.csv whole, ``/events``, and the metadata ``run``, which is run.json.
Needs the extra ``log``.
"""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from vd.command import interrupt
from vd.logs.log_format import (
    FOUND_COLUMNS,
    JOINT_CHANNELS,
    LOG_FORMAT,
    STEP_COLUMNS,
    TRUTH_COLUMNS,
    LogError,
)

WORLD = "world"
_NS = 1_000_000_000
_PLAIN = ("t", "t_command", *STEP_COLUMNS)
_TIME = "int32 sec\nuint32 nanosec"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id"
_XYZ = "float64 x\nfloat64 y\nfloat64 z"
_PARTS = {
    "std_msgs/Header": _HEADER,
    "builtin_interfaces/Time": _TIME,
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Quaternion": f"{_XYZ}\nfloat64 w",
}
_TYPES = {
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    "float64[] velocity\nfloat64[] effort",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "sensor_msgs/msg/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data",
    "std_msgs/msg/String": "string data",
    "visual_dexterity_msgs/msg/Step": "\n".join(
        [f"float64 {name}" for name in _PLAIN]
        + [f"float64[] {name}" for name in (*JOINT_CHANNELS, "object", "found")]
    ),
}
"""Definitions of the messages; the file has them, so that a reader needs no package with the last
one.
"""


class McapLog:
    """A log being written, beside the folder.

    Methods are those of :class:`vd.deploy.loop.log.Sink`.

    Args:
        path: The file; it must not be there.
        run: As of run.json; ``unix_s`` is when it began.
        place: Where goals are shown [m] [3], world frame.

    Raises:
        FileExistsError: It is there.
    """

    def __init__(self, path: Path, run: Mapping[str, Any], place: np.ndarray):
        from mcap_ros2.writer import Writer

        self._file: IO[bytes] = path.open("xb")
        self._writer = Writer(self._file)
        self._schemas = {
            name: self._writer.register_msgdef(name, _definition(text))
            for name, text in _TYPES.items()
        }
        self._run, self._place, self._joints = dict(run), place, list(run["joints"])
        self._note()

    def step(self, row: Mapping[str, float], depth: np.ndarray | None) -> None:
        """Write a control step, by columns of steps.csv, and the depth image [m] [H, W] that it saw."""
        joints = {
            channel: [row.get(f"{channel}.{joint}", np.nan) for joint in self._joints]
            for channel in JOINT_CHANNELS
        }
        truth = [row[name] for name in TRUTH_COLUMNS if name in row]
        found = [row[name] for name in FOUND_COLUMNS]
        t, goals = row["t"], self._run["goals"]
        state = {
            "name": self._joints,
            "position": joints["position"],
            "velocity": joints["velocity"],
        }
        self._write(t, "/joint_states", "sensor_msgs/msg/JointState", **state, effort=[])
        sent = {"name": self._joints, "position": joints["command"], "velocity": [], "effort": []}
        self._write(row["t_command"], "/joint_commands", "sensor_msgs/msg/JointState", **sent)
        poses = {"object": truth[:7], "found": found}
        if (number := int(row["goal"])) < len(goals):
            poses["goal"] = [*self._place.tolist(), *goals[number]]
        for name, pose in poses.items():
            if len(pose) == 7 and np.isfinite(pose).all():
                at = {"position": dict(zip("xyz", pose[:3], strict=True))}
                at["orientation"] = dict(zip("xyzw", pose[3:], strict=True))
                self._write(t, f"/{name}_pose", "geometry_msgs/msg/PoseStamped", pose=at)
        if depth is not None:
            data = np.clip(np.rint(1e3 * depth), 0, np.iinfo(np.uint16).max).astype("<u2")
            size = {"height": depth.shape[0], "width": depth.shape[1], "step": 2 * depth.shape[1]}
            image = {**size, "encoding": "16UC1", "is_bigendian": 0, "data": data.tobytes()}
            self._write(t, "/depth", "sensor_msgs/msg/Image", **image)
        whole = {**{name: row[name] for name in _PLAIN}, **joints, "object": truth, "found": found}
        self._write(t, "/step", "visual_dexterity_msgs/msg/Step", **whole)

    def event(self, line: Mapping[str, Any]) -> None:
        """Write an event, as of events.jsonl."""
        self._write(line["t"], "/events", "std_msgs/msg/String", data=json.dumps(line))

    def close(self, run: Mapping[str, Any]) -> None:
        """End the file, with what run.json says at the end."""
        self._run = dict(run)
        self._note()
        self._writer.finish()
        self._file.close()

    def _note(self) -> None:
        self._writer.add_metadata("run", {"json": json.dumps(self._run)})

    def _write(self, t: float, topic: str, kind: str, /, **fields: Any) -> None:
        """A message of a time since the begin [s]."""
        ns = round(_NS * (self._run["unix_s"] + t))
        if "Header" in _TYPES[kind]:
            fields["header"] = {"stamp": {"sec": ns // _NS, "nanosec": ns % _NS}, "frame_id": WORLD}
        self._writer.write_message(topic, self._schemas[kind], fields, log_time=ns)


def read_mcap(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray], list[dict[str, Any]]]:
    """Read a log that :class:`McapLog` wrote: what run.json says, columns of steps.csv, and events.

    Raises:
        LogError: It is none, or damaged.
        ModuleNotFoundError: The extra ``log`` is not installed.
    """
    interrupt.need("mcap_ros2")
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    steps, events = [], []
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            run: Any = {}
            for one in reader.iter_metadata():
                run = json.loads(one.metadata["json"]) if one.name == "run" else run
            if not isinstance(run, dict) or run.get("format") != LOG_FORMAT:
                raise LogError(
                    f"{path} is no log of vd-deploy; vd-deploy --log NAME.mcap writes one"
                )
            for _, channel, _, message in reader.iter_decoded_messages(topics=["/step", "/events"]):
                if channel.topic == "/step":
                    steps.append(message)
                else:
                    events.append(json.loads(message.data))
    except LogError:
        raise
    except (McapError, struct.error, ValueError, KeyError, OSError) as error:
        raise LogError(f"{path} is damaged ({error}); read the folder beside it") from error
    if not steps:
        raise LogError(f"{path} has no steps")
    return run, _columns(steps, run["joints"]), events


def _columns(steps: list[Any], joints: list[str]) -> dict[str, np.ndarray]:
    """Columns of steps.csv [T]."""
    columns = {name: np.array([getattr(step, name) for step in steps]) for name in _PLAIN}
    for channel in JOINT_CHANNELS:
        values = np.array([getattr(step, channel) for step in steps])
        columns |= {f"{channel}.{joint}": values[:, i] for i, joint in enumerate(joints)}
    for field, names in (("object", TRUTH_COLUMNS), ("found", FOUND_COLUMNS)):
        values = np.array([getattr(step, field) for step in steps])
        columns |= {name: values[:, i] for i, name in enumerate(names) if values.shape[1]}
    return columns


def _definition(text: str) -> str:
    """A message's definition with those of what it is made of, as MCAP wants it."""
    used, new = dict[str, str](), [text]
    while new:
        words = new.pop().replace("\n", " ").split()
        for name in words:
            if name in _PARTS and name not in used:
                used[name] = _PARTS[name]
                new.append(_PARTS[name])
    return "".join([text, *(f"\n{80 * '='}\nMSG: {name}\n{part}" for name, part in used.items())])
