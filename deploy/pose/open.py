"""From ``--pose SOURCE`` to a source of poses, and the frame that they are in."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import HandModel, compose
from vd.command.config import from_dict
from vd.deploy.camera.realsense import RealSense, RealSenseCfg, find_device
from vd.deploy.hardware.connect import Connection
from vd.deploy.pose.source import PoseSource
from vd.deploy.pose.tags import SIZE_M, TagPoses
from vd.deploy.pose.twin_poses import TagsOfTwin, TruthCfg, TwinPoses
from vd.deploy.pose.udp_poses import UdpPoses

FORMS = "ros2:/TOPIC, udp:PORT, udp:ADDRESS:PORT, tags, tags:SIDE_M or, of a twin, sim"
NO_MOTION = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
"""The pose of a frame in itself."""


@dataclass(frozen=True)
class PoseOptions:
    """What ``--pose`` says."""

    kind: str
    """ros2, udp, tags or sim."""
    topic: str = ""
    host: str = "127.0.0.1"
    port: int = 0
    size_m: float = SIZE_M
    """Side of a cube of tags [m]."""
    truth: TruthCfg = field(default_factory=TruthCfg)
    """Errors of a twin's truth."""


def pose_options(text: str) -> PoseOptions:
    """Read what ``--pose`` says.

    Raises:
        ValueError: It is none of the forms.
    """
    kind, _, rest = text.partition(":")
    try:
        if kind == "ros2" and rest.startswith("/"):
            return PoseOptions(kind, topic=rest)
        if kind == "udp":
            host, _, port = rest.rpartition(":")
            if 0 < int(port) < 65536:
                return PoseOptions(kind, host=host or "127.0.0.1", port=int(port))
        if kind == "tags":
            size_m = float(rest or SIZE_M)
            if 0.0 < size_m < 1.0:
                return PoseOptions(kind, size_m=size_m)
        if kind == "sim":
            settings = [setting.partition("=") for setting in rest.split(",") if setting]
            values = {name: float(value) for name, _, value in settings}
            truth = from_dict(TruthCfg, values, where="--pose sim:")
            truth.validate()
            return PoseOptions(kind, truth=truth)
    except ValueError as error:
        raise ValueError(f"--pose {text}: {error}; give {FORMS}") from error
    raise ValueError(f"--pose {text}: give {FORMS}")


def check_pose_options(text: str, *, twin: bool) -> None:
    """Refuse what ``--pose`` says before anything slow is imported.

    Raises:
        ValueError: It is none of the forms, or not for this hand.
    """
    kind = pose_options(text).kind
    if kind == "sim" and not twin:
        raise ValueError("--pose sim is the truth of a twin; add --twin, or give another source")
    if kind == "ros2":
        from vd.deploy.ros import need_rclpy

        need_rclpy("--pose ros2")


def source_frame(
    hand: HandModel, place: Sequence[float] | None, camera_layer: Path | None
) -> np.ndarray:
    """Pose of a source's frame in the hand's base frame [7].

    Args:
        hand: The hand.
        place: What --pose-frame says: position [m] and quaternion xyzw.
        camera_layer: Where the camera was found to be.

    Raises:
        ValueError: It is no pose, or nobody says where the camera is.
    """
    from vd.assets_usd.camera_layer import read_camera_pose

    if place is not None:
        frame = np.asarray(place, dtype=float)
        length = float(np.linalg.norm(frame[3:]))
        if not np.isfinite(frame).all() or length == 0.0:
            raise ValueError("--pose-frame must be a position and a quaternion xyzw")
        frame[3:] /= length
        return frame
    if camera_layer is None and hand.mounted_camera is None:
        raise ValueError(
            f"{hand.name} has no camera: --pose-frame X Y Z QX QY QZ QW says where the frame of the "
            "poses is in the hand's base; a run is told by --camera-layer, too (vd-deploy calibrate)"
        )
    if camera_layer is not None:
        return read_camera_pose(hand, camera_layer)
    return np.concatenate([hand.camera.position, hand.camera.quaternion])


@contextlib.contextmanager
def open_poses(
    text: str,
    connection: Connection,
    camera: RealSenseCfg,
    in_base: np.ndarray,
    *,
    ros_arguments: str = "",
    seed: int = 0,
) -> Iterator[tuple[PoseSource, np.ndarray]]:
    """A source of poses, and the pose of its frame in the world frame [7], while the block lasts.

    Args:
        text: What ``--pose`` says.
        connection: The hand, or its twin.
        camera: Settings of the camera that sees tags.
        in_base: Pose of the source's frame in the hand's base frame [7].
        ros_arguments: Of ROS, for a node of its own.
        seed: Of the noise of what a twin tells.

    Raises:
        PoseSourceError: There is none.
        CameraError: The camera does not serve.
    """
    options = pose_options(text)
    hand, twin = connection.hand, connection.twin
    frame = compose(hand.mount, in_base)
    with contextlib.ExitStack() as stack:
        source: PoseSource
        if options.kind == "sim":
            assert twin is not None
            source = TwinPoses(twin.object_state, options.truth, seed=seed)
            frame = NO_MOTION
        elif options.kind == "udp":
            source = UdpPoses(options.host, options.port)
        elif options.kind == "ros2":
            from vd.deploy.pose.ros_poses import RosPoses
            from vd.deploy.ros import running_node

            node: Any = connection.ros
            if node is None:
                node = stack.enter_context(running_node(ros_arguments))
            source = RosPoses(node, options.topic)
        elif twin is not None:
            images = TagsOfTwin(twin, hand, in_base, options.size_m, seed=seed)
            source = TagPoses(images, options.size_m).start()
        else:
            eye = RealSense(find_device(camera.serial), camera, infrared=True)
            source = TagPoses(eye, options.size_m).start()
        stack.callback(source.close)
        yield source, frame
