"""Preflight: everything that must be right before a hand moves. With --range it moves, after asking."""

import contextlib
import itertools
import json
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from vd.deploy.camera.realsense import RealSenseCfg
from vd.deploy.finding import Finding, finding, show
from vd.deploy.hardware.adapter import adapter_findings
from vd.deploy.hardware.answers import BusError
from vd.deploy.hardware.check_registers import read_tables, register_findings, to_be_set
from vd.deploy.hardware.connect import Connection, HandOptions, connect
from vd.deploy.hardware.motion import move
from vd.deploy.safety.limits import PERIOD_S, SafetyCfg
from vd.deploy.safety.safety import SafeHand
from vd.deploy.twin.child import TwinError
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

CYCLES = 24
"""Control cycles whose times are measured: two seconds."""
BUS_SHARE = 0.5
"""Share of a control period that the bus may take; the rest is for camera and network."""
COOL_C = 60.0
"""Temperature [deg C] above which a motor should rest first: it warms by some degrees in use."""
VOLTAGE_SHARE = 0.1
"""Deviation from the supply's nominal voltage that is normal."""
OUTSIDE_RAD = 0.1
"""How far a joint may hang out of its range and still be brought back slowly."""
RANGE_SHARE = 0.8
"""Share of a joint's range that --range moves it through."""
RANGE_SPEED_RAD_S = 0.7
"""Speed of that."""
FOLLOW_RAD = 0.25
"""How far a joint may be from its slow goal: gravity bends it by 0.1 rad at the paper's gain."""


@dataclass(frozen=True)
class CheckCfg(HandOptions):
    """Look at everything that must be right before the hand moves; without --range nothing is written."""

    camera: RealSenseCfg = field(default_factory=RealSenseCfg)
    """The depth camera."""
    camera_layer: Path | None = None
    """Where it was found to be (camera.usda of vd-deploy calibrate); where the hand has it by default."""
    no_camera: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave the camera out: homing and recording need none."""
    range: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also move each joint slowly through its range, after asking."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""


def preflight(connection: Connection) -> Iterator[Finding]:
    """Look at motors, items, state and bus. Nothing is written: a motor that holds something goes on to.

    What could not be looked at because of what came before is not in the findings.
    """
    bus = connection.bus
    try:
        yield from adapter_findings(bus.port)
        missing = bus.missing()
        tables, deaf = read_tables(bus, [id for id in bus.ids if id not in missing])
        wrong = [f"motor {id} {why}" for id, why in missing.items()] + deaf
        yield finding("motors answer", wrong, f"all {len(bus.ids)}")
        if wrong:
            return
        errors = bus.hardware_errors()
        yield finding(
            "no hardware error",
            [
                f"motor {id}: {why}; once it is mended {bus.command(f'reboot {id}')} clears it"
                for id, why in errors.items()
            ],
            "none",
        )
        yield from register_findings(connection, tables)
        yield Finding("torque", True, holding(connection) or "off")
        yield from _state(connection)
        yield _cycles(connection)
    except BusError as error:
        yield Finding("bus", False, str(error))


def holding(connection: Connection) -> str:
    """Which motors hold what the hand has, in words; empty where none has its torque on.

    Raises:
        BusError: A motor does not answer.
    """
    bus = connection.bus
    on = bus.read_torque()
    if not on.any():
        return ""
    ids = ", ".join(str(id) for id, one in zip(bus.ids, on, strict=True) if one)
    current = float(np.abs(bus.read_state().current[on]).max())
    return f"motors {ids} hold, with up to {current:.2f} A: they let go when their settings are written"


def write_settings(connection: Connection) -> Finding:
    """Write the registers that differ, with the torque off, and read them back."""
    bus, what = connection.bus, "settings"
    try:
        bus.configure(connection.joints.settings(connection.hand, bus.model.name))
    except BusError as error:
        return Finding(what, False, str(error))
    return Finding(what, True, "registers written and read back, torque off")


def _state(connection: Connection) -> Iterator[Finding]:
    """Temperature, voltage and pose."""
    bus, joints, hand = connection.bus, connection.joints, connection.hand
    state = bus.read_state()
    limit = COOL_C
    hot = [
        f"motor {id}: {t:.0f} deg C, over {limit:g}: let it cool"
        for id, t in zip(bus.ids, state.temperature, strict=True)
        if t > limit
    ]
    yield finding("temperature", hot, f"up to {state.temperature.max():.0f} deg C")
    supply, apart = bus.model.supply_v, VOLTAGE_SHARE * bus.model.supply_v
    weak = [
        f"motor {id}: {v:.1f} V, not {supply:g}: check the supply and its wires"
        for id, v in zip(bus.ids, state.voltage, strict=True)
        if abs(v - supply) > apart
    ]
    yield finding("voltage", weak, f"{state.voltage.min():.1f} to {state.voltage.max():.1f} V")
    q = joints.to_joint(state.position)
    out = np.maximum(hand.lower - q, q - hand.upper)
    turns = np.round((q - 0.5 * (hand.lower + hand.upper)) / (2.0 * np.pi))
    outside = []
    for axis in np.flatnonzero(out > OUTSIDE_RAD):
        # Turned by hand without torque a motor counts on; one that starts counts within one turn.
        mend = f"it was turned round; {bus.command(f'reboot {bus.ids[axis]}')}"
        mend = mend if turns[axis] else "move it by hand, or mend its calibration"
        where = f"{q[axis]:.2f} rad, out of {hand.lower[axis]:.2f} to {hand.upper[axis]:.2f}"
        outside.append(f"{joints.names[axis]}: {where}: {mend}")
    yield finding("pose within limits", outside, "every joint")


def _cycles(connection: Connection) -> Finding:
    """Time that a reading takes, at the control rate."""
    bus, clock = connection.bus, connection.bus.clock
    rejected, took, failed, why = bus.rejected, [], 0, ""
    begin = clock.now()
    for cycle in range(CYCLES):
        clock.sleep(begin + cycle * PERIOD_S - clock.now())
        start = clock.now()
        try:
            bus.read_state()
        except BusError as error:
            failed, why = failed + 1, f"; {error}"
        took.append(clock.now() - start)
    found = (
        f"{1e3 * float(np.median(took)):.1f} ms a reading, longest {1e3 * max(took):.1f}; "
        f"{bus.rejected - rejected} of {CYCLES} asked again, {failed} failed{why}"
    )
    right = failed == 0 and float(np.median(took)) < BUS_SHARE * PERIOD_S
    remedy = (
        ""
        if right
        else f": it may take {1e3 * BUS_SHARE * PERIOD_S:.0f} ms; check cables, and the adapter's latency"
    )
    return Finding("loop rate", right, found + remedy)


def sweep(connection: Connection, safe: SafeHand) -> Iterator[Finding]:
    """Move every joint alone through most of its range and back to the start, slowly.

    Raises:
        StoppedError: A limit was passed.
    """
    home = safe.arm().position
    lower, upper = safe.limits.lower, safe.limits.upper
    centre, half = 0.5 * (lower + upper), 0.5 * RANGE_SHARE * (upper - lower)
    for axis, name in enumerate(connection.joints.names):
        worst = 0.0
        for end in (centre[axis] - half[axis], centre[axis] + half[axis], home[axis]):
            goal = home.copy()
            goal[axis] = end
            worst = max(worst, abs(move(safe, goal, RANGE_SPEED_RAD_S)[axis]))
        low, high = centre[axis] - half[axis], centre[axis] + half[axis]
        where = f"{low:.2f} to {high:.2f} rad, at most {worst:.2f} from its goal"
        ok = worst < FOLLOW_RAD
        yield Finding(
            f"range of {name}", ok, where + ("" if ok else ": blocked, a wrong sign, or a wrong joint's ID?")
        )


def ready(
    connection: Connection, question: str, *, yes: bool, quiet: bool = False, more: Iterable[Finding] = ()
) -> list[Finding]:
    """Preflight, and ``more`` of it, have the person confirm, and only then write the settings.

    Raises:
        RuntimeError: Something is wrong, or the person did not say yes.
    """
    findings = show(itertools.chain(preflight(connection), more), quiet=quiet)
    _stop_at_wrong(findings)
    return findings + agreed(connection, question, yes=yes, quiet=quiet)


def agreed(connection: Connection, question: str, *, yes: bool, quiet: bool = False) -> list[Finding]:
    """Have the person confirm, say what the hand holds, and write the settings.

    Raises:
        RuntimeError: The person did not say yes, or a motor does not keep a setting.
    """
    if held := holding(connection):
        held = f"{held[:1].upper()}{held[1:]}; support what the hand carries. "
        print(held, file=sys.stderr, flush=True)
    confirm(f"{to_be_set(connection)}{question}", yes=yes)
    written = show([write_settings(connection)], quiet=quiet)
    _stop_at_wrong(written)
    return written


def _stop_at_wrong(findings: Iterable[Finding]) -> None:
    wrong = [one for one in findings if not one.ok]
    if wrong:
        raise RuntimeError(f"nothing moves: {wrong[0].what}: {wrong[0].found}")


def confirm(question: str, *, yes: bool) -> None:
    """Ask before something moves.

    Raises:
        RuntimeError: The answer was no, or nobody is there to ask.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise RuntimeError(f"nothing moves: {question} Nobody is there to ask; --yes says so at once")
    print(f"{question} Keep hands and cables clear. [y/N] ", end="", file=sys.stderr, flush=True)
    if input().strip().lower() not in ("y", "yes"):
        raise RuntimeError("nothing moves: not confirmed")


def camera_preflight(cfg: CheckCfg, hand: "HandModel", side: Path) -> Iterator[Finding]:
    """Find the camera, and look at it.

    Args:
        cfg: Which camera.
        hand: The hand.
        side: Socket of the twin, if there is one.
    """
    from vd.assets_usd.camera_layer import read_camera
    from vd.deploy.camera.camera import CameraError
    from vd.deploy.camera.check_camera import camera_findings
    from vd.deploy.camera.eyes import open_camera
    from vd.deploy.twin.twin_link import TwinLink

    place = hand.camera if cfg.camera_layer is None else read_camera(hand, cfg.camera_layer)
    with contextlib.ExitStack() as stack:
        try:
            link = stack.enter_context(TwinLink(side)) if cfg.twin else None
            source, name = open_camera(place, link, cfg.camera, sdk=None)
        except (CameraError, TwinError) as error:
            yield Finding("camera", False, str(error))
            return
        stack.callback(source.close)
        yield Finding("camera", True, name)
        yield from camera_findings(source, place, fps=PAPER.scene.control_hz if cfg.twin else cfg.camera.fps)


def check(cfg: CheckCfg) -> int:
    """Look, and print a table; 1 if something is wrong."""
    with contextlib.ExitStack() as stack:
        side = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vd-twin-"))) / "side"
        seen = ["--object", "cube", "--side", str(side)] if cfg.twin and not cfg.no_camera else []
        connection = stack.enter_context(connect(cfg, seen))
        findings = show(preflight(connection), quiet=cfg.json)
        if not cfg.no_camera:
            findings += show(camera_preflight(cfg, connection.hand, side), quiet=cfg.json)
        if cfg.range and all(one.ok for one in findings):
            question = "Every joint will move slowly through its range."
            findings += agreed(connection, question, yes=cfg.yes, quiet=cfg.json)
            limits = replace(SafetyCfg(), then="off")
            safe = stack.enter_context(SafeHand(connection.bus, connection.joints, connection.hand, limits))
            findings += show(sweep(connection, safe), quiet=cfg.json)
    right = all(one.ok for one in findings)
    if cfg.json:
        print(json.dumps({"ok": right, "findings": [asdict(one) for one in findings]}, indent=1))
    return 0 if right else 1
