"""Preflight: everything that must be right before a hand moves.

With --wiggle it moves, after asking.
"""

import contextlib
import itertools
import math
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from vd.assets_usd.hand_data import CameraModel
from vd.deploy.asking import answer, ask, attended
from vd.deploy.camera.realsense import RealSense, RealSenseCfg, find_device
from vd.deploy.finding import Finding, finding, listed, show
from vd.deploy.hardware.answers import BusError, GarbledError, LateError
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.connect import Connection, HandOptions, connect
from vd.deploy.hardware.joints import CalibrationError
from vd.deploy.hardware.registers import RESTART, Register, different, kept
from vd.deploy.safety.limits import PERIOD_S, SafetyCfg, out_of_range
from vd.deploy.safety.safety import SafeHand
from vd.deploy.safety.signals import held
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel
    from vd.deploy.camera.camera import ImageSource
    from vd.deploy.hardware.joints import JointMotors

USB_SERIAL = Path("/sys/bus/usb-serial/devices")
"""Where the kernel tells of adapters of the FTDI kind, the U2D2 among them."""
LATENCY_MS = 1
"""The shortest latency timer. The kernel's 16 ms leave a recording 54 of its 100 samples a second,
and a policy sees every state that much later."""
CYCLES = 24
"""Control cycles whose times are measured: two seconds."""
BUS_SHARE = 0.5
"""Share of a control period that the bus may take; the rest is for camera and network."""
COOL_C = 60.0
"""Temperature [deg C] above which a motor should rest first: it warms by some degrees in use."""
VOLTAGE_SHARE = 0.1
"""Deviation from the supply's nominal voltage that is normal."""
WIGGLE_RAD = math.radians(5.0)
"""How far --wiggle turns each joint: what a person sees, and what nothing is in the way of."""
WIGGLE_RAD_S = 0.1
"""Speed of that."""
BEYOND_M = 1.0
"""Longer than any finger: a turn within the range comes before one beyond it."""
WIGGLES = "Joint by joint will turn by 5 degrees and back, as is told; watch each."
TWIN_OBJECT = "cube"
"""What a twin's camera is shown."""
SIDEWAYS = 0.5
"""Share of a fingertip's way by which it nears what it goes towards."""
TURNED_SHARE = 0.5
"""Share of that by which a joint has to turn."""

Tables = Mapping[int, Mapping[str, int]]
"""Control tables of motors by ID, each by item."""


@dataclass(frozen=True)
class CheckCfg(HandOptions):
    """Look at everything that must be right before the hand moves.

    Without --wiggle nothing is written.
    """

    camera: RealSenseCfg = field(default_factory=RealSenseCfg)
    """The depth camera."""
    camera_layer: Path | None = None
    """Where it was found to be (camera.usda of vd-deploy calibrate); where the hand has it by
    default.
    """
    no_camera: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave the camera out: homing and recording need none."""
    wiggle: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also turn each joint in turn by 5 degrees and back, after asking: a person sees whether it is
    the one that is named, and turns the way that is said."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves."""


def preflight(connection: Connection) -> Iterator[Finding]:
    """Look at motors, registers, state and bus.

    Nothing is written: a motor that holds something goes on to.

    What could not be looked at because of what came before is not in the findings.
    """
    bus = connection.bus
    if connection.ros is not None:
        yield from bus.findings()  # type: ignore[attr-defined]
        return
    try:
        if isinstance(bus, MotorBus):
            yield from adapter_findings(bus.port)
            tables, wrong = _read_tables(bus)
            yield finding("motors answer", wrong, f"all {len(bus.ids)}")
            if wrong:
                return
            errors = bus.hardware_errors().items()
            mend = [f"motor {id}: {why}; mend it, then {RESTART}" for id, why in errors]
            yield finding("no hardware error", mend, "none")
            yield from register_findings(connection.joints, tables)
            yield Finding("torque", True, _holding(bus) or "off")
        yield from _state_findings(connection)
        if isinstance(bus, MotorBus):
            yield _cycles(bus)
    except BusError as error:
        yield Finding("bus", False, str(error))


def adapter_findings(port: str) -> Iterator[Finding]:
    """Whether the USB adapter passes answers on at once; nothing of one that has no latency timer.

    Args:
        port: Device, or a link to it.
    """
    timer = USB_SERIAL / Path(port).resolve().name / "latency_timer"
    try:
        latency = int(timer.read_text())
    except (OSError, ValueError):
        return
    right = latency <= LATENCY_MS
    remedy = f", which keeps answers that long: echo {LATENCY_MS} | sudo tee {timer}"
    yield Finding("USB latency timer", right, f"{latency} ms" + ("" if right else remedy))


def _read_tables(bus: MotorBus) -> tuple[dict[int, dict[str, int]], list[str]]:
    """Control tables of the motors, and what is wrong with those that do not tell theirs."""
    missing = bus.missing()
    wrong = list(missing.values())
    if missing:
        strangers = sorted(set(bus.ping_all()) - set(bus.ids))
        if strangers:
            ids = ", ".join(map(str, strangers))
            wrong.insert(0, f"ID {ids} answers, and is none of the hand's")
    tables = {}
    for id in bus.ids:
        if id in missing:
            continue
        try:
            tables[id] = bus.read_table(id)
        except (GarbledError, LateError) as error:
            wrong.append(str(error))
        except BusError:
            wrong.append(
                f"motor {id} answers pings, but no reads: its status_return_level is 0; {RESTART}"
            )
    return tables, wrong


def register_findings(joints: "JointMotors", tables: Tables) -> Iterator[Finding]:
    """Compare control tables with what is wanted of them.

    A finding for each register that differs.
    """
    try:
        settings = joints.settings()
    except CalibrationError as error:
        yield Finding("registers", False, str(error))
        return
    models = dict(zip(joints.ids, joints.models, strict=True))
    changes: dict[Register, list[str]] = {}
    for id, table in tables.items():
        for register, (value, wanted) in different(table, models[id], settings[id]).items():
            remedy = (register.remedy or "will be set to {wanted}").format(wanted=wanted)
            changes.setdefault(register, []).append(f"motor {id}: {value}; {remedy}")
    for register, motors in changes.items():
        words = f"{register.why}: {listed(motors)}"
        if not register.remedy:
            where = " (kept without power)" if kept(register) else ""
            words = f"{listed(motors)}{where}; else {register.why}"
        yield Finding(register.name, not register.remedy, words)
    if not changes:
        yield Finding("registers", True, "as the hand needs them")


def _holding(bus: MotorBus) -> str:
    """Which motors hold what the hand has, in words; empty where none has its torque on."""
    on = bus.read_torque()
    if not on.any():
        return ""
    ids = ", ".join(map(str, np.array(bus.ids)[on]))
    current = float(np.abs(bus.read_state().current[on]).max())
    return (
        f"motors {ids} hold, with up to {current:.2f} A: they let go when their settings are "
        "written; support what the hand carries"
    )


def settings_findings(connection: Connection) -> Iterator[Finding]:
    """Write the registers of real motors that differ, with the torque off, and read them back."""
    if not isinstance(connection.bus, MotorBus):
        return
    try:
        with held():  # else some motors would keep their torque
            connection.bus.configure(connection.joints.settings())
    except BusError as error:
        yield Finding("settings", False, str(error))
    else:
        yield Finding("settings", True, "registers written and read back, torque off")


def _state_findings(connection: Connection) -> Iterator[Finding]:
    """Temperature, voltage and pose."""
    joints = connection.joints
    state = connection.bus.read_state()
    hot = []
    weak = []
    for axis, (id, model) in enumerate(zip(joints.ids, joints.models, strict=True)):
        celsius = state.temperature[axis]
        volts = state.voltage[axis]
        if celsius > COOL_C:
            hot.append(f"motor {id}: {celsius:.0f} deg C, over {COOL_C:g}: let it cool")
        if abs(volts - model.supply_v) > VOLTAGE_SHARE * model.supply_v:
            remedy = f"not {model.supply_v:g}: check the supply and its wires"
            weak.append(f"motor {id}: {volts:.1f} V, {remedy}")
    yield finding("temperature", hot, f"up to {state.temperature.max():.0f} deg C")
    yield finding("voltage", weak, f"{state.voltage.min():.1f} to {state.voltage.max():.1f} V")
    outside = out_of_range(connection.hand, joints.to_joint(state.position))
    yield finding("pose within limits", outside, "every joint")


def _cycles(bus: MotorBus) -> Finding:
    """Time that a reading takes, at the control rate."""
    rejected = bus.rejected
    took_s = []
    failed = 0
    why = ""
    begin = bus.clock.now()
    for cycle in range(CYCLES):
        bus.clock.sleep(begin + cycle * PERIOD_S - bus.clock.now())
        start = bus.clock.now()
        try:
            bus.read_state()
        except BusError as error:
            failed += 1
            why = f"; {error}"
        took_s.append(bus.clock.now() - start)
    median_s = float(np.median(took_s))
    limit_s = BUS_SHARE * PERIOD_S
    words = (
        f"{1e3 * median_s:.1f} ms a reading, longest {1e3 * max(took_s):.1f}; "
        f"{bus.rejected - rejected} of {CYCLES} asked again, {failed} failed{why}"
    )
    if failed or median_s >= limit_s:
        remedy = f"it may take {1e3 * limit_s:.0f} ms; check cables, and the adapter's latency"
        return Finding("loop rate", False, f"{words}: {remedy}")
    return Finding("loop rate", True, words)


def wiggle(connection: Connection, safe: SafeHand) -> Iterator[Finding]:
    """Turn every joint alone by 5 degrees, for a person to look at, and then back, slowly.

    What a person is to see is told before it moves.

    Raises:
        StoppedError: A limit was passed.
    """
    hand = connection.hand
    home = safe.arm().position
    for axis, name in enumerate(hand.joint_names):
        goal = free_turn(hand, home, axis)
        way = _tip_goes(hand, home, goal, hand.joint_finger[axis])
        motor = connection.joints.ids[axis]
        print(f"watch {name}, motor {motor}: {way}", file=sys.stderr, flush=True)
        before = safe.read().position[axis]
        safe.move(goal, WIGGLE_RAD_S)
        turned = safe.read().position[axis] - before
        safe.move(home, WIGGLE_RAD_S)
        wanted = goal[axis] - home[axis]
        words = f"turned by {math.degrees(turned):+.1f} of {math.degrees(wanted):+.0f} deg"
        if turned / wanted > TURNED_SHARE:
            yield Finding(f"wiggle of {name}", True, words)
        else:
            yield Finding(f"wiggle of {name}", False, f"{words}: blocked?")


def free_turn(hand: "HandModel", pose: np.ndarray, axis: int) -> np.ndarray:
    """A pose [rad] [D] with one joint turned so that its fingertip goes outwards, where it is free.

    Without torque fingers lean on what lies between them. At an end of its range a joint turns the
    other way.
    """
    farthest_m = -np.inf
    free = pose
    for turn_rad in (WIGGLE_RAD, -WIGGLE_RAD):
        turned = pose.copy()
        turned[axis] += turn_rad
        tip = hand.tip_poses(turned)[hand.joint_finger[axis], :3]
        reach_m = float(np.linalg.norm(tip - hand.goal_in_base))
        if not hand.lower[axis] <= turned[axis] <= hand.upper[axis]:
            reach_m -= BEYOND_M
        if reach_m > farthest_m:
            farthest_m = reach_m
            free = turned
    return free


def _tip_goes(hand: "HandModel", before: np.ndarray, after: np.ndarray, finger: int) -> str:
    """What the tip of a finger does between two poses of the joints [rad] [D], in words."""
    tips = hand.tip_poses(before)[:, :3]
    moved = hand.tip_poses(after)[finger, :3] - tips[finger]
    moved_m = float(np.linalg.norm(moved))
    towards = np.vstack([hand.goal_in_base, tips]) - tips[finger]
    distances_m = np.linalg.norm(towards, axis=1)
    nearer_m = distances_m - np.linalg.norm(towards - moved, axis=1)
    shares = nearer_m / max(moved_m, 1e-9)
    shares[1 + finger] = -np.inf
    if abs(shares[0]) > SIDEWAYS:
        way = "inwards" if shares[0] > 0.0 else "outwards"
    elif len(tips) > 1:
        way = f"towards finger {int(np.argmax(shares[1:]))}"
    else:
        way = "sideways"
    return f"the tip of finger {finger} goes {1e3 * moved_m:.0f} mm {way}"


def ready(
    connection: Connection,
    question: str,
    *,
    yes: bool,
    quiet: bool = False,
    more: Iterable[Finding] = (),
) -> None:
    """Preflight, and ``more`` of it, have the person confirm, and only then write the settings.

    Raises:
        RuntimeError: Something is wrong, the person did not say yes, or a motor does not keep a
            setting.
    """
    _stop_at_wrong(show(itertools.chain(preflight(connection), more), quiet=quiet))
    confirm(question, yes=yes)
    _stop_at_wrong(show(settings_findings(connection), quiet=quiet))


def _stop_at_wrong(findings: Iterable[Finding]) -> None:
    for row in findings:
        if not row.ok:
            raise RuntimeError(f"nothing moves: {row.what}: {row.words}")


def confirm(question: str, *, yes: bool) -> None:
    """Ask before something moves; what was typed before the question, or no more input, is no yes.

    Raises:
        RuntimeError: The answer was no, or nobody is there to ask.
    """
    if yes:
        return
    if not attended():
        raise RuntimeError(
            f"nothing moves: {question} Nobody is there to ask; --yes says so at once"
        )
    ask(f"{question} Keep hands and cables clear. [y/N]")
    if (answer() or "").lower() not in ("y", "yes"):
        raise RuntimeError("nothing moves: not confirmed")


def open_camera(cfg: RealSenseCfg, connection: Connection, place: CameraModel) -> "ImageSource":
    """The depth camera, that of ROS, or one before the twin at this place.

    Raises:
        CameraError: There is none, or it has no such images.
    """
    if connection.ros is not None:
        from vd.deploy.camera.ros_camera import RosCamera

        return RosCamera(connection.ros)
    if connection.twin is not None:
        from vd.deploy.twin.twin import TwinCamera

        return TwinCamera(connection.twin, place)
    return RealSense(find_device(cfg.serial), cfg)


def camera_preflight(cfg: CheckCfg, connection: Connection) -> Iterator[Finding]:
    """Find the camera, and look at it."""
    from vd.assets_usd.camera_layer import read_camera
    from vd.deploy.camera.camera import CameraError
    from vd.deploy.camera.check_camera import camera_findings

    hand = connection.hand
    if cfg.camera_layer is None and hand.mounted_camera is None:
        yield Finding("camera", True, f"{hand.name} has none")
        return
    place = hand.camera if cfg.camera_layer is None else read_camera(hand, cfg.camera_layer)
    try:
        camera = open_camera(cfg.camera, connection, place)
    except CameraError as error:
        yield Finding("camera", False, str(error))
        return
    fps = cfg.camera.fps if connection.twin is None else PAPER.scene.control_hz
    with contextlib.closing(camera):
        yield from camera_findings(camera, place, hand.goal_in_base, fps=fps)


def check(cfg: CheckCfg) -> int:
    """Look, and print a table; 1 if something is wrong."""
    from vd.deploy.loop.goals import one_object

    item = one_object(TWIN_OBJECT) if cfg.twin and not cfg.no_camera else None
    with connect(cfg, item=item) as connection:
        findings = show(preflight(connection))
        if not cfg.no_camera:
            findings += show(camera_preflight(cfg, connection))
        if cfg.wiggle and all(row.ok for row in findings):
            confirm(WIGGLES, yes=cfg.yes)
            findings += show(settings_findings(connection))
            _stop_at_wrong(findings)
            with SafeHand(connection.bus, connection.joints, SafetyCfg()) as safe:
                findings += show(wiggle(connection, safe))
    return 0 if all(row.ok for row in findings) else 1
