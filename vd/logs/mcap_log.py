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
JOINT_STATE = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
IMAGE = "sensor_msgs/msg/Image"
TEXT = "std_msgs/msg/String"
STEP = "visual_dexterity_msgs/msg/Step"
_TYPES = {
    JOINT_STATE: "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    "float64[] velocity\nfloat64[] effort",
    POSE: "std_msgs/Header header\ngeometry_msgs/Pose pose",
    IMAGE: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data",
    TEXT: "string data",
    STEP: "\n".join(
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
        self._schemas = {}
        for name, text in _TYPES.items():
            self._schemas[name] = self._writer.register_msgdef(name, _definition(text))
        self._run = dict(run)
        self._place = place
        self._joints = list(run["joints"])
        self._note()

    def step(self, row: Mapping[str, float], depth: np.ndarray | None) -> None:
        """Write a control step, by columns of steps.csv, and the depth image [m] [H, W] that it saw."""
        t = row["t"]
        joints = {}
        for channel in JOINT_CHANNELS:
            joints[channel] = [row.get(f"{channel}.{joint}", np.nan) for joint in self._joints]
        truth = [row[name] for name in TRUTH_COLUMNS if name in row]
        believed = [row[name] for name in FOUND_COLUMNS]
        self._write_joints(t, "/joint_states", joints["position"], joints["velocity"])
        self._write_joints(row["t_command"], "/joint_commands", joints["command"], [])
        self._write_pose(t, "/object_pose", truth[:7])
        self._write_pose(t, "/found_pose", believed)
        goals = self._run["goals"]
        if int(row["goal"]) < len(goals):
            self._write_pose(t, "/goal_pose", [*self._place, *goals[int(row["goal"])]])
        if depth is not None:
            self._write_depth(t, depth)
        plain = {name: row[name] for name in _PLAIN}
        self._write(t, "/step", STEP, **plain, **joints, object=truth, found=believed)

    def _write_joints(
        self, t: float, topic: str, position: list[float], velocity: list[float]
    ) -> None:
        fields = {"name": self._joints, "position": position, "velocity": velocity, "effort": []}
        self._write(t, topic, JOINT_STATE, **fields)

    def _write_pose(self, t: float, topic: str, pose: list[float]) -> None:
        """Write a pose [7], unless it is unknown."""
        if len(pose) != 7 or not np.isfinite(pose).all():
            return
        x, y, z, qx, qy, qz, qw = map(float, pose)
        position = {"x": x, "y": y, "z": z}
        orientation = {"x": qx, "y": qy, "z": qz, "w": qw}
        self._write(t, topic, POSE, pose={"position": position, "orientation": orientation})

    def _write_depth(self, t: float, depth: np.ndarray) -> None:
        """Write an image [m] [H, W] in whole millimetres."""
        height, width = depth.shape
        millimetres = np.clip(np.rint(1e3 * depth), 0, np.iinfo(np.uint16).max).astype("<u2")
        self._write(
            t,
            "/depth",
            IMAGE,
            height=height,
            width=width,
            encoding="16UC1",
            is_bigendian=0,
            step=2 * width,
            data=millimetres.tobytes(),
        )

    def event(self, line: Mapping[str, Any]) -> None:
        """Write an event, as of events.jsonl."""
        self._write(line["t"], "/events", TEXT, data=json.dumps(line))

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

    steps = []
    events = []
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            run: Any = {}
            for record in reader.iter_metadata():
                if record.name == "run":
                    run = json.loads(record.metadata["json"])
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
    arrays: dict[str, np.ndarray] = {}
    for field in (*_PLAIN, *JOINT_CHANNELS, "object", "found"):
        arrays[field] = np.array([getattr(step, field) for step in steps])
    columns = {name: arrays[name] for name in _PLAIN}
    for channel in JOINT_CHANNELS:
        for joint, values in zip(joints, arrays[channel].T, strict=True):
            columns[f"{channel}.{joint}"] = values
    # A run on a hand has no true pose of the object.
    columns |= zip(TRUTH_COLUMNS, arrays["object"].T, strict=False)
    columns |= zip(FOUND_COLUMNS, arrays["found"].T, strict=False)
    return columns


def _definition(text: str) -> str:
    """A message's definition with those of what it is made of, as MCAP wants it."""
    parts = {"": text}
    waiting = [text]
    while waiting:
        for name in waiting.pop().split():
            if name in _PARTS and name not in parts:
                parts[name] = f"{80 * '='}\nMSG: {name}\n{_PARTS[name]}"
                waiting.append(_PARTS[name])
    return "\n".join(parts.values())
