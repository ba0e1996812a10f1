"""Drive a hand with a policy: pursue goals one after the other, in one process at 12 Hz, and log every step.

On a real hand the policy sees joints and a depth camera: a tracking policy, or a student. On a twin
it can be a teacher too; that one reads the simulated object's true pose, which no real hand tells.
"""

import contextlib
import select
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.deploy.camera.camera import DepthSource
from vd.deploy.camera.realsense import RealSenseCfg
from vd.deploy.finding import Finding
from vd.deploy.hardware.connect import Connection, HandOptions, connect
from vd.deploy.hardware.motion import MOVE_S, move, reset_pose
from vd.deploy.hardware.registers import D_GAIN, P_GAIN
from vd.deploy.loop.run_page import goal_results, summary_line, write_page
from vd.deploy.safety.limits import SafetyCfg
from vd.deploy.safety.safety import SafeHand, StoppedError
from vd.deploy.timely import Priority, real_time, undisturbed
from vd.evaluate.agents import check_names
from vd.files import check_folder
from vd.hand_log import LogError, read_log
from vd.paper import PAPER
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.assets_usd.objects.model import ObjectModel
    from vd.deploy.loop.flight import Flight
    from vd.deploy.loop.log import LogWriter
    from vd.deploy.twin.twin_link import TwinLink

LOGS = Path("runs/deploy")
"""Folder of the logs that are not named."""
HOME_RAD_S = 0.5
"""Speed of the way to the start [rad/s]."""
SETTLE_S = 1.5
"""Time that an object of a twin has to come to rest between the fingers [s]."""
LATEST = 0.25
"""Share of a control period by which a step may begin late: to find the object takes much of one."""
STATUS_S = 5.0
"""Seconds between status lines where there is no terminal to rewrite one on."""


@dataclass(frozen=True)
class RunCfg(HandOptions):
    """Drive a hand with a policy."""

    policy: Annotated[str | None, tyro.conf.Positional] = None
    """Bundle, file or name of a policy that sees by camera, or with --twin also of a teacher; with --twin
    the installed teacher of the hand by default. "still" does nothing."""
    object: str = "cube"
    """The object: name of a built-in set, its USD, or on a real hand a scan of it (.ply, .obj, .glb)."""
    goal: tuple[str, ...] = ()
    """Orientations of the object to reach, one after the other, in the world frame: quaternions x,y,z,w,
    turns x,y,z@degrees about an axis, or files (.txt, .csv) with one on each line."""
    random_goals: int = 1
    """How many goals to draw where --goal names none."""
    max_goal_angle: float = np.pi
    """Drawn goals lie within this angle [rad] of the one before."""
    episode_s: float = PAPER.scene.episode_s
    """Time for each goal [s]; then the next one is pursued."""
    hold_s: float = 1.0
    """How long the hand holds still between goals [s]."""
    precise: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Stop within 0.1 rad rather than 0.4, as the paper's precise variant does: fewer goals, nearer."""
    in_air: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Take the twin's table away after 2 s, as the paper's test in the air does."""
    realistic: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Give the twin's depth images the errors of a real camera."""
    sdk: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Take the twin's depth images through the software device of the camera's SDK."""
    camera: RealSenseCfg = field(default_factory=RealSenseCfg)
    """The depth camera."""
    camera_layer: Path | None = None
    """Where it was found to be (camera.usda of vd-deploy calibrate); where it was in training by default."""
    safety: SafetyCfg = field(default_factory=SafetyCfg)
    """Limits."""
    log: Path | None = None
    """Folder of the log; runs/deploy/ and the time by default."""
    images: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep the depth images in the log, 3 MB a second: vd-deploy shadow compares them."""
    seed: int = 0
    """Of drawn goals and of the choice of points."""
    realtime: Priority = "auto"
    """Run before all ordinary programs, the twin too: where that is permitted (root, ulimit -r), always, or
    never."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves; a twin is not asked for."""

    @property
    def tolerance_rad(self) -> float:
        """Largest angle at which a goal is reached [rad]."""
        return PAPER.success.precise_rad if self.precise else PAPER.success.rotation_rad

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        policies = [] if self.policy in (None, "still") else [self.policy]
        check_names(policies, [self.object], self.hand)
        from vd.deploy.loop.goals import SCAN_SUFFIXES

        if self.random_goals < 1:
            raise ValueError("--random-goals has to be at least 1")
        if not self.episode_s > 0.0 or self.hold_s < 0.0:
            raise ValueError("--episode-s has to be positive, and --hold-s must not be negative")
        if (self.in_air or self.realistic or self.sdk) and not self.twin:
            raise ValueError("--in-air, --realistic and --sdk are for --twin")
        if self.twin and Path(self.object).suffix.lower() in SCAN_SUFFIXES:
            raise ValueError(f"--object {self.object}: a twin cannot hold a scan; vd-assets import it first")
        if self.policy is None and not self.twin:
            raise ValueError("name the policy: the folder of a bundle that vd-train bundle wrote")


def run(cfg: RunCfg) -> int:
    """Fly the policy; 0 if all goals were pursued, 1 if the object was lost.

    Raises:
        StoppedError: A limit or a fault stopped the hand; the page of what it did is written before.
    """
    cfg.validate()
    check_folder(cfg.log or LOGS)
    import torch

    from vd.deploy.hardware.connect import read_hand_and_joints
    from vd.deploy.loop.flight import make_flight
    from vd.deploy.loop.goals import one_object
    from vd.deploy.twin.twin_link import TwinLink

    quiet_warp()
    torch.set_num_threads(1)  # of several, some would wait for one that has no core
    hand, _ = read_hand_and_joints(cfg)
    item = one_object(cfg.object)
    flight = make_flight(
        cfg.policy or f"{hand.name}-table",
        cfg.hand,
        cfg.object,
        hand,
        item,
        tolerance_rad=cfg.tolerance_rad,
        seed=cfg.seed,
    )
    if cfg.precise and not flight.calibrated:
        print(
            f"{flight.name} has no rule of its own for {PAPER.success.precise_rad:g} rad: it stops where it "
            "predicts that distance; vd-train tracker finds a better one",
            file=sys.stderr,
        )
    if flight.needs_truth and not cfg.twin:
        raise ValueError(
            f"{cfg.policy} needs the object's true pose, which no real hand tells; give a policy "
            "that sees by a camera"
        )
    folder = cfg.log or LOGS / datetime.now().strftime("%Y%m%d-%H%M%S")
    fault: StoppedError | None = None
    status = 0
    with contextlib.ExitStack() as stack:
        twin_options: list[str] = []
        side = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vd-twin-"))) / "side"
        if cfg.twin:
            camera = flight.camera or hand.camera
            pose = [f"{value:.9g}" for value in (*camera.position, *camera.quaternion)]
            twin_options = ["--object", cfg.object, "--side", str(side), "--camera", *pose]
            twin_options += ["--realistic"] if cfg.realistic else []
            twin_options += ["--realtime", cfg.realtime]
        connection = stack.enter_context(connect(cfg, twin_options))
        link = stack.enter_context(TwinLink(side)) if cfg.twin else None
        try:
            status = _fly(cfg, flight, connection, item, link, folder)
        except StoppedError as error:
            if error.signal:  # who ends it does not wait for a film
                raise
            fault = error
    try:
        log = read_log(folder)
    except LogError as error:  # it ended before the first step
        raise fault or error from None
    print("drawing the film (the first one compiles its kernels) ...", file=sys.stderr, flush=True)
    print(f"page: {write_page(log, goal_results(log))}")
    if fault is not None:
        raise fault
    return status


def _fly(
    cfg: RunCfg,
    flight: "Flight",
    connection: Connection,
    item: "ObjectModel",
    link: "TwinLink | None",
    folder: Path,
) -> int:
    """Preflight, way to the start, the loop, and its log in a folder; the exit status."""
    from vd.deploy.camera.check_camera import camera_findings
    from vd.deploy.camera.eyes import open_camera
    from vd.deploy.clock import Pacer
    from vd.deploy.hardware.check import ready
    from vd.deploy.loop.action import ActionFilter
    from vd.deploy.loop.flight import look, make_goals, warm_up
    from vd.deploy.loop.log import LogWriter
    from vd.deploy.loop.loop import ControlLoop, LoopCfg, summary

    hand = connection.hand
    goals = make_goals(cfg.goal, cfg.random_goals, cfg.max_goal_angle, seed=cfg.seed)
    pose = reset_pose(hand.num_fingers)
    with contextlib.ExitStack() as stack:
        camera: DepthSource | None = None
        seen: Iterable[Finding] = ()
        if flight.camera is not None:
            camera, _ = open_camera(flight.camera, link, cfg.camera, sdk=cfg.sdk)
            stack.callback(camera.close)
            view = look(flight, camera, hand, cfg.camera_layer)
            fps = flight.task.sim.control_hz if cfg.twin else cfg.camera.fps
            seen = camera_findings(camera, view, fps=fps)
        pilot = flight.pilot
        warm_up(pilot, hand, goals[0], camera, link)
        stack.enter_context(undisturbed())
        stack.enter_context(real_time(cfg.realtime))
        question = f"The hand will pursue {len(goals)} goals."
        ready(connection, question, yes=cfg.yes or cfg.twin, quiet=cfg.twin, more=seen)
        log = LogWriter(
            folder,
            hand,
            _description(cfg, flight, item, goals),
            servo={"model": cfg.motor, "p_gain": P_GAIN, "d_gain": D_GAIN},
            truth=link is not None,
        )
        pacer = Pacer(flight.task.sim.control_hz, latest=LATEST)
        reason, outcomes = "aborted", list[str]()
        status = StatusLine()
        loop: ControlLoop | None = None
        try:
            with SafeHand(connection.bus, connection.joints, hand, cfg.safety) as safe:
                safe.arm()
                move(safe, pose, HOME_RAD_S)
                place(safe, pose, link, yes=cfg.yes)
                loop = ControlLoop(
                    safe,
                    pilot,
                    ActionFilter(hand, flight.task),
                    pacer,
                    log,
                    LoopCfg(cfg.episode_s, cfg.hold_s, cfg.images),
                    camera=camera,
                    truth=link,
                    symmetry=item.symmetry,
                    status=status.show,
                )
                if cfg.in_air and link is not None:
                    timer = threading.Timer(PAPER.scene.air_table_s, take_table_away, (link, log))
                    timer.start()
                    stack.callback(timer.cancel)
                outcomes = loop.run(goals)
                reason = "lost" if "lost" in outcomes else "all goals pursued"
        except BaseException as error:
            reason = f"{type(error).__name__}: {error}"
            raise
        finally:
            status.end()
            times = {} if loop is None else summary(loop.times)
            steps = 0 if loop is None else len(loop.times)
            log.finish(reason, outcomes=outcomes, steps=steps, missed=pacer.missed, times=times)
            report(folder, steps, pacer.missed, times)
    return int(reason == "lost")


def _description(
    cfg: RunCfg, flight: "Flight", item: "ObjectModel", goals: Sequence[np.ndarray]
) -> dict[str, Any]:
    """What a run's log says of it beside its steps."""
    return {
        "policy": flight.name,
        "kind": flight.kind,
        "twin": cfg.twin,
        "object": {"name": item.name, "set": cfg.object},
        "goals": [[float(value) for value in goal] for goal in goals],
        "control_hz": flight.task.sim.control_hz,
        "stopping": vars(flight.pilot.rule),
        "tolerance_rad": cfg.tolerance_rad,
        "action": vars(flight.task.action),
    }


def place(safe: SafeHand, pose: np.ndarray, link: "TwinLink | None", *, yes: bool) -> None:
    """Hold the pose until the object is between the fingers: a person's or the twin's doing.

    Raises:
        StoppedError: The hand was stopped meanwhile.
    """
    asked = link is None and not yes and sys.stdin.isatty()
    if link is not None:
        link.place_object((0.0, 0.0, 0.0, 1.0))
    elif asked:
        print("Put the object between the fingers, then press Enter. ", end="", file=sys.stderr, flush=True)
    clock = safe.bus.clock
    end = clock.now() + SETTLE_S
    while clock.now() < end or (asked and not select.select([sys.stdin], [], [], 0.0)[0]):
        safe.read()
        safe.command(pose)
        safe.beat()
        clock.sleep(MOVE_S)
    if asked:
        sys.stdin.readline()


def take_table_away(link: "TwinLink", log: "LogWriter") -> None:
    """Leave the object in the air."""
    link.place_table(present=False)
    log.event("table", present=False)


class StatusLine:
    """One line that is rewritten on a terminal, and now and then a new one elsewhere."""

    def __init__(self) -> None:
        self._live, self._next = sys.stderr.isatty(), 0.0

    def show(self, line: str) -> None:
        """Show a line."""
        if self._live:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
        elif time.monotonic() >= self._next:
            self._next = time.monotonic() + STATUS_S
            print(line, file=sys.stderr, flush=True)

    def end(self) -> None:
        """Leave the line."""
        if self._live:
            print(file=sys.stderr)


def report(folder: Path, steps: int, missed: int, times: dict[str, Any]) -> None:
    """Print what came of it, in a few lines."""
    if steps:
        log = read_log(folder)
        results = goal_results(log)
        print("\n".join([*map(str, results), summary_line(results, len(log.goals))]))
    print(f"{steps} control steps, {missed} deadlines missed")
    for name, title in (
        ("late_ms", "began late by"),
        ("sent_ms", "goals sent after"),
        ("cpu_ms", "processor time"),
    ):
        if name in times:
            t = times[name]
            print(f"{title:<17} {t['median']:.1f} ms, 99 % {t['p99']:.1f}, most {t['max']:.1f}")
    print(f"log: {folder}")
