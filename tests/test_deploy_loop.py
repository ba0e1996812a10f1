"""The control loop: its clock, how goals end, what is logged, and the whole of it on a twin."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from simulated_clock import SimulatedClock

from vd.assets_usd.hands import load_hand
from vd.deploy import cli
from vd.deploy.camera.camera import Frame
from vd.deploy.clock import Pacer
from vd.deploy.hardware.answers import HandState
from vd.deploy.hardware.joints import read_joints
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.log import LogWriter
from vd.deploy.loop.loop import ControlLoop, summary
from vd.deploy.loop.policy_runner import CameraRunner, PolicyDecision, PolicyRunner
from vd.deploy.loop.run_page import FILM_FILE, PAGE_FILE, goal_results, summary_line
from vd.deploy.safety.safety import SafeHand, StoppedError
from vd.envs.cfg import ReorientCfg
from vd.logs.hand_log import read_log
from vd.paper import PAPER
from vd.policy.stopping import StoppingRule

HZ = PAPER.scene.control_hz
GOAL = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass
class Hand:
    """Joints that are at once where they are told to be; each exchange takes ``work`` seconds."""

    hand = load_hand("dclaw3")
    clock: SimulatedClock
    work: list[float] = field(default_factory=list)
    position: np.ndarray = field(default_factory=lambda: np.tile([0.0, 0.8, -1.1], 3))
    missed: list[bool] = field(default_factory=list)

    def read(self) -> HandState:
        """As :class:`SafeHand`."""
        zero = np.zeros(9)
        now, here = self.clock.now(), self.position.copy()
        return HandState(now, here, zero, zero, zero, zero + 12.0, zero + 30.0, zero > 0.0, zero)

    def command(self, target: np.ndarray) -> np.ndarray:
        """As :class:`SafeHand`."""
        self.clock.sleep(self.work.pop(0) if self.work else 0.01)
        self.position = np.asarray(target)
        return self.position

    def beat(self, *, missed: bool) -> None:
        """As :class:`SafeHand`."""
        self.missed.append(missed)

    def image_at(self, time_s: float, fault: str = "") -> None:
        """As :class:`SafeHand`."""


@dataclass
class LateCamera:
    """Images that are 40 ms old when they come, after a wait of 5 ms."""

    clock: SimulatedClock

    def read(self, _timeout_s: float) -> Frame:
        """As :class:`ImageSource`."""
        self.clock.sleep(0.005)
        return Frame(np.zeros((2, 2), np.float32), self.clock.now() - 0.04)


class Countdown(PolicyRunner):
    """A policy whose predicted distance falls by 0.1 rad a step from ``start``.

    Its first look takes long.
    """

    def __init__(self, clock: SimulatedClock, start: float = 1.0):
        super().__init__(ReorientCfg(), StoppingRule(0.35, 2.0))
        self.clock, self.start, self.look_s = clock, start, 4.0 / HZ

    def begin(self) -> None:
        """Nothing is known."""
        self.distance, self.begun, self.decided = self.start, 0, 0

    def new_goal(self) -> None:
        """From the start again."""
        self.distance, self.begun, self.decided = self.start, self.begun + 1, 0

    def decide(self, sensed) -> PolicyDecision:
        """A tenth nearer."""
        if not self.begun:
            self.clock.sleep(self.look_s)
        self.decided += 1
        self.distance -= 0.1
        return PolicyDecision(np.full(9, 0.1), self.distance)


@pytest.fixture
def parts(tmp_path):
    clock = SimulatedClock()
    hand = load_hand("dclaw3")
    log = LogWriter(
        tmp_path / "log", hand, {"goals": [list(GOAL)] * 2}, servo={}, truth=True, clock=clock
    )
    actions = ActionFilter(hand, ReorientCfg())
    return Hand(clock), Countdown(clock), actions, Pacer(HZ, clock), log


@dataclass
class Truth:
    """An object that lies still, somewhere."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.03)
    quat: tuple[float, ...] = tuple(GOAL)

    def object_state(self) -> np.ndarray:
        """Where it lies."""
        return np.array([*self.position, *self.quat, *np.zeros(6)])


def test_the_grid_stays_where_it_was_whatever_is_late():
    clock = SimulatedClock()
    pacer = Pacer(10.0, clock)
    assert pacer.wait() == 0.0 and pacer.due_s == 100.0
    clock.sleep(0.03)
    assert not pacer.end()
    assert pacer.wait() == pytest.approx(0.0) and pacer.due_s == pytest.approx(100.1)
    clock.sleep(0.25)  # two deadlines pass
    assert pacer.end() and pacer.missed == 2
    assert pacer.wait() == pytest.approx(0.05) and pacer.due_s == pytest.approx(100.3)
    clock.sleep(0.01)
    assert not pacer.end() and pacer.missed == 2
    assert pacer.wait() == pytest.approx(0.0) and pacer.due_s == pytest.approx(100.4)


def test_it_acts_until_the_policy_has_arrived_then_holds_and_goes_on(parts):
    hand, runner, actions, pacer, log = parts
    loop = ControlLoop(hand, runner, actions, pacer, log, episode_s=10.0, hold_s=0.5, twin=Truth())
    assert loop.run([GOAL, GOAL]) == ["stopped", "stopped"]
    log.finish("done")
    read = read_log(log.folder)
    assert runner.begun == 2 and pacer.missed == 0 and loop.times[0].late_s == 0.0
    # From 1.0 in steps of 0.1 below 0.35: the seventh decision stops, so six actions are taken.
    acting, number = read.columns["acting"], read.columns["goal"]
    look = int(np.argmax(acting))
    assert acting[number == 0].sum() == 7 and (acting == 0).sum() == look + 2 * 6
    moved = np.abs(np.diff(read.channel("command")[:, 0])) > 1e-6
    assert moved[look:][:5].all() and not moved[look:][6:12].any()
    # The action filter: alpha a + (1 - alpha) before, zero again for the second goal.
    smoothed = read.channel("smoothed")[look:, 0]
    alpha = PAPER.action.ema_alpha
    assert smoothed[1] == pytest.approx(alpha * 0.1, abs=1e-6)
    assert smoothed[2] == pytest.approx(alpha * 0.1 + (1 - alpha) * alpha * 0.1, abs=1e-6)
    second = np.flatnonzero(number[look:] == 1)[0]
    assert smoothed[second] == 0.0
    assert [stop.outcome for stop in read.stops] == ["stopped", "stopped"]
    assert read.stops[0].distance == pytest.approx(0.3)
    assert np.diff(read.columns["t"]) == pytest.approx(np.full(len(acting) - 1, 1.0 / HZ), abs=1e-5)
    np.testing.assert_allclose(read.columns["error"], 0.0, atol=1e-6)


@pytest.fixture
def looped(parts):
    """A hand on a simulated line whose loop runs a policy that decides by a function."""
    pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")
    from simulated_hand import energised, simulated_bus

    _, _, actions, _, log = parts
    joints = read_joints(load_hand("dclaw3"))

    def run(decide) -> tuple[list[int], list[str]]:
        said: list[str] = []
        with simulated_bus(joints.hand, joints) as (line, bus):
            line.plant.position[:] = joints.hand.start
            bus.clock.sleep(0.01)
            runner = Countdown(bus.clock, start=99.0)
            runner.decide = lambda sensed: decide(bus.clock, line)
            with SafeHand(bus, joints, say=said.append) as safe:
                safe.arm()
                pacer = Pacer(HZ, bus.clock)
                loop = ControlLoop(safe, runner, actions, pacer, log, episode_s=3.0, twin=Truth())
                loop.run([GOAL])
        return energised(line), said

    return run


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_action_that_is_not_finite_stops_the_hand(looped, value):
    """The filter would make a limit of it, to which joints are driven and pressed."""
    where = []

    def decide(clock, line):
        where.append((line.motors, line.plant.position.copy()))
        action = np.zeros(9)
        action[4] = value if len(where) > 5 else 0.0
        return PolicyDecision(action, 9.0)

    with pytest.raises(ValueError, match="action is not finite"):
        looped(decide)
    motors, last = where[-1]
    assert not any(motor.get("torque_enable") for motor in motors) and len(where) == 6
    np.testing.assert_allclose(last, where[0][1], atol=0.01)


def test_a_policy_that_hangs_is_stopped_and_it_is_said(looped):
    states = []

    def decide(clock, line):
        if len(states) == 3:
            clock.sleep(5.0)
        states.append(sum(motor.get("torque_enable") for motor in line.motors))
        return PolicyDecision(np.zeros(9), 9.0)

    with pytest.raises(StoppedError, match="the loop stands"):
        looped(decide)
    assert states == [9, 9, 9, 0], "it hung with its torque on"


def test_a_first_look_that_does_not_end_is_stopped(looped):
    def decide(clock, line):
        clock.sleep(60.0)
        return PolicyDecision(np.zeros(9), 9.0)

    with pytest.raises(StoppedError, match="not decided for 10 s"):
        looped(decide)


def test_the_hand_is_held_while_the_first_look_takes_longer_than_a_step_may(parts):
    """0.33 s: longer than images may be old, steps late, and the motors without a word."""
    pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")
    from simulated_hand import push, simulated_bus

    _, _, actions, _, log = parts
    hand = load_hand("dclaw3")
    joints = read_joints(hand)
    with simulated_bus(hand, joints) as (line, bus), SafeHand(bus, joints) as safe:
        line.plant.position[:] = joints.to_motor(hand.start)
        safe.arm()
        camera, runner = LateCamera(bus.clock), Countdown(bus.clock)
        loop = ControlLoop(
            safe,
            runner,
            actions,
            Pacer(HZ, bus.clock),
            log,
            hold_s=0.0,
            camera=camera,
            twin=Truth(),
        )
        assert loop.run([GOAL]) == ["stopped"] and loop.times[-1].late_s < 0.01
        assert push(line).any()
    log.finish("done")
    read = read_log(log.folder)
    held = read.columns["acting"] == 0.0
    assert held.tolist() == [True] * 5 + [False] * 7
    np.testing.assert_allclose(
        read.channel("command")[held], hand.start.astype(float)[None].repeat(5, 0)
    )


@pytest.mark.parametrize(
    ("often", "rarely", "ended"), [(50, 50, "time limit"), (512, 60, "lost"), (0, 0, "lost")]
)
def test_an_object_that_the_camera_sees_no_more_is_lost(parts, often, rarely, ended):
    """For a second, in which it may be behind a finger; of a thin one little is seen at all times."""
    hand, runner, actions, pacer, log = parts
    runner.start, runner.look_s, decide = 9.0, 0.0, runner.decide
    shown = iter([often] * 12 + ([rarely] * 11 + [often]) * 2 + [rarely] * 30)
    runner.decide = lambda sensed: replace(decide(sensed), voxels=next(shown))
    runner.camera = hand.hand.camera
    loop = ControlLoop(hand, runner, actions, pacer, log, episode_s=5.0, hold_s=0.0)
    assert loop.run([GOAL]) == [ended]
    lost_at = {"lost": 12 if not often else 47, "time limit": 60}[ended]
    assert len(loop.times) == pytest.approx(lost_at, abs=1)


@dataclass
class SpoiltCamera:
    """Images of a wall with a little noise, and after a second what has become of them."""

    clock: SimulatedClock
    spoil: Callable[[np.ndarray], np.ndarray]
    last: np.ndarray = field(default_factory=lambda: np.zeros((180, 320), np.float32))
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    images: int = 0

    def read(self, _timeout_s: float) -> Frame:
        """As :class:`ImageSource`: each image is new by its time."""
        self.clock.sleep(0.005)
        self.images += 1
        wall = self.rng.normal(0.6, 0.002, self.last.shape).astype(np.float32)
        if self.images <= round(HZ):
            self.last = wall
            return Frame(wall, self.clock.now())
        return Frame(self.spoil(self.last.copy()), self.clock.now())


def with_noise(image: np.ndarray, noise_m: float = 0.03) -> np.ndarray:
    """What a camera sends that finds wrong disparities: depth everywhere, and nowhere right."""
    noise = np.random.default_rng().normal(0.0, noise_m, image.shape)
    return (image + noise).astype(np.float32)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (np.zeros_like, "0 % of the pixels around the object's place show a surface, not 25"),
        (lambda image: np.full_like(image, 65.535), "0 % of the pixels around"),
        (with_noise, r"\d+ % of the pixels around"),
        (lambda image: image, "the same image comes again and again, though the hand moves"),
        (lambda image: with_noise(image, 0.001), ""),
    ],
    ids=["black", "saturated", "noisy", "frozen", "sound"],
)
def test_a_camera_that_goes_blind_stops_the_hand(parts, spoil, said):
    """However new its images are by their times; with one that sees it goes on."""
    pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")
    from simulated_hand import simulated_bus

    _, _, actions, _, log = parts
    hand = load_hand("dclaw3")
    joints = read_joints(hand)
    with simulated_bus(hand, joints) as (line, bus), SafeHand(bus, joints) as safe:
        line.plant.position[:] = joints.to_motor(hand.start)
        safe.arm()
        camera = SpoiltCamera(bus.clock, spoil)
        runner = Countdown(bus.clock, 9.0)
        runner.camera, pacer = hand.camera, Pacer(HZ, bus.clock)
        loop = ControlLoop(safe, runner, actions, pacer, log, episode_s=3.0, camera=camera)
        if not said:
            assert loop.run([GOAL]) == ["time limit"]
            return
        with pytest.raises(StoppedError, match=rf"camera is blind .*{said}"):
            loop.run([GOAL])
        assert camera.images <= round(HZ) + 8


@pytest.mark.parametrize(
    ("turned", "limit_s", "said"),
    [
        (0.0, 10.0, "goal 1: reached: stopped after 0.5 s, 0.00 rad from it, predicted 0.30"),
        (1.0, 10.0, "goal 1: not reached: stopped after 0.5 s, 1.00 rad from it, predicted 0.30"),
        (
            0.0,
            0.25,
            "goal 1: not reached: time limit after 0.2 s, 0.00 rad from it, predicted 0.70",
        ),
        (None, 10.0, "goal 1: error not known: stopped after 0.5 s, predicted 0.30"),
    ],
)
def test_what_came_of_each_goal_is_told(parts, turned, limit_s, said):
    """By the truth, not by what the policy says: only a goal at which it stopped is reached."""
    hand, runner, actions, pacer, log = parts
    quat = np.array([0.0, 0.0, np.sin(0.5 * (turned or 0.0)), np.cos(0.5 * (turned or 0.0))])
    truth = None if turned is None else Truth(quat=tuple(quat))
    if truth is None:
        log = LogWriter(
            log.folder / "real", load_hand("dclaw3"), log.run, servo={}, clock=hand.clock
        )
    ControlLoop(hand, runner, actions, pacer, log, episode_s=limit_s, hold_s=0.2, twin=truth).run(
        [GOAL]
    )
    log.finish("done")
    results = goal_results(read_log(log.folder))
    assert [str(one) for one in results] == [said]
    expected = (
        "1 of 2 goals stopped"
        if turned is None
        else f"{int(': reached' in said)} of 2 goals reached"
    )
    assert summary_line(results, 2).startswith(expected)


def test_a_goal_that_is_not_reached_ends_by_its_time_and_a_lost_object_the_run(parts):
    hand, runner, actions, pacer, log = parts
    runner.start = 9.0
    loop = ControlLoop(hand, runner, actions, pacer, log, episode_s=1.0, hold_s=0.0, twin=Truth())
    assert loop.run([GOAL]) == ["time limit"]
    assert runner.decided == 12
    away = Truth((0.3, 0.0, 0.03))
    lost = ControlLoop(hand, runner, actions, pacer, log, episode_s=1.0, hold_s=0.0, twin=away)
    assert lost.run([GOAL, GOAL]) == ["lost"]


def test_there_is_nothing_to_stop_before_the_first_action(parts):
    hand, runner, actions, pacer, log = parts
    runner.start = 0.1
    loop = ControlLoop(hand, runner, actions, pacer, log, hold_s=0.0)
    assert loop.run([GOAL]) == ["stopped"]
    assert runner.decided == 2


def test_one_long_step_makes_no_other_late():
    """Of steps that take two thirds of a period, one of 130 ms would make the two after it late."""
    for latest, missed in ((1.0, [False, True, True, False]), (0.25, [False, True, False, False])):
        clock = SimulatedClock()
        pacer = Pacer(HZ, clock, latest=latest)
        found = []
        for work_s in (0.055, 0.13, 0.055, 0.055):
            pacer.wait()
            clock.sleep(work_s)
            found.append(pacer.end())
        assert found == missed


def test_missed_deadlines_are_counted_and_told(parts):
    hand, runner, actions, pacer, log = parts
    hand.work = [0.01, 0.01, 0.1, 0.01]
    runner.start, runner.look_s = 9.0, 0.0
    loop = ControlLoop(hand, runner, actions, pacer, log, episode_s=0.5, hold_s=0.0)
    loop.run([GOAL])
    assert hand.missed == [False, False, True, False, False, False] and pacer.missed == 1
    assert loop.times[2].sent_s == pytest.approx(0.1) and loop.times[3].late_s == pytest.approx(
        0.1 - 1 / HZ
    )


def test_latency_is_told_as_training_draws_it(parts):
    hand, runner, actions, pacer, log = parts
    hand.work, camera = [0.02] * 9, LateCamera(hand.clock)
    loop = ControlLoop(hand, runner, actions, pacer, log, hold_s=0.0, camera=camera, twin=Truth())
    loop.run([GOAL])
    log.finish("done")
    found = summary(loop.times)
    # The image, when joints are read.
    assert found["observation_latency_ms"]["median"] == pytest.approx(40.0)
    # From then until goals are sent.
    assert found["command_delay_ms"]["median"] == pytest.approx(20.0)
    np.testing.assert_allclose(read_log(log.folder).columns["image_s"], 0.005 - 0.04, atol=1e-6)
    blind = summary([replace(loop.times[0], image_s=np.nan)])
    assert "observation_latency_ms" not in blind and "command_delay_ms" in blind


@pytest.fixture
def patient() -> list[str]:
    """Flags for a machine with other work: late steps are not for the safety."""
    return ["--safety.misses", "1000", "--safety.lost-s", "30", "--safety.watchdog-s", "2.5"]


def driven(flags: list[str], capsys) -> tuple[int, str, str]:
    """Status and output of vd-deploy; where this machine is too busy the test is skipped."""
    pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")
    status, (out, words) = cli.main(flags), capsys.readouterr()
    if "loop rate" in words or "asked again" in words:
        pytest.skip(f"this machine is too busy: {words.splitlines()[-1]}")
    return status, out, words


@pytest.mark.slow
def test_the_installed_policy_drives_a_twin(tmp_path, capsys, patient):
    """Everything but a real hand: the process of the twin, its bus, limits, policy, log."""
    folder = tmp_path / "log"
    flags = [
        "--hand",
        "dclaw3",
        "--twin",
        "--episode-s",
        "2",
        "--hold-s",
        "0.2",
        "--log",
        str(folder),
    ]
    # The second 2 rad away, so that it takes a while.
    goals = [
        "--goal",
        "0,0,0,1",
        "0,0,0.84147,0.5403",
    ]
    status, out, words = driven([*flags, *patient, *goals], capsys)
    assert status == 0, words
    log = read_log(folder)
    assert log.run["kind"] == "vision" and log.run["end"]["reason"] == "all goals pursued"
    assert [stop.goal for stop in log.stops] == [0, 1]
    steps = len(log.columns["t"])
    assert log.run["end"]["steps"] == steps >= 10
    # Goals are sent from where the joints are, and the joints follow.
    step = PAPER.action.scale_rad_s / HZ
    assert np.abs(log.channel("command") - log.channel("position")).max() < step + 0.3
    assert np.isfinite(log.object_pose).all() and log.object_pose[:, 2].max() < 0.2
    assert "of 2 goals reached" in out and f"page: {folder / PAGE_FILE}" in out
    assert (
        "<video" in (folder / PAGE_FILE).read_text() and (folder / FILM_FILE).stat().st_size > 1000
    )


@pytest.mark.slow
def test_a_camera_policy_drives_a_twin_and_a_fault_leaves_the_page(
    tmp_path, capsys, patient, monkeypatch
):
    folder = tmp_path / "log"
    decide, seen = CameraRunner.decide, []

    def until_hot(runner, sensed):
        seen.append(sensed.depth)
        if len(seen) > 10:
            raise StoppedError("f0_j0, motor 10: 81 deg C, over 70")
        return decide(runner, sensed)

    monkeypatch.setattr(CameraRunner, "decide", until_hot)
    flags = ["dclaw4-vision", "--hand", "dclaw4", "--twin", "--goal", "0,0,0.84147,0.5403"]
    status, out, words = driven([*flags, *patient, "--log", str(folder)], capsys)
    assert status == 1 and "81 deg C" in words
    assert all(image.shape == (180, 320) and (image > 0.0).mean() > 0.5 for image in seen)
    assert read_log(folder).run["kind"] == "vision"
    assert "goal 1: not reached" in out
    page = (folder / PAGE_FILE).read_text()
    assert "aborted" in page and (folder / FILM_FILE).stat().st_size > 1000
    assert "81 deg C, over 70" in page and "torque of every motor is off" in page


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        ("--hand dclaw3 --port /dev/none dclaw3", "no robot senses. Tell it by --pose"),
        (
            "--hand dclaw4 --twin dclaw3-vision",
            "was trained for dclaw3 (9 motors), not for dclaw4 (12)",
        ),
        ("--hand dclaw3 --port /dev/none", "/dev/none: there is no such device"),
        ("--hand dclaw3 --twin zero --goal 1,2,3", "give a quaternion"),
    ],
)
def test_what_cannot_be_run_is_refused(flags, error, capsys):
    assert cli.main(flags.split()) == 1
    assert error in capsys.readouterr().err
