"""Poses of a topic of ROS 2, geometry_msgs/PoseStamped."""

from typing import Any

from vd.deploy.camera.ros_camera import monotonic
from vd.deploy.pose.source import PoseSourceError, StampedPose, make_pose


class RosPoses:
    """Poses of a topic, stamped when their image was exposed.

    The frame of a message is not looked up: --pose-frame places it.

    Args:
        node: Of rclpy.
        topic: Its topic.
    """

    def __init__(self, node: Any, topic: str):
        from geometry_msgs.msg import PoseStamped
        from rclpy.qos import qos_profile_sensor_data

        self.name = f"ros2:{node.resolve_topic_name(topic)}"
        self.trouble = ""
        self._node = node
        self._message: Any = None
        self._held = node.create_subscription(
            PoseStamped, topic, self._take, qos_profile_sensor_data
        )

    def _take(self, message: Any) -> None:
        """Called with every message."""
        self._message = message

    def read(self) -> StampedPose | None:
        """The newest pose; None before the first one.

        Raises:
            PoseSourceError: What came is no pose, or has no stamp.
        """
        message = self._message
        if message is None:
            return None
        stamp = message.header.stamp
        if stamp.sec == 0:
            raise PoseSourceError(
                f"{self.name}: poses have no stamp; stamp them when they are seen"
            )
        place, turn = message.pose.position, message.pose.orientation
        position = (place.x, place.y, place.z)
        quaternion = (turn.x, turn.y, turn.z, turn.w)
        return StampedPose(monotonic(stamp), make_pose(position, quaternion, self.name))

    def close(self) -> None:
        """Listen no more."""
        self._node.destroy_subscription(self._held)
