"""A hand and its camera behind ROS 2.

In place of motors, camera, and command line for the control loop.

The node ``visual_dexterity`` reads JointState on ``joint_states`` and, for a policy that sees,
depth of 16UC1 or 32FC1 on ``depth/image_rect_raw``, with ``depth/camera_info``. On ``commands`` it
sends Float64MultiArray, an angle [rad] for each joint in the order of the hand's USD, as
ros2_control's forward_position_controller takes it. A value of its parameter ``goal``, a quaternion
xyzw, is a further goal: ``ros2 param set`` calls the service ``set_parameters``, which says why it
refuses one. The service ``~/finish`` (Trigger) ends the run after the last goal. ``~/events``
(String) tells of goals and stops. Topics get other names by remapping.

Motors stay in the care of the driver: their torque, temperature and current are not looked at.
"""

import contextlib
import importlib.util
import json
import shlex
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import HandModel, MotorModel
from vd.assets_usd.hands import load_hand
from vd.deploy.camera.ros_camera import FIRST_S, monotonic
from vd.deploy.clock import MONOTONIC, Clock, from_future
from vd.deploy.finding import Finding, finding
from vd.deploy.hardware.answers import HandState, SilentError
from vd.deploy.hardware.connect import Connection, HandOptions
from vd.deploy.hardware.joints import JointMotors
from vd.deploy.hardware.motors import FaultlessMotors
from vd.deploy.loop.goals import GoalError, make_goals
from vd.deploy.safety.limits import out_of_range
from vd.paper import PAPER

NODE = "visual_dexterity"
STATES, COMMANDS = "joint_states", "commands"
UNKNOWN = ("current", "temperature")
"""What a log has no columns of: a JointState does not tell."""
STATE_S = 0.05
"""Oldest state that the loop acts on, and how long a new one is waited for."""
LOOK_S = 2.0
"""How long messages are counted before the hand moves."""
FEWEST = 2.0
"""States for each control step, at least."""


class _Joints(JointMotors):
    """Joints whose motors nobody here knows: of each angles and limits are the joint's own."""

    def __init__(self, hand: HandModel):
        stand_in = [MotorModel("XM430-W210", axis) for axis in range(len(hand.joint_names))]
        super().__init__(hand, tuple(stand_in))

    def servo(self) -> dict[str, str | int]:
        """What a log says of the motors."""
        return {"model": "behind ROS 2"}


class RosHand(FaultlessMotors):
    """A hand behind topics, as :class:`vd.deploy.hardware.motors.Motors`.

    Stops hold, torque stays on.

    Args:
        hand: The hand, whose joints have the same names there.
        node: Of rclpy.
    """

    clock: Clock = MONOTONIC

    def __init__(self, hand: HandModel, node: Any):
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray

        self.hand = hand
        self.ids = tuple(range(len(hand.joint_names)))
        self.count = 0
        """JointStates so far."""
        self._message = Float64MultiArray
        self._node = node
        self._state: HandState | None = None
        self._wrong = ""
        self._arrived = threading.Condition()
        self._commands = node.create_publisher(Float64MultiArray, COMMANDS, 1)
        node.create_subscription(JointState, STATES, self._take, qos_profile_sensor_data)

    def _take(self, message: Any) -> None:
        """Called with every JointState; those of other joints alone are passed over."""
        places = {name: index for index, name in enumerate(message.name)}
        missing = [name for name in self.hand.joint_names if name not in places]
        if len(missing) == len(self.hand.joint_names):
            return
        none = np.full(len(self.ids), np.nan)
        time_s = monotonic(message.header.stamp)
        ahead = from_future(time_s, self.clock.now())
        with self._arrived:
            if ahead:
                topic = self._node.resolve_topic_name(STATES)
                self._wrong = f"a JointState on {topic} is {ahead}, and stamp it when it is read"
                return
            if missing or not len(message.position) == len(message.velocity) == len(places):
                lacks = (
                    f"lacks {missing[0]}"
                    if missing
                    else "has no position and velocity for each joint"
                )
                self._wrong = f"JointState {lacks}; names are those of the hand's USD"
                return
            self._wrong = ""
            order = [places[name] for name in self.hand.joint_names]
            self._state = HandState(
                time_s=time_s,
                position=np.asarray(message.position, dtype=float)[order],
                velocity=np.asarray(message.velocity, dtype=float)[order],
                current=none,
                pwm=none,
                voltage=none,
                temperature=none,
                alert=np.zeros(len(order), dtype=bool),
                tick=np.zeros(len(order)),
            )
            self.count += 1
            self._arrived.notify_all()

    def findings(self) -> Iterator[Finding]:
        """What has to be right before it moves; nothing is sent."""
        topic = self._node.resolve_topic_name(STATES)
        with self._arrived:
            came = self._arrived.wait_for(lambda: self._state is not None, FIRST_S)
        if not came:
            why = (
                self._wrong
                or f"none of {self.hand.name} on {topic}: start its driver, or remap {STATES}"
            )
            yield Finding("joint states", False, why)
            return
        begin = self.clock.now()
        first = self.count
        ages = []
        while self.clock.now() < begin + LOOK_S:
            assert self._state is not None
            ages.append(self.clock.now() - self._state.time_s)
            self.clock.sleep(STATE_S)
        rate = (self.count - first) / LOOK_S
        age = float(np.median(ages))
        wrong = []
        if rate < FEWEST * PAPER.scene.control_hz:
            wrong.append(f"{rate:.0f} a second, fewer than {FEWEST * PAPER.scene.control_hz:.0f}")
        if not age <= STATE_S:
            wrong.append(
                f"{1e3 * age:.0f} ms old: stamp them when they are read, and set clocks (NTP)"
            )
        yield finding(
            "joint states", wrong, f"{rate:.0f} a second on {topic}, {1e3 * age:.0f} ms old"
        )
        listen = self._commands.get_subscription_count()
        commands = self._node.resolve_topic_name(COMMANDS)
        remedy = f"nobody listens on {commands}: start a controller, or remap"
        yield finding("commands", [] if listen else [remedy], f"{listen} listen")
        assert self._state is not None
        bad = out_of_range(self.hand, self._state.position)
        yield finding("pose within limits", bad, "every joint")

    def read_state(self, *, retries: int | None = None) -> HandState:
        """The newest state.

        Raises:
            SilentError: It is too old, and none comes that is new, whole and of the present.
        """

        def fresh() -> bool:
            return self._state is not None and self.clock.now() - self._state.time_s < STATE_S

        with self._arrived:
            if not self._arrived.wait_for(fresh, STATE_S) or self._state is None:
                topic = self._node.resolve_topic_name(STATES)
                raise SilentError(self._wrong or f"no new JointState on {topic}")
            return self._state

    def write_goals(self, goals: np.ndarray, *, with_state: bool = False) -> None:
        """Send an angle for each joint [rad]."""
        self._commands.publish(self._message(data=list(map(float, goals))))

    def freeze(self) -> None:
        """Have joints stay where they were last."""
        if self._state is not None:
            self.write_goals(self._state.position)

    def stiffen(self, share: float, ids: Sequence[int] | None = None) -> None:
        """The driver's."""

    def torque(self, on: bool, ids: Sequence[int] | None = None) -> dict[int, str]:
        """The driver's: nothing fails here."""
        return {}

    def read_torque(self) -> np.ndarray:
        """Taken to be on."""
        return np.ones(len(self.ids), dtype=bool)

    def release(self) -> None:
        """The driver's."""


class RosGoals:
    """Goals that others give while a hand is driven.

    It also publishes the log's events.
    """

    def __init__(self, node: Any, goals: list[np.ndarray]):
        from rcl_interfaces.msg import SetParametersResult
        from std_msgs.msg import String
        from std_srvs.srv import Trigger

        self._goals = goals
        self._result = SetParametersResult
        self._string = String
        self._finished = threading.Event()
        self._events = node.create_publisher(String, "~/events", 10)
        node.declare_parameter("goal", [0.0, 0.0, 0.0, 1.0])
        node.add_on_set_parameters_callback(self._set)
        node.create_service(Trigger, "~/finish", self._finish)

    def more(self) -> bool:
        """Whether a further goal may come."""
        return not self._finished.is_set()

    def _set(self, parameters: Sequence[Any]) -> Any:
        try:
            new = []
            for parameter in parameters:
                if parameter.name == "goal":
                    new += make_goals([",".join(map(str, parameter.value))])
        except (GoalError, TypeError) as error:
            return self._result(successful=False, reason=str(error))
        self._goals.extend(new)
        return self._result(successful=True, reason=f"goal {len(self._goals)}")

    def _finish(self, _: Any, answer: Any) -> Any:
        self._finished.set()
        answer.success = True
        answer.message = "ends after the last goal"
        return answer

    def event(self, line: Mapping[str, Any]) -> None:
        """Publish an event."""
        self._events.publish(self._string(data=json.dumps(line)))


@contextlib.contextmanager
def connect_ros(options: HandOptions, arguments: str = "") -> Iterator[Connection]:
    """A hand behind ROS 2, while its node is there.

    Args:
        options: The hand.
        arguments: Of ROS, such as ``-r commands:=/forward_position_controller/commands``.

    Raises:
        ValueError: The hand cannot be used.
    """
    hand = load_hand(options.hand, layer=options.hand_layer)
    with running_node(arguments) as node:
        yield Connection(_Joints(hand), RosHand(hand, node), ros=node)


def need_rclpy(flag: str) -> None:
    """Refuse a flag where there is no ROS 2.

    Raises:
        ValueError: Names flag and remedy.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise ValueError(f"{flag} needs rclpy: source the setup.bash of a ROS 2 for this Python")


@contextlib.contextmanager
def running_node(arguments: str = "") -> Iterator[Any]:
    """A node whose messages a thread takes, while the block lasts.

    Args:
        arguments: Of ROS.
    """
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    words = ["--ros-args", *shlex.split(arguments)]
    # A signal stops the hand first.
    rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(NODE)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    try:
        threading.Thread(target=spin, name="ros", daemon=True).start()
        yield node
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()
