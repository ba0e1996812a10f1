"""Drive a hand with a policy.

Pursue goals one after the other, in one process at 12 Hz, and log every step.

The policy sees joints and a depth camera: a vision policy or a student. A teacher is told where the
object is: by --pose, or by a twin, which tells the truth. A policy that turns the object without a
goal (leap-spin) senses its joints alone.
"""

import contextlib
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.command.config import require
from vd.command.files import check_folder
from vd.command.line import flags_of, say_same_as
from vd.command.warp_quiet import quiet_warp
from vd.deploy.asking import answer, answered, ask, attended
from vd.deploy.camera.camera import ImageSource
from vd.deploy.camera.realsense import RealSenseCfg
from vd.deploy.finding import Finding
from vd.deploy.hardware.connect import Connection, HandOptions, connect
from vd.deploy.loop.run_page import goal_results, summary_line, write_page
from vd.deploy.safety.limits import SafetyCfg
from vd.deploy.safety.safety import MOVE_S, SafeHand
from vd.deploy.timely import undisturbed
from vd.logs.hand_log import is_log, read_log
from vd.logs.log_format import LogError
from vd.paper import PAPER
from vd.policy.agents import check_names, default_policy

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from vd.assets_usd.hand_model import HandModel
    from vd.assets_usd.objects.model import ObjectModel
    from vd.deploy.loop.log import LogWriter
    from vd.deploy.loop.policy_runner import PolicyRunner
    from vd.deploy.pose.source import PoseSource
    from vd.deploy.twin.twin import Twin

LOGS = Path("runs/deploy")
"""Folder of the logs that are not named."""
HOME_RAD_S = 0.5
"""Speed of the way to the start [rad/s]."""
SETTLE_S = 1.5
"""Time that an object of a twin has to come to rest between the fingers [s]."""
LATEST = 0.25
"""Share of a control period by which a step may begin late: to find the object takes much of
one.
"""
WARM_UP = 3
"""Decisions before the hand is switched on: kernels are loaded, allocators have grown."""
FIRST_IMAGE_S = 5.0
"""Longest wait for a camera's first image."""
NO_GOAL = [np.array([0.0, 0.0, 0.0, 1.0])]
"""What is pursued once by a policy that knows no goal."""
GOALS = 3
"""Goals that are drawn where nothing is asked for."""
PLACE = "Put the object between the fingers, then press Enter alone."
DRAWING = "drawing the film (the first one compiles its kernels) ..."


@dataclass(frozen=True)
class DriveCfg(HandOptions):
    """Drive a hand with a policy."""

    policy: Annotated[str | None, tyro.conf.Positional] = None
    """File or name of a policy that sees by camera or senses its joints alone, with --twin or --pose
    a teacher too, by default the hand's installed vision policy. "zero" is the
    zero-action baseline."""
    object: str = "cube"
    """The object: name of a built-in set, its USD, or on a real hand a scan of it (.ply, .obj,
    .glb).
    """
    goal: tuple[str, ...] = ()
    """Orientations of the object to reach, one after the other, in the world frame: quaternions
    x,y,z,w, or turns x,y,z@degrees about an axis."""
    random_goals: int | None = None
    """How many goals to draw in place of --goal, each far from the one before; three by default.
    With --ros2 none are drawn."""
    episode_s: float | None = None
    """Time for each goal [s]; then the next one is pursued. 10 by default, 30 for a policy that
    turns the object without goals."""
    hold_s: float = 1.0
    """How long the hand holds still between goals [s]."""
    precise: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Stop within 0.1 rad rather than 0.4, as the paper's precise variant does: fewer goals,
    nearer.
    """
    camera: RealSenseCfg = field(default_factory=RealSenseCfg)
    """The depth camera."""
    camera_layer: Path | None = None
    """Where it was found to be (camera.usda of vd-deploy calibrate); where it was in training by
    default.
    """
    pose: str | None = None
    """Who tells where the object is, for a policy that observes it (a teacher): ros2:/TOPIC
    (geometry_msgs/PoseStamped), udp:PORT, tags, tags:SIDE_M (a cube of vd-deploy tags before the
    camera), or of a twin sim, sim:delay_s=0.1,noise_m=0.002,noise_rad=0.02."""
    pose_frame: tuple[float, float, float, float, float, float, float] | None = None
    """Pose of the frame that poses are in, in the hand's base: position [m] and quaternion xyzw; by
    default that of the camera, of --camera-layer or the hand."""
    safety: SafetyCfg = field(default_factory=SafetyCfg)
    """Limits."""
    log: Path | None = None
    """Folder of the log; runs/deploy/ and the time by default."""
    ros2: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Drive a hand behind ROS 2 in place of --port. Goals come from a service too
    (vd.deploy.ros).
    """
    ros2_args: str = ""
    """Arguments of ROS: --ros2-args="-r commands:=/forward_position_controller/commands"."""
    seed: int = 0
    """Of drawn goals and of the choice of points."""
    realtime: bool = True
    """Run before all ordinary programs, where that is permitted (root, ulimit -r)."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves; a twin is not asked for."""

    @property
    def tolerance_rad(self) -> float:
        """Largest angle at which a goal is reached [rad]."""
        return PAPER.success.precise_rad if self.precise else PAPER.success.rotation_rad

    @property
    def policy_name(self) -> str:
        """The policy, or the installed one of the hand; one that sees, on a twin a teacher too."""
        kinds: tuple[str, ...] = ("vision",)
        if self.twin:
            kinds = ("vision", "teacher")
        if self.pose is not None:
            kinds = ("teacher",)
        return self.policy or default_policy(self.hand, *kinds)

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        if self.random_goals is not None and (self.ros2 or self.goal):
            raise ValueError("--random-goals is in place of --ros2 and --goal; leave one out")
        check_names([], [self.object], self.hand)
        check_names([self.policy_name], [])
        from vd.deploy.loop.goals import SCAN_SUFFIXES
        from vd.deploy.pose.open import check_pose_options
        from vd.deploy.ros import need_rclpy

        require(self, "--", "positive", "random_goals episode_s")
        require(self, "--", "zero or positive", "hold_s")
        if self.ros2 and (self.twin or self.port):
            raise ValueError("--ros2 is in place of --port and --twin; name one")
        if self.ros2:
            need_rclpy("--ros2")
        if self.pose is not None:
            check_pose_options(self.pose, twin=self.twin)
        elif self.pose_frame is not None:
            raise ValueError("--pose-frame places the poses of --pose; name their source, too")
        if Path(self.object).suffix.lower() in SCAN_SUFFIXES and (self.twin or self.pose):
            who = "a twin cannot hold" if self.twin else "a teacher does not know"
            raise ValueError(f"--object {self.object}: {who} a scan; vd-assets import it first")


def run(cfg: DriveCfg) -> int:
    """Run the policy; 0 if all goals were pursued, 1 if the object was lost.

    Raises:
        StoppedError: A limit or a fault stopped the hand; the page of what it did is written
            before.
    """
    cfg.validate()
    folder = cfg.log or LOGS / datetime.now().strftime("%Y%m%d-%H%M%S")
    check_folder(folder)
    if is_log(folder):
        raise FileExistsError(f"{folder} holds a log; choose another folder")
    from vd.assets_usd.camera_layer import read_camera
    from vd.assets_usd.hands import load_hand
    from vd.deploy.hardware.connect import motors_of
    from vd.deploy.loop.goals import one_object
    from vd.deploy.ros import connect_ros

    quiet_warp()
    hand = load_hand(cfg.hand, layer=cfg.hand_layer) if cfg.ros2 else motors_of(cfg).hand
    item = one_object(cfg.object)
    name = cfg.policy_name
    goals = _goals(cfg, item)
    _say_chosen(cfg, len(goals))
    if cfg.camera_layer is not None:
        read_camera(hand, cfg.camera_layer)  # a wrong one is refused before anything is started
    frame = _pose_frame(cfg, hand)
    runner = _runner(cfg, name, hand, item)
    if runner.spin_axis is not None:
        goals = NO_GOAL
    fault: Exception | None = None
    status = 0
    opened = connect_ros(cfg, cfg.ros2_args) if cfg.ros2 else connect(cfg, item=item)
    with opened as connection:
        try:
            status = _pursue(cfg, name, runner, connection, item, goals, frame, folder)
        except Exception as error:  # the page says why, too
            fault = error
    try:
        log = read_log(folder)
        if not len(log.goals):
            raise LogError(f"{folder} has no goal to show")
    except LogError as error:  # it ended before the first step, or goal
        raise fault or error from None
    filmed = not getattr(fault, "signal", 0)  # who ends it does not wait for a film
    if filmed:
        print(DRAWING, file=sys.stderr, flush=True)
    try:
        print(f"page: {write_page(log, goal_results(log), filmed=filmed)}")
    finally:  # also where there is no page
        if fault is not None:
            raise fault
    return status


def _runner(cfg: DriveCfg, name: str, hand: "HandModel", item: "ObjectModel") -> "PolicyRunner":
    """The policy, with what is known of it."""
    from vd.deploy.loop.policy_runner import load_runner

    tolerance = cfg.tolerance_rad
    known_object = cfg.object if cfg.twin or cfg.pose else None
    runner = load_runner(
        name, cfg.hand, hand, item, tolerance_rad=tolerance, seed=cfg.seed, object=known_object
    )
    if cfg.pose and (runner.camera is not None or runner.spin_axis is not None):
        sees = "by camera" if runner.camera is not None else "its joints alone"
        raise ValueError(f"--pose is for a teacher; {name} sees {sees}: leave it out")
    if "torch" in sys.modules:  # of several threads, some would wait for one that has no core
        sys.modules["torch"].set_num_threads(1)
    if not runner.calibrated:
        print(
            f"{name} has no rule of its own for {tolerance:g} rad: it stops where it predicts "
            "that distance; vd-train tracker finds a better one",
            file=sys.stderr,
        )
    return runner


def _say_chosen(cfg: DriveCfg, goals: int) -> None:
    """Say what a run takes that names no policy."""
    if cfg.policy is None:
        words = (cfg.policy_name, "--hand", cfg.hand, "--object", cfg.object)
        flags = flags_of(cfg, "policy", "hand", "object")
        say_same_as("vd-deploy", *words, *flags, why=f"{goals} goals")


def _goals(cfg: DriveCfg, item: "ObjectModel") -> list[np.ndarray]:
    """What was asked for, or where nothing was, what shows something; with ROS 2 none."""
    from vd.deploy.loop.goals import drawn_goals, make_goals

    if cfg.goal or cfg.ros2:
        return make_goals(cfg.goal)
    return drawn_goals(item.symmetry, cfg.random_goals or GOALS, seed=cfg.seed)


def _pursue(
    cfg: DriveCfg,
    name: str,
    runner: "PolicyRunner",
    connection: Connection,
    item: "ObjectModel",
    goals: list[np.ndarray],
    frame: np.ndarray,
    folder: Path,
) -> int:
    """Preflight, way to the start, the loop, and its log in a folder; the exit status."""
    from vd.deploy.clock import Pacer
    from vd.deploy.hardware.check import ready
    from vd.deploy.loop.action import ActionFilter
    from vd.deploy.loop.loop import NO_SYMMETRY, ControlLoop, summary
    from vd.deploy.pose.check_pose import pose_findings
    from vd.deploy.pose.follower import PoseFollower
    from vd.deploy.ros import RosGoals

    hand = connection.hand
    twin = connection.twin
    hz = runner.task.sim.control_hz
    pose = hand.start
    with contextlib.ExitStack() as stack:
        camera: ImageSource | None = None
        looks: Iterable[Finding] = ()
        if runner.camera is not None:
            camera, looks = _camera(cfg, runner, connection)
            stack.callback(camera.close)
        poses = None
        if cfg.pose is not None:
            poses = stack.enter_context(_poses(cfg, cfg.pose, connection, frame))
            looks = pose_findings(*poses, hand, cfg.safety.pose_stale_s)
        warm_up(runner, pose, [*goals, NO_SYMMETRY[0]][0], camera)
        stack.enter_context(undisturbed(cfg.realtime))
        question = _question(cfg, runner, len(goals))
        ready(connection, question, yes=cfg.yes or cfg.twin, quiet=cfg.twin, more=looks)
        description = _description(cfg, name, runner, item, goals)
        log = _log(cfg, folder, connection, description)
        served = None if connection.ros is None else RosGoals(connection.ros, goals)
        if served is not None:
            log.also_to(served.event)
        pacer = Pacer(hz, latest=LATEST)
        reason = "aborted"
        outcomes = list[str]()
        loop: ControlLoop | None = None
        try:
            # With ROS 2 torque is the driver's.
            safety = replace(cfg.safety, then="hold") if cfg.ros2 else cfg.safety
            with SafeHand(connection.bus, connection.joints, safety, ended=log.stopped) as safe:
                safe.arm()
                safe.move(pose, HOME_RAD_S)
                place(safe, pose, twin, yes=cfg.yes)
                follower = None
                if poses is not None:
                    follower = PoseFollower(*poses, safe.bus.clock.now())
                loop = ControlLoop(
                    safe,
                    runner,
                    ActionFilter(hand, runner.task),
                    pacer,
                    log,
                    episode_s=cfg.episode_s or runner.goal_s,
                    hold_s=cfg.hold_s,
                    camera=camera,
                    twin=twin,
                    follower=follower,
                    symmetry=item.symmetry,
                    more=(lambda: False) if served is None else served.more,
                )
                outcomes = loop.run(goals)
                reason = "lost" if "lost" in outcomes else "all goals pursued"
        except BaseException as error:
            reason = f"{type(error).__name__}: {error}"
            raise
        finally:
            steps = 0 if loop is None else len(loop.times)
            times = summary(loop.times) if loop else {}
            log.finish(reason, outcomes=outcomes, steps=steps, missed=pacer.missed, times=times)
            report(folder, steps, pacer.missed, times)
    return int(reason == "lost")


def _question(cfg: DriveCfg, runner: "PolicyRunner", goals: int) -> str:
    """What the hand is about to do."""
    if runner.spin_axis is not None:
        return "The hand will turn what lies in it."
    return f"The hand will pursue {goals} goals{', and those it is given' * cfg.ros2}."


def _camera(
    cfg: DriveCfg, runner: "PolicyRunner", connection: Connection
) -> tuple[ImageSource, Iterable[Finding]]:
    """The camera, by which the policy sees from now on, and what the preflight finds of it."""
    from vd.assets_usd.camera_layer import read_camera
    from vd.deploy.camera.check_camera import camera_findings
    from vd.deploy.hardware.check import open_camera

    assert runner.camera is not None
    hand = connection.hand
    if connection.twin is None and cfg.camera_layer is None and hand.mounted_camera is None:
        raise ValueError(
            f"{hand.name}'s file does not say where the camera is: --camera-layer (of vd-deploy calibrate)"
        )
    camera = open_camera(cfg.camera, connection, runner.camera)
    where = runner.camera if cfg.camera_layer is None else read_camera(hand, cfg.camera_layer)
    runner.look_by(camera.intrinsics.seen_from(where))
    fps = cfg.camera.fps if connection.twin is None else runner.task.sim.control_hz
    return camera, camera_findings(camera, runner.camera, hand.goal_in_base, fps=fps)


def _log(
    cfg: DriveCfg, folder: Path, connection: Connection, description: Mapping[str, Any]
) -> "LogWriter":
    """The log of a run, with its file beside it."""
    from vd.deploy.loop.log import LogWriter
    from vd.deploy.ros import UNKNOWN

    hand = connection.hand
    servo = connection.joints.servo()
    without = () if connection.ros is None else UNKNOWN
    truth = connection.twin is not None
    return LogWriter(folder, hand, description, servo=servo, truth=truth, without=without)


def _pose_frame(cfg: DriveCfg, hand: "HandModel") -> np.ndarray:
    """Pose of the frame of --pose in the hand's base [7]; a twin's truth needs none."""
    from vd.deploy.pose.open import NO_MOTION, pose_options, source_frame

    if cfg.pose is None or pose_options(cfg.pose).kind == "sim":
        return NO_MOTION
    return source_frame(hand, cfg.pose_frame, cfg.camera_layer)


def _poses(
    cfg: DriveCfg, source: str, connection: Connection, in_base: np.ndarray
) -> "AbstractContextManager[tuple[PoseSource, np.ndarray]]":
    """What --pose names, with the pose of its frame in the world; a twin shows its object."""
    from vd.deploy.pose.open import open_poses

    if connection.twin is not None:
        connection.twin.place_object()
    return open_poses(
        source, connection, cfg.camera, in_base, ros_arguments=cfg.ros2_args, seed=cfg.seed
    )


def warm_up(
    runner: "PolicyRunner", pose: np.ndarray, goal: np.ndarray, camera: ImageSource | None
) -> None:
    """Let the policy decide a few times on what is seen now; the run begins without that.

    The object may not be between the fingers yet.
    """
    from vd.deploy.loop.policy_runner import Sensed

    still = np.zeros_like(pose)
    depth = None if camera is None else camera.read(FIRST_IMAGE_S).image
    for _ in range(WARM_UP):
        runner.decide(Sensed(pose, still, still, goal, depth))


def _description(
    cfg: DriveCfg,
    name: str,
    runner: "PolicyRunner",
    item: "ObjectModel",
    goals: Sequence[np.ndarray],
) -> dict[str, Any]:
    """What a run's log says of it beside its steps."""
    return {
        "policy": name,
        "kind": runner.kind,
        "twin": cfg.twin,
        "object": {"name": item.name, "set": cfg.object},
        "goals": [list(map(float, goal)) for goal in goals],
        "control_hz": runner.task.sim.control_hz,
        "stopping": vars(runner.rule),
        "tolerance_rad": cfg.tolerance_rad,
        "action": vars(runner.task.action),
        "spin_axis": runner.spin_axis,
    }


def place(safe: SafeHand, pose: np.ndarray, twin: "Twin | None", *, yes: bool) -> None:
    """Hold the pose until the object is between the fingers: a person's or the twin's doing.

    Raises:
        StoppedError: The hand was stopped meanwhile.
    """
    asked = twin is None and not yes
    if twin is not None:
        twin.place_object()
    elif asked:
        if not attended():
            raise safe.stop("nobody is there to say that the object is between the fingers")
        ask(PLACE)
    clock = safe.bus.clock
    end = clock.now() + SETTLE_S
    while asked or clock.now() < end:
        safe.read()
        safe.command(pose)
        safe.beat()
        clock.sleep(MOVE_S)
        if not (asked and answered()):
            continue
        line = answer()
        if line is None:
            raise safe.stop("the input has ended: nobody says that the object is in the hand")
        asked = bool(line)
        if asked:
            ask(PLACE)


def report(folder: Path, steps: int, missed: int, times: dict[str, Any]) -> None:
    """Print what came of it, in a few lines."""
    if steps:
        log = read_log(folder)
        results = goal_results(log)
        print("\n".join([*map(str, results), summary_line(results, len(log.goals))]))
    print(f"{steps} control steps, {missed} deadlines missed")
    for name, title in (
        ("late_ms", "began late by"),
        ("observation_latency_ms", "image older than joints by"),
        ("command_delay_ms", "goals sent after joints by"),
        ("sent_ms", "goals sent after"),
        ("cpu_ms", "processor time"),
    ):
        if name in times:
            t = times[name]
            print(f"{title:<26} {t['median']:.1f} ms, 99 % {t['p99']:.1f}, most {t['max']:.1f}")
    print(f"log: {folder}")
