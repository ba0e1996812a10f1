"""Poses from outside: who tells them, whether they are believed, and that the hand stops otherwise."""

import json
import re
import socket
import sys
import time
from dataclasses import dataclass, field
from types import SimpleNamespace as Message
from unittest.mock import MagicMock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_clock import SimulatedClock

from vd.assets_usd.hand_data import Intrinsics, compose
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.deploy import cli
from vd.deploy.camera.camera import Frame, StaleCamera
from vd.deploy.clock import Pacer
from vd.deploy.hardware.joints import read_joints
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.log import LogWriter
from vd.deploy.loop.loop import ControlLoop
from vd.deploy.loop.policy_runner import PolicyDecision, PolicyRunner, Sensed, load_runner
from vd.deploy.pose import check_pose
from vd.deploy.pose.check_pose import pose_findings
from vd.deploy.pose.follower import PoseFollower
from vd.deploy.pose.open import pose_options, source_frame
from vd.deploy.pose.ros_poses import RosPoses
from vd.deploy.pose.source import PoseSourceError, StampedPose
from vd.deploy.pose.twin_poses import TruthCfg, TwinPoses
from vd.deploy.pose.udp_poses import UdpPoses
from vd.deploy.safety.safety import SafeHand, StoppedError
from vd.envs.cfg import ReorientCfg
from vd.logs.hand_log import read_log
from vd.policy.stopping import StoppingRule

HAND = load_hand("dclaw3")
HZ = 12.0
GOAL = np.array([0.0, 0.0, 0.0, 1.0])
NO_MOTION = np.array([0.0, 0.0, 0.0, *GOAL])


@dataclass
class ToldPoses:
    """A source that tells what it is given."""

    name = "told"
    trouble: str = ""
    newest: StampedPose | None = None

    def tell(self, time_s, place=(0.0, 0.0, 0.1), turn=(0.0, 0.0, 0.0)):
        """A pose of a time, its orientation as a rotation vector."""
        quat = Rotation.from_rotvec(turn).as_quat()
        self.newest = StampedPose(time_s, np.array([*place, *quat]))

    def read(self):
        """The last one."""
        return self.newest

    def close(self):
        """Nothing is held."""


def test_velocities_are_differences_of_poses_in_the_world_frame():
    source = ToldPoses()
    turn = Rotation.from_euler("x", 90.0, degrees=True)
    frame = np.array([0.1, 0.2, 0.3, *turn.as_quat()])
    follower = PoseFollower(source, frame, begin_s=5.0)
    assert follower.look().state is None and "no pose has come" in follower.look().fault
    source.tell(4.9)
    assert follower.look().state is None, "from before the run"
    source.tell(5.1, (0.0, 0.0, 0.1))
    first = follower.look()
    assert first.time_s == 5.1 and not first.fault and not first.state[7:].any()
    np.testing.assert_allclose(first.state[:3], frame[:3] + turn.apply([0.0, 0.0, 0.1]))
    source.tell(5.2, (0.0, 0.02, 0.1), (0.0, 0.0, 0.3))
    second = follower.look()
    np.testing.assert_allclose(second.state[:7], compose(frame, source.newest.pose), atol=1e-12)
    np.testing.assert_allclose(second.state[7:10], turn.apply([0.0, 0.2, 0.0]), atol=1e-9)
    np.testing.assert_allclose(second.state[10:], turn.apply([0.0, 0.0, 3.0]), atol=1e-9)
    assert follower.look().time_s == 5.2
    np.testing.assert_array_equal(follower.look().state, second.state, "held until the next")
    source.tell(5.15)
    np.testing.assert_array_equal(follower.look().state, second.state, "older ones are not taken")


@pytest.mark.parametrize(
    ("place", "turn", "said"),
    [
        ((0.0, 0.3, 0.1), (0.0, 0.0, 0.0), "told jumps by 300 mm and 0 degrees in 100 ms"),
        ((0.0, 0.0, 0.1), (0.0, 2.0, 0.0), "told jumps by 0 mm and 115 degrees in 100 ms"),
    ],
)
def test_a_jump_is_not_believed_however_long_it_lasts_and_one_back_is(place, turn, said):
    source = ToldPoses()
    follower = PoseFollower(source, NO_MOTION, begin_s=0.0)
    source.tell(1.0)
    before = follower.look().state
    for time_s in (1.1, 1.5, 2.0):
        source.tell(time_s, place, turn)
        jumped = follower.look()
        assert jumped.time_s == 1.0 and np.array_equal(jumped.state, before)
        assert jumped.fault.startswith(said.split(" in ")[0])
        assert time_s > 1.1 or jumped.fault == said
    source.tell(2.1)
    assert follower.look().time_s == 2.1 and not follower.look().fault


class Still(PolicyRunner):
    """Stays where it is, and keeps what it is told."""

    def __init__(self):
        super().__init__(ReorientCfg(), StoppingRule(0.1))
        self.told = []

    def decide(self, sensed) -> PolicyDecision:
        """No action."""
        self.told.append(sensed.object_state)
        return PolicyDecision(np.zeros_like(sensed.smoothed), 9.0)


@dataclass
class RestingTracker:
    """A tracker of a cube at rest in the hand, 20 Hz and 60 ms late, spoilt after a second."""

    clock: SimulatedClock
    spoil: str
    source: ToldPoses = field(default_factory=ToldPoses)
    name = "told"
    trouble = ""

    def read(self):
        """What it tells now."""
        now = self.clock.now()
        time_s = np.floor(20.0 * now) / 20.0 - 0.06
        place, turn = HAND.workspace.goal_m, (0.0, 0.0, 0.0)
        spoilt = now > 101.0 + 1.0
        if spoilt and self.spoil == "stale":
            self.trouble = "no tag is seen"
            return self.source.newest
        if spoilt and self.spoil == "jump":
            turn = (0.0, np.pi / 2, 0.0)
        if spoilt and self.spoil == "future":
            time_s += 2.0
        self.source.tell(time_s, place, turn)
        return self.source.newest

    def close(self):
        """Nothing is held."""


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ("", ""),
        ("stale", r"no pose is believed for 1\.0\d s: no tag is seen"),
        ("jump", r"no pose is believed for 1\.0\d s: told jumps by 0 mm and 90 degrees"),
        ("future", r"the newest pose is 1\.\d\d s from the future: wait .*stamp a pose when"),
        ("lost", "lost"),
    ],
)
def test_stale_jumping_and_future_poses_stop_the_hand_and_name_the_reason(tmp_path, spoil, said):
    pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")
    from simulated_hand import energised, simulated_bus

    joints, runner = read_joints(HAND), Still()
    log = LogWriter(tmp_path / "log", HAND, {"goals": [list(GOAL)]}, servo={})
    with simulated_bus(HAND, joints) as (line, bus):
        line.plant.position[:] = joints.to_motor(HAND.start)
        bus.clock.sleep(0.01)

        def run():
            with SafeHand(bus, joints) as safe:
                safe.arm()
                begin_s = bus.clock.now()
                follower = PoseFollower(RestingTracker(bus.clock, spoil), NO_MOTION, begin_s)
                pacer, actions = Pacer(HZ, bus.clock), ActionFilter(HAND, ReorientCfg())
                if spoil == "lost":  # beyond the workspace
                    place = np.array([0.5, 0.0, 0.0, *GOAL])
                    follower = PoseFollower(RestingTracker(bus.clock, ""), place, begin_s)
                loop = ControlLoop(
                    safe, runner, actions, pacer, log, episode_s=4.0, hold_s=0.0, follower=follower
                )
                return loop.run([GOAL])

        if not spoil:
            assert run() == ["time limit"]
        elif spoil == "lost":
            assert run() == ["lost"]
        else:
            with pytest.raises(StoppedError, match=said):
                run()
        assert not energised(line)
    log.finish("done")
    told = [state for state in runner.told if state is not None]
    assert all(np.allclose(state[:3], told[0][:3]) for state in told)
    if not spoil:
        found = read_log(log.folder)
        assert len(told) > 30 and np.isfinite(found.columns["found.x"][-10:]).all()


def test_datagrams_are_poses_on_this_computers_clock_and_what_is_none_is_named():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    source = UdpPoses("127.0.0.1", port)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(data):
        text = data if isinstance(data, bytes) else json.dumps(data).encode()
        sender.sendto(text, ("127.0.0.1", port))

    try:
        assert source.read() is None
        with pytest.raises(PoseSourceError, match=f"127.0.0.1, port {port}"):
            UdpPoses("127.0.0.1", port)
        pose = {"position": [0.1, 0.2, 0.3], "quaternion": [0.0, 0.0, 0.6, 0.8]}
        now = time.time()
        for age_s in (0.2, 0.05, 0.4):  # the newest counts, in whatever order they come
            send({"stamp": now - age_s, **pose})
        read = source.read()
        np.testing.assert_allclose(read.pose, [0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8])
        assert 0.04 < time.monotonic() - read.time_s < 1.0
        for wrong, said in (
            (b"\xff{", "no pose: .* send a JSON object with position, quaternion, stamp"),
            ({"stamp": now, "position": [0.1, 0.2, 0.3]}, "no pose"),
            ({"stamp": now, **pose, "position": [0.1, None, 0.3]}, "position is .*metres"),
            (
                {"stamp": now, **pose, "quaternion": [0.0, 0.0, 0.0, 0.5]},
                "quaternion is .*length 1",
            ),
        ):
            send(wrong)
            with pytest.raises(PoseSourceError, match=f"udp:{port}: {said}"):
                source.read()
    finally:
        source.close()
        sender.close()


def test_poses_of_a_topic_have_the_time_of_their_stamp(monkeypatch):
    for name in ("rclpy", "rclpy.qos", "geometry_msgs", "geometry_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    node = MagicMock(resolve_topic_name=lambda topic: topic)
    source = RosPoses(node, "/cube/pose")
    take = node.create_subscription.call_args.args[2]
    assert source.name == "ros2:/cube/pose" and source.read() is None
    ns = time.time_ns() - 80_000_000
    place, turn = Message(x=0.1, y=0.2, z=0.3), Message(x=0.0, y=0.0, z=1.0, w=0.0)

    def message(sec, turn):
        stamp = Message(sec=sec, nanosec=ns % 10**9)
        pose = Message(position=place, orientation=turn)
        return Message(header=Message(stamp=stamp), pose=pose)

    take(message(ns // 10**9, turn))
    read = source.read()
    np.testing.assert_allclose(read.pose, [0.1, 0.2, 0.3, 0.0, 0.0, 1.0, 0.0])
    assert 0.07 < time.monotonic() - read.time_s < 1.0
    take(message(0, turn))
    with pytest.raises(PoseSourceError, match="ros2:/cube/pose: "):
        source.read()
    take(message(ns // 10**9, Message(x=0.0, y=0.0, z=0.0, w=0.0)))
    with pytest.raises(PoseSourceError, match=r"quaternion is .* length 1"):
        source.read()
    source.close()
    node.destroy_subscription.assert_called_once()


def test_a_twins_truth_comes_late_and_with_noise():
    now, state = [10.0], np.array([0.0, 0.0, 0.1, *GOAL, *np.zeros(6)])
    cfg = TruthCfg(delay_s=0.1, noise_m=0.002, noise_rad=0.05)
    source = TwinPoses(lambda: state, cfg, now=lambda: now[0])
    assert source.read() is None, "nothing is old enough"
    places, turns = [], []
    for step in range(1, 400):
        now[0] = 10.0 + step / HZ
        read = source.read()
        if read is None:
            continue
        assert 0.1 <= now[0] - read.time_s < 0.1 + 1.0 / HZ + 1e-9
        places.append(read.pose[:3])
        turns.append(Rotation.from_quat(read.pose[3:]).as_rotvec())
    np.testing.assert_allclose(np.std(places, axis=0), 0.002, rtol=0.15)
    np.testing.assert_allclose(np.std(turns, axis=0), 0.05, rtol=0.15)


def test_the_preflight_tells_rate_age_and_place_and_what_is_wrong(monkeypatch):
    clock = SimulatedClock()
    tracker = RestingTracker(clock, "")
    fine = list(pose_findings(tracker, NO_MOTION, HAND, 0.5, clock=clock))
    assert [one.ok for one in fine] == [True, True]
    assert "20 a second from told" in fine[0].words and "0 cm from" in fine[1].words
    silent = list(pose_findings(ToldPoses("no tag is seen"), NO_MOTION, HAND, 0.5, clock=clock))
    assert [one.ok for one in silent] == [False]
    assert "within 5 s: no tag" in silent[0].words
    for spoil, oldest_s, said in (
        ("future", 0.5, "from the future: wait .*stamp them when"),
        ("", 0.01, r"0\.0\d s old: stamp them by this computer's clock"),
    ):
        spoilt = list(
            pose_findings(RestingTracker(clock, spoil), NO_MOTION, HAND, oldest_s, clock=clock)
        )
        assert not spoilt[0].ok
        assert re.search(said, spoilt[0].words)
    monkeypatch.setattr(check_pose, "FEWEST_HZ", 30.0)
    slow = next(pose_findings(RestingTracker(clock, ""), NO_MOTION, HAND, 0.5, clock=clock))
    assert not slow.ok and ", not 30" in slow.words


def test_a_teacher_that_knows_no_pose_holds_still():
    runner = load_runner("dclaw3", "dclaw3", HAND, load_set("cube")[0], object="cube")
    still = np.zeros(9)
    unknown = runner.decide(Sensed(HAND.start, still, still, GOAL))
    assert not unknown.action.any() and np.isnan(unknown.distance)
    state = np.array([*HAND.workspace.goal_m, 0.0, 0.0, 0.6, 0.8, *np.zeros(6)])
    known = runner.decide(Sensed(HAND.start, still, still, GOAL, object_state=state))
    assert known.action.any() and np.isfinite(known.distance)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--pose radar --port /dev/null", "--pose radar: give ros2:/TOPIC, udp:PORT"),
        ("--pose udp:no --port /dev/null", "--pose udp:no: .*give ros2:/TOPIC, udp:PORT"),
        ("--pose sim:late=1 --twin", "has no field late"),
        ("--pose sim --port /dev/null", "--pose sim is the truth of a twin; add --twin"),
        ("--pose-frame 0 0 0 0 0 0 1 --twin", "--pose-frame places the poses of --pose"),
        ("--pose ros2:/pose --twin", "--pose ros2 needs rclpy: source the setup.bash"),
        ("--pose tags --object a.ply --port /dev/null", "a teacher does not know a scan"),
        ("--pose tags --twin --camera-layer gone.usda", "gone.usda: no camera layer"),
        ("--twin --camera-layer gone.usda", "gone.usda: no camera layer"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(
    flags, said, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vd.deploy.loop.run.connect", None)
    (tmp_path / "a.ply").write_text("ply")
    assert cli.main(["dclaw3", "--hand", "dclaw3", *flags.split()]) == 1
    assert re.search(said, capsys.readouterr().err)


def test_frames_are_those_that_are_named_or_the_cameras():
    assert pose_options("udp:5005").host == "127.0.0.1"
    assert pose_options("udp:0.0.0.0:5005").host == "0.0.0.0"
    assert pose_options("tags").size_m == 0.07 and pose_options("tags:0.06").size_m == 0.06
    camera = np.concatenate([HAND.camera.position, HAND.camera.quaternion])
    np.testing.assert_array_equal(source_frame(HAND, None, None), camera)
    named = source_frame(HAND, (1, 2, 3, 0, 0, 3, 4), None)
    np.testing.assert_allclose(named, [1, 2, 3, 0, 0, 0.6, 0.8])
    with pytest.raises(ValueError, match="position and a quaternion"):
        source_frame(HAND, (0,) * 7, None)


def test_a_camera_that_shows_no_tags_says_why():
    pytest.importorskip("cv2", reason="needs the extra `hardware`")
    from vd.deploy.pose.rendered import render_cube
    from vd.deploy.pose.tags import TagPoses

    lens = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
    pose = np.array([0.0, 0.0, 0.3, *Rotation.from_rotvec([0.5, 0.4, 0.3]).as_quat()])
    cube = render_cube(pose, lens, 0.07).astype(np.uint8)
    grey = np.full((240, 320), 90, np.uint8)
    shown = iter([Frame(grey, 1.0), Frame(cube, 1.1), None, Frame(grey, 1.2)])

    def read(_):
        frame = next(shown)
        if frame is None:
            raise StaleCamera("no image in time")
        return frame

    source = TagPoses(Message(intrinsics=lens, read=read, close=lambda: None))
    for time_s, trouble in (
        (None, "no tag of the cube is seen"),
        (1.1, ""),
        (1.1, "no image in time"),
        (1.1, "no tag of the cube is seen"),
    ):
        source.look()
        newest = source.read()
        assert (None if newest is None else newest.time_s) == time_s
        assert source.trouble.startswith(trouble) and bool(source.trouble) == bool(trouble)
