"""A hand and a camera behind ROS 2, by a stand-in for rclpy."""

import json
import sys
import threading
import time
from array import array
from functools import partial
from types import SimpleNamespace as Message
from unittest.mock import MagicMock

import numpy as np
import pytest

from vd.assets_usd.hands import load_hand
from vd.deploy import cli, ros
from vd.deploy.camera.camera import CameraError, StaleCamera
from vd.deploy.camera.ros_camera import RosCamera
from vd.deploy.hardware.answers import SilentError
from vd.deploy.ros import RosHand
from vd.deploy.safety.safety import SafeHand, StoppedError
from vd.logs.hand_log import read_log

HAND = load_hand("dclaw3")


LISTENERS: dict[str, list] = {}
"""Who is called with the messages of a topic."""
NODES: list = []


def make_node(name):
    """A node of rclpy, as far as it is used; topics call who listens at once."""

    def resolved(topic):
        return f"/{name}{topic[1:]}" if topic.startswith("~") else f"/{topic}"

    def publisher(_, topic, __):
        count = MagicMock(side_effect=lambda: len(LISTENERS.get(resolved(topic), [])))
        return Message(publish=partial(publish, resolved(topic)), get_subscription_count=count)

    def subscription(_, topic, do, __):
        LISTENERS.setdefault(resolved(topic), []).append(do)

    node = MagicMock(
        resolve_topic_name=resolved, create_publisher=publisher, create_subscription=subscription
    )
    node.destroy_node = lambda: NODES.remove(node)
    NODES.append(node)
    return node


def publish(topic, message):
    """To all who listen."""
    for do in list(LISTENERS.get(topic, [])):
        do(message)


def stamped(age_s=0.0):
    """A header of now."""
    ns = time.time_ns() - int(1e9 * age_s)
    return Message(stamp=Message(sec=ns // 10**9, nanosec=ns % 10**9))


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    LISTENERS.clear()
    rclpy = MagicMock(create_node=make_node, __spec__="here")
    ended = MagicMock(ExternalShutdownException=RuntimeError)
    messages = MagicMock(Float64MultiArray=Message, String=Message, SetParametersResult=Message)
    for name in (
        "rclpy.signals",
        "rclpy.qos",
        "sensor_msgs",
        "sensor_msgs.msg",
        "std_srvs",
        "std_srvs.srv",
    ):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    for name in ("std_msgs", "std_msgs.msg", "rcl_interfaces", "rcl_interfaces.msg"):
        monkeypatch.setitem(sys.modules, name, messages)
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "rclpy.executors", ended)
    for module in ("vd.deploy.ros", "vd.deploy.camera.ros_camera"):
        monkeypatch.setattr(f"{module}.FIRST_S", 0.1)
    monkeypatch.setattr("vd.deploy.ros.LOOK_S", 0.3)


class Driver(threading.Thread):
    """Joints in another order, beside one of an arm, that go to their commands at once.

    Told at 100 Hz.
    """

    def __init__(self):
        super().__init__(daemon=True)
        self.q, self.sent, self.events, self.over = HAND.start.copy(), [], [], threading.Event()
        LISTENERS["/commands"] = [lambda message: self.sent.append(np.array(message.data))]
        LISTENERS["/visual_dexterity/events"] = [lambda m: self.events.append(json.loads(m.data))]

    def run(self):
        """Until it is over."""
        names = ["arm", *reversed(HAND.joint_names)]
        while not self.over.wait(0.01):
            self.q = self.sent[-1] if self.sent else self.q
            position = array("d", [9.0, *self.q[::-1]])
            told = {
                "position": position,
                "velocity": array("d", [0.0] * len(names)),
                "effort": array("d"),
            }
            publish("/joint_states", Message(header=stamped(), name=names, **told))
            publish("/joint_states", Message(header=stamped(), name=["arm"], position=[0.0]))

    def until(self, event, goal):
        """Wait for an event of a goal."""
        while not any((one["event"], one.get("goal")) == (event, goal) for one in self.events):
            time.sleep(0.02)


@pytest.mark.slow
def test_a_hand_behind_ros_pursues_goals_of_the_service_until_it_is_told_to_finish(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("vd.deploy.loop.run.write_page", lambda log, *_, **__: log.path)
    driver, answers = Driver(), []
    driver.start()

    def person():
        while len(driver.sent) < 100:  # it is held at its start until there is a goal
            time.sleep(0.02)
        node, one = NODES[0], [0.0, 0.0, 1.0, 1.0]
        judge = node.add_on_set_parameters_callback.call_args.args[0]
        for number, value in enumerate([one[1:], one, one]):
            answers.append(judge([Message(name="goal", value=value)]))
            if number:
                driver.until("stop", number - 1)
        node.create_service.call_args.args[2](None, Message())

    threading.Thread(target=person, daemon=True).start()
    line = "zero --ros2 --yes --no-realtime --episode-s 0.8 --hold-s 0.2 --log"
    assert cli.main([*line.split(), str(tmp_path / "log")]) == 0
    driver.over.set()
    assert [answer.successful for answer in answers] == [False, True, True]
    assert "give a quaternion x,y,z,w" in answers[0].reason and answers[2].reason == "goal 2"
    log = read_log(tmp_path / "log")
    assert [stop.outcome for stop in log.stops] == ["time limit"] * 2 and not NODES
    np.testing.assert_allclose(log.goals, np.sqrt(0.5) * np.array([[0, 0, 1, 1]] * 2), atol=1e-6)
    np.testing.assert_allclose(log.channel("position") - HAND.start, 0.0, atol=0.01)
    assert "current.f0_j1" not in log.columns


def test_what_is_missing_old_or_of_other_names_is_said_and_nothing_moves(capsys):
    line = "zero --ros2 --yes --no-realtime"
    assert cli.main(line.split()) == 1
    assert "dclaw3 on /joint_states" in capsys.readouterr().err
    hand = RosHand(HAND, make_node("a"))
    few = Message(header=stamped(), name=["f0_j1"], position=[0.0], velocity=[0.0])
    publish("/joint_states", few)
    assert "lacks f0_j2" in next(hand.findings()).words
    with pytest.raises(SilentError, match="JointState lacks f0_j2"):
        hand.read_state()
    whole = {"name": HAND.joint_names, "position": HAND.upper + 1.0, "velocity": HAND.upper}
    publish("/joint_states", Message(header=stamped(9.0), **whole))
    with pytest.raises(SilentError, match="JointState on /joint_states"):
        hand.read_state()
    states, commands, pose = hand.findings()
    assert "fewer than 24" in states.words and "set clocks" in states.words and not states.ok
    assert "on /commands" in commands.words and "f0_j1" in pose.words


def test_states_and_images_from_the_future_are_refused_with_their_topic():
    """Five seconds ahead they would be fresh for five seconds after the last one came."""
    hand = RosHand(HAND, make_node("a"))
    whole = {"name": HAND.joint_names, "position": HAND.start, "velocity": 0.0 * HAND.start}
    publish("/joint_states", Message(header=stamped(-5.0), **whole))
    said = (
        r"JointState on /joint_states is \d\.\d\d s from the future: wait .*clocks.*stamp it when"
    )
    with pytest.raises(SilentError, match=said):
        hand.read_state()
    (states,) = hand.findings()
    assert not states.ok and "from the future" in states.words
    age_s, over = [0.0], threading.Event()

    def driver():
        while not over.wait(0.01):
            publish("/joint_states", Message(header=stamped(age_s[0]), **whole))

    threading.Thread(target=driver, daemon=True).start()
    with SafeHand(hand, ros._Joints(HAND)) as safe:
        safe.arm()
        begin, age_s[0] = time.monotonic(), -5.0
        with pytest.raises(StoppedError, match=said):
            while time.monotonic() < begin + 2.0:
                safe.read()
                safe.beat()
        assert time.monotonic() - begin < 1.0
    over.set()
    publish("/joint_states", Message(header=stamped(), **whole))
    np.testing.assert_array_equal(hand.read_state().position, HAND.start)


def test_depth_comes_in_either_encoding_with_its_age_and_other_images_are_refused():
    lens = Message(width=3, height=2, k=[4.0, 0, 1, 0, 5, 0.5, 0, 0, 1], d=[0.0] * 5)
    node = make_node("a")

    def opened(lens):
        timer = threading.Timer(0.02, lambda: publish("/depth/camera_info", lens))
        timer.start()
        return RosCamera(node)

    camera = opened(lens)
    assert (camera.intrinsics.fx, camera.intrinsics.cx, camera.intrinsics.cy) == (4.0, 1.5, 1.0)
    rows = np.array([[0, 500, 65535], [1, 2, 3]])
    for encoding, kind, unit, big in (
        ("16UC1", "<u2", 1, 0),
        ("16UC1", ">u2", 1, 1),
        ("32FC1", "<f4", 1e-3, 0),
    ):
        data = np.pad(rows * unit, ((0, 0), (0, 1))).astype(kind).tobytes()  # rows are padded
        size = {"height": 2, "width": 3, "encoding": encoding, "is_bigendian": big}
        publish("/depth/image_rect_raw", Message(header=stamped(0.05), data=data, **size))
        frame = camera.read(0.1)
        np.testing.assert_allclose(frame.image, 1e-3 * rows, rtol=1e-6)
        assert 0.04 < time.monotonic() - frame.time_s < 0.5
    with pytest.raises(StaleCamera, match="image on /depth/image_rect_raw"):
        camera.read(0.01)
    publish("/depth/image_rect_raw", Message(header=stamped(-1.0), data=data, **size))
    with pytest.raises(CameraError, match=r"/depth/image_rect_raw is \d.\d\d s"):
        camera.read(0.1)
    publish("/depth/image_rect_raw", Message(header=stamped(), encoding="rgb8"))
    with pytest.raises(CameraError, match=r"rgb8; .*16UC1 or 32FC1"):
        camera.read(0.1)
    camera.close()
    with pytest.raises(CameraError, match="distorted"):
        opened(Message(**{**vars(lens), "d": [0.1]}))
    with pytest.raises(CameraError, match="/depth/camera_info"):
        RosCamera(node)
