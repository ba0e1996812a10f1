"""The log of a run in one MCAP file of ROS 2 messages, for Foxglove, PlotJuggler and ``ros2 bag``.

Topics are ``/joint_states``, ``/joint_commands``, ``/object_pose`` (a twin's), ``/found_pose`` (as
the policy finds it), ``/goal_pose``, ``/depth`` [mm] and ``/events``. Needs the extra ``log``.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from vd.logs.log_format import FOUND_COLUMNS, TRUTH_COLUMNS

WORLD = "world"
_NS = 1_000_000_000
JOINT_STATE = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
IMAGE = "sensor_msgs/msg/Image"
TEXT = "std_msgs/msg/String"


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
        from rosbags.typesys import Stores, get_typestore

        self._file: IO[bytes] = path.open("xb")
        self._writer = Writer(self._file)
        self._schemas = {}
        types = get_typestore(Stores.LATEST)
        for name in (JOINT_STATE, POSE, IMAGE, TEXT):
            text, _ = types.generate_msgdef(name, ros_version=2)
            self._schemas[name] = self._writer.register_msgdef(name, text)
        self._run = dict(run)
        self._place = place
        self._joints = list(run["joints"])

    def step(self, row: Mapping[str, float], depth: np.ndarray | None) -> None:
        """Write a control step, by columns of steps.csv, and the depth image it saw [m] [H, W]."""
        t = row["t"]
        self._write_joints(t, "/joint_states", row, "position", "velocity")
        self._write_joints(row["t_command"], "/joint_commands", row, "command")
        self._write_pose(
            t, "/object_pose", [row[name] for name in TRUTH_COLUMNS[:7] if name in row]
        )
        self._write_pose(t, "/found_pose", [row[name] for name in FOUND_COLUMNS])
        goals = self._run["goals"]
        if int(row["goal"]) < len(goals):
            self._write_pose(t, "/goal_pose", [*self._place, *goals[int(row["goal"])]])
        if depth is not None:
            self._write_depth(t, depth)

    def _write_joints(
        self, t: float, topic: str, row: Mapping[str, float], position: str, velocity: str = ""
    ) -> None:
        """Write channels of all joints; without ``velocity`` it is empty."""
        columns = {}
        for field, channel in (("position", position), ("velocity", velocity)):
            columns[field] = [row[f"{channel}.{joint}"] for joint in self._joints if channel]
        self._write(t, topic, JOINT_STATE, name=self._joints, effort=[], **columns)

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
        self._writer.add_metadata("run", {"json": json.dumps(run)})
        self._writer.finish()
        self._file.close()

    def _write(self, t: float, topic: str, kind: str, /, **fields: Any) -> None:
        """A message of a time since the begin [s]."""
        ns = round(_NS * (self._run["unix_s"] + t))
        if kind != TEXT:
            fields["header"] = {"stamp": {"sec": ns // _NS, "nanosec": ns % _NS}, "frame_id": WORLD}
        self._writer.write_message(topic, self._schemas[kind], fields, log_time=ns)
