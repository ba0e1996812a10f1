"""Preflight: everything that must be right before a hand moves.

With --wiggle or --range it moves, after asking.
"""

import contextlib
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from vd.assets_usd.hand_data import CameraModel
from vd.deploy.asking import answer, ask, attended
from vd.deploy.camera.realsense import RealSense, RealSenseCfg, find_device
from vd.deploy.finding import Finding, finding, listed, show
from vd.deploy.hardware.answers import BusError, GarbledError, LateError
from vd.deploy.hardware.aside import aside
from vd.deploy.hardware.connect import Connection, HandOptions, connect, motors_of
from vd.deploy.hardware.joints import CalibrationError
from vd.deploy.hardware.registers import RESTART, Register, different, kept
from vd.deploy.safety.limits import PERIOD_S, SafetyCfg, out_of_range
from vd.deploy.safety.safety import SafeHand
from vd.deploy.safety.signals import held
from vd.deploy.twin.child import TwinCamera
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel
    from vd.deploy.camera.camera import Camera
    from vd.deploy.hardware.bus import MotorBus

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
RANGE_SHARE = 0.8
"""Share of a joint's range that --range moves it through."""
RANGE_SPEED_RAD_S = 0.7
"""Speed of that."""
WIGGLE_RAD = math.radians(5.0)
"""How far --wiggle turns each joint: what a person sees, and what nothing is in the way of."""
WIGGLE_RAD_S = 0.1
"""Speed of that."""
SIDEWAYS = 0.5
"""Share of a fingertip's way by which it nears what it goes towards."""
FOLLOW_RAD = 0.25
"""How far a joint may be from its slow goal: gravity bends it by 0.1 rad at the paper's gain."""

Tables = Mapping[int, Mapping[str, int]]
"""Control tables of motors by ID, each by item."""


@dataclass(frozen=True)
class CheckCfg(HandOptions):
    """Look at everything that must be right before the hand moves.

    Without --wiggle and --range nothing is written.
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
    range: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also move each joint slowly through its range, after asking."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""


def preflight(connection: Connection) -> Iterator[Finding]:
    """Look at motors, items, state and bus.

    Nothing is written: a motor that holds something goes on to.

    What could not be looked at because of what came before is not in the findings.
    """
    bus: Any = connection.bus
    if connection.ros is not None:
        yield from bus.findings()
        return
    try:
        yield from adapter_findings(bus.port)
        missing = bus.missing()
        tables, deaf = _read_tables(bus, [id for id in bus.ids if id not in missing])
        wrong = [*missing.values(), *deaf]
        if strangers := sorted(set(bus.ping_all()) - set(bus.ids)) if missing else []:
            wrong.insert(
                0, f"ID {', '.join(map(str, strangers))} answers, and is none of the hand's"
            )
        yield finding("motors answer", wrong, f"all {len(bus.ids)}")
        if wrong:
            return
        errors = [
            f"motor {id}: {why}; mend it, then {RESTART}"
            for id, why in bus.hardware_errors().items()
        ]
        yield finding("no hardware error", errors, "none")
        yield from register_findings(connection, tables)
        yield Finding("torque", True, _holding(bus) or "off")
        yield from _state(connection)
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


def _read_tables(
    bus: "MotorBus", ids: Sequence[int]
) -> tuple[dict[int, dict[str, int]], list[str]]:
    """Control tables of motors that answer a ping, and what is wrong with those that answer nothing else."""
    tables, wrong = {}, []
    for id in ids:
        try:
            tables[id] = bus.read_table(id)
        except (GarbledError, LateError) as error:
            wrong.append(str(error))
        except BusError:
            wrong.append(
                f"motor {id} answers pings, but no reads: its status_return_level is 0; {RESTART}"
            )
    return tables, wrong


def register_findings(connection: Connection, tables: Tables) -> Iterator[Finding]:
    """Compare control tables with what is wanted of them.

    A finding for each register that differs.
    """
    bus = connection.bus
    try:
        settings = connection.joints.settings()
    except CalibrationError as error:
        yield Finding("registers", False, str(error))
        return
    models = dict(zip(bus.ids, bus.models, strict=True))
    rows: dict[Register, list[tuple[int, int, int]]] = {}
    for id, found in tables.items():
        for one, values in different(found, models[id], settings[id]).items():
            rows.setdefault(one, []).append((id, *values))
    for one, motors in rows.items():
        alike: dict[tuple[int, int], list[str]] = {}
        for id, value, wanted in motors:
            alike.setdefault((value, wanted), []).append(str(id))
        remedy = one.remedy or "will be set to {wanted}"
        changes = listed(
            [
                f"motor {', '.join(ids)}: {value}; {remedy.format(wanted=wanted)}"
                for (value, wanted), ids in alike.items()
            ]
        )
        where = " (kept without power)" if kept(one) else ""
        found_is = f"{one.why}: {changes}" if one.remedy else f"{changes}{where}; else {one.why}"
        yield Finding(one.name, not one.remedy, found_is)
    if not rows:
        yield Finding("registers", True, "as the hand needs them")


def _holding(bus: "MotorBus") -> str:
    """Which motors hold what the hand has, in words; empty where none has its torque on."""
    on = bus.read_torque()
    if not on.any():
        return ""
    ids = ", ".join(str(id) for id, one in zip(bus.ids, on, strict=True) if one)
    current = float(np.abs(bus.read_state().current[on]).max())
    return (
        f"motors {ids} hold, with up to {current:.2f} A: they let go when their settings are "
        "written; support what the hand carries"
    )


def write_settings(connection: Connection) -> Finding:
    """Write the registers that differ, with the torque off, and read them back."""
    bus, what = connection.bus, "settings"
    try:
        with held():  # else some motors would keep their torque
            bus.configure(connection.joints.settings())
    except BusError as error:
        return Finding(what, False, str(error))
    return Finding(what, True, "registers written and read back, torque off")


def _state(connection: Connection) -> Iterator[Finding]:
    """Temperature, voltage and pose."""
    bus, joints = connection.bus, connection.joints
    state = bus.read_state()
    hot = [
        f"motor {id}: {t:.0f} deg C, over {COOL_C:g}: let it cool"
        for id, t in zip(bus.ids, state.temperature, strict=True)
        if t > COOL_C
    ]
    yield finding("temperature", hot, f"up to {state.temperature.max():.0f} deg C")
    weak = [
        f"motor {id}: {v:.1f} V, not {model.supply_v:g}: check the supply and its wires"
        for id, model, v in zip(bus.ids, bus.models, state.voltage, strict=True)
        if abs(v - model.supply_v) > VOLTAGE_SHARE * model.supply_v
    ]
    yield finding("voltage", weak, f"{state.voltage.min():.1f} to {state.voltage.max():.1f} V")
    outside = out_of_range(connection.hand, joints.to_joint(state.position))
    yield finding("pose within limits", outside, "every joint")


def _cycles(bus: "MotorBus") -> Finding:
    """Time that a reading takes, at the control rate."""
    rejected, took, failed, why = bus.rejected, [], 0, ""
    begin = bus.clock.now()
    for cycle in range(CYCLES):
        bus.clock.sleep(begin + cycle * PERIOD_S - bus.clock.now())
        start = bus.clock.now()
        try:
            bus.read_state()
        except BusError as error:
            failed, why = failed + 1, f"; {error}"
        took.append(bus.clock.now() - start)
    median_s, limit_s = float(np.median(took)), BUS_SHARE * PERIOD_S
    right = failed == 0 and median_s < limit_s
    remedy = f": it may take {1e3 * limit_s:.0f} ms; check cables, and the adapter's latency"
    found = (
        f"{1e3 * median_s:.1f} ms a reading, longest {1e3 * max(took):.1f}; "
        f"{bus.rejected - rejected} of {CYCLES} asked again, {failed} failed{why}"
    )
    return Finding("loop rate", right, found + ("" if right else remedy))


def wiggle(connection: Connection, safe: SafeHand) -> Iterator[Finding]:
    """Turn every joint alone by 5 degrees, for a person to look at, and then back, slowly.

    What a person is to see is told before it moves.

    Raises:
        StoppedError: A limit was passed.
    """
    hand, home = connection.hand, safe.arm().position
    for axis, name in enumerate(hand.joint_names):
        goal = _free_turn(hand, home, axis)
        motor, degrees = connection.joints.ids[axis], math.degrees(goal[axis] - home[axis])
        where = _tip_goes(hand, home, goal, hand.joint_finger[axis])
        print(f"watch {name}, motor {motor}: {where}", file=sys.stderr, flush=True)
        before = safe.read().position[axis]
        safe.move(goal, WIGGLE_RAD_S)
        turned = math.degrees(safe.read().position[axis] - before)
        safe.move(home, WIGGLE_RAD_S)
        ok = turned / degrees > 0.5
        found = f"turned by {turned:+.1f} of {degrees:+.0f} deg{'' if ok else ': blocked?'}"
        yield Finding(f"wiggle of {name}", ok, found)


def _free_turn(hand: "HandModel", pose: np.ndarray, axis: int) -> np.ndarray:
    """A pose [rad] [D] with one joint turned so that its fingertip goes outwards, where it is free.

    Without torque fingers lean on what lies between them. At an end of its range a joint turns the
    other way.
    """
    finger = hand.joint_finger[axis]

    def reach_m(turned: np.ndarray) -> float:
        return float(np.linalg.norm(hand.tip_poses(turned)[finger, :3] - hand.goal_in_base))

    step = np.zeros(len(pose))
    step[axis] = WIGGLE_RAD
    turned = [pose + step, pose - step]
    inside = [each for each in turned if hand.lower[axis] <= each[axis] <= hand.upper[axis]]
    return max(inside or turned, key=reach_m)


def _tip_goes(hand: "HandModel", before: np.ndarray, after: np.ndarray, finger: int) -> str:
    """What the tip of a finger does between two poses of the joints [rad] [D], in words."""
    old, new = hand.tip_poses(before)[:, :3], hand.tip_poses(after)[:, :3]
    moved_m = np.linalg.norm(new[finger] - old[finger])

    def nears(places: np.ndarray) -> np.ndarray:
        to = [np.linalg.norm(places - tip, axis=-1) for tip in (old[finger], new[finger])]
        return (to[0] - to[1]) / max(moved_m, 1e-9)

    object_share, finger_shares = nears(hand.goal_in_base), nears(old)
    finger_shares[finger] = -np.inf
    where = f"towards finger {int(np.argmax(finger_shares))}" if len(old) > 1 else "sideways"
    if abs(object_share) > SIDEWAYS:
        where = "inwards" if object_share > 0.0 else "outwards"
    return f"the tip of finger {finger} goes {1e3 * moved_m:.0f} mm {where}"


def sweep(connection: Connection, safe: SafeHand) -> Iterator[Finding]:
    """Move every joint alone through most of its range, the other fingers aside, and then back, slowly.

    Raises:
        StoppedError: A limit was passed.
    """
    hand = connection.hand
    poses = [
        aside(hand, finger) for finger in hand.joint_finger
    ]  # before the hand has to be told to hold
    home = safe.arm().position
    lower, upper = safe.limits.lower, safe.limits.upper
    centre, half = 0.5 * (lower + upper), 0.5 * RANGE_SHARE * (upper - lower)
    for axis, name in enumerate(connection.joints.names):
        worst, low, high = 0.0, centre[axis] - half[axis], centre[axis] + half[axis]
        goal = poses[axis]
        for end in (low, high, goal[axis]):
            goal = goal.copy()
            goal[axis] = end
            worst = max(worst, abs(safe.move(goal, RANGE_SPEED_RAD_S)[axis]))
        ok = worst < FOLLOW_RAD
        why = "" if ok else ": blocked, a wrong sign, or a wrong joint's ID?"
        found = f"{low:.2f} to {high:.2f} rad, at most {worst:.2f} from its goal{why}"
        yield Finding(f"range of {name}", ok, found)
    safe.move(home, RANGE_SPEED_RAD_S)


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
    if connection.ros is None:
        _stop_at_wrong(show([write_settings(connection)], quiet=quiet))


def _stop_at_wrong(findings: Iterable[Finding]) -> None:
    wrong = [one for one in findings if not one.ok]
    if wrong:
        raise RuntimeError(f"nothing moves: {wrong[0].what}: {wrong[0].found}")


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


def open_camera(cfg: RealSenseCfg, connection: Connection, place: CameraModel) -> "Camera":
    """The depth camera, that of ROS, or that of a twin, which it was told to have at this place.

    Raises:
        CameraError: There is none, or it has no such images.
    """
    if connection.ros is not None:
        from vd.deploy.camera.ros_camera import RosCamera

        return RosCamera(connection.ros)
    twin = connection.twin
    return RealSense(find_device(cfg.serial), cfg) if twin is None else TwinCamera(twin, place)


def camera_preflight(cfg: CheckCfg, connection: Connection) -> Iterator[Finding]:
    """Find the camera, and look at it."""
    from vd.assets_usd.camera_layer import read_camera
    from vd.deploy.camera.camera import CameraError
    from vd.deploy.camera.check_camera import camera_findings

    hand, twin = connection.hand, connection.twin
    if hand.mounted_camera is None and cfg.camera_layer is None:
        yield Finding("camera", True, f"{hand.name} has none")
        return
    place = hand.camera if cfg.camera_layer is None else read_camera(hand, cfg.camera_layer)
    try:
        camera = open_camera(cfg.camera, connection, place)
    except CameraError as error:
        yield Finding("camera", False, str(error))
        return
    with contextlib.closing(camera):
        fps = PAPER.scene.control_hz if twin is not None else cfg.camera.fps
        yield from camera_findings(camera, place, hand.goal_in_base, fps=fps)


def check(cfg: CheckCfg) -> int:
    """Look, and print a table; 1 if something is wrong."""
    with contextlib.ExitStack() as stack:
        sees = not cfg.no_camera and motors_of(cfg).hand.mounted_camera is not None
        connection = stack.enter_context(connect(cfg, object="cube" if sees else None))
        findings = show(preflight(connection), quiet=cfg.json)
        if not cfg.no_camera:
            findings += show(camera_preflight(cfg, connection), quiet=cfg.json)
        motions: dict[str, Callable[[Connection, SafeHand], Iterator[Finding]]] = {}
        if cfg.wiggle:
            motions["Joint by joint will turn by 5 degrees and back, as is told; watch each."] = (
                wiggle
            )
        if cfg.range:
            motions["Every joint will move slowly through its range."] = sweep
        if motions and all(one.ok for one in findings):
            confirm(" ".join(motions), yes=cfg.yes)
            findings += show([write_settings(connection)], quiet=cfg.json)
            _stop_at_wrong(findings)
            for motion in motions.values():
                with SafeHand(connection.bus, connection.joints, SafetyCfg()) as safe:
                    findings += show(motion(connection, safe), quiet=cfg.json)
    right = all(one.ok for one in findings)
    if cfg.json:
        print(json.dumps({"ok": right, "findings": [asdict(one) for one in findings]}, indent=1))
    return 0 if right else 1
