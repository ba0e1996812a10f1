"""Preflight: everything that must be right before a hand moves. With --range it moves, after asking."""

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Annotated

import numpy as np
import tyro

from vd.deploy.answers import BusError
from vd.deploy.connect import Connection, HandOptions, connect
from vd.deploy.joints import CalibrationError
from vd.deploy.limits import PERIOD_S, SafetyCfg
from vd.deploy.motion import move
from vd.deploy.safety import SafeHand

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
PLAIN = {"drive_mode": 0, "homing_offset": 0, "protocol_type": 2, "status_return_level": 2}
"""Items that have to be as from the factory: turned drives and offsets belong in the calibration."""
NAMED = 3
"""Motors that a finding names; where more are wrong they have a cause in common."""
RANGE_SHARE = 0.8
"""Share of a joint's range that --range moves it through."""
RANGE_SPEED_RAD_S = 0.7
"""Speed of that."""
FOLLOW_RAD = 0.25
"""How far a joint may be from its slow goal: gravity bends it by 0.1 rad at the paper's gain."""


@dataclass(frozen=True)
class CheckCfg(HandOptions):
    """Look at everything that must be right before the hand moves."""

    range: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also move each joint slowly through its range, after asking."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    what: str
    """What was looked at."""
    ok: bool
    found: str
    """How it is; where it is wrong with the remedy."""


def preflight(connection: Connection) -> Iterator[Finding]:
    """Look at motors, settings, state and bus; writes the settings, with the torque off.

    What could not be looked at because of what came before is not in the findings.
    """
    bus = connection.bus
    try:
        missing = bus.missing()
        yield _finding(
            "motors answer", [f"motor {id} {why}" for id, why in missing.items()], f"all {len(bus.ids)}"
        )
        if missing:
            return
        errors = bus.hardware_errors()
        yield _finding(
            "no hardware error",
            [f"motor {id}: {why}; reboot it once it is mended" for id, why in errors.items()],
            "none",
        )
        yield _finding("factory items", _not_plain(connection), "as they should be")
        try:
            bus.configure(connection.joints.settings(connection.hand, bus.model.name))
        except (BusError, CalibrationError) as error:
            yield Finding("gains and limits", False, str(error))
            return
        yield Finding("gains and limits", True, "written and read back")
        yield from _state(connection)
        yield _cycles(connection)
    except BusError as error:
        yield Finding("bus", False, str(error))


def _finding(what: str, wrong: list[str], right: str) -> Finding:
    more = f"; and {len(wrong) - NAMED} more" if len(wrong) > NAMED else ""
    return Finding(what, not wrong, "; ".join(wrong[:NAMED]) + more or right)


def _not_plain(connection: Connection) -> list[str]:
    bus = connection.bus
    wrong = []
    for id in bus.ids:
        for name, value in PLAIN.items():
            found = bus.read(id, name)
            if found != value:
                wrong.append(
                    f"motor {id}: {name} is {found}, not {value}: write it with the motors' own tool"
                )
    return wrong


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
    yield _finding("temperature", hot, f"up to {state.temperature.max():.0f} deg C")
    supply, apart = bus.model.supply_v, VOLTAGE_SHARE * bus.model.supply_v
    weak = [
        f"motor {id}: {v:.1f} V, not {supply:g}: check the supply and its wires"
        for id, v in zip(bus.ids, state.voltage, strict=True)
        if abs(v - supply) > apart
    ]
    yield _finding("voltage", weak, f"{state.voltage.min():.1f} to {state.voltage.max():.1f} V")
    q = joints.to_joint(state.position)
    out = np.maximum(hand.lower - q, q - hand.upper)
    outside = [
        f"{name}: {angle:.2f} rad, out of {low:.2f} to {high:.2f}: move it by hand, or mend its calibration"
        for name, angle, low, high, by in zip(joints.names, q, hand.lower, hand.upper, out, strict=True)
        if by > OUTSIDE_RAD
    ]
    yield _finding("pose within limits", outside, "every joint")


def _cycles(connection: Connection) -> Finding:
    """Time that a reading takes, at the control rate."""
    bus, clock = connection.bus, connection.bus.clock
    rejected, took, failed = bus.rejected, [], 0
    begin = clock.now()
    for cycle in range(CYCLES):
        clock.sleep(begin + cycle * PERIOD_S - clock.now())
        start = clock.now()
        try:
            bus.read_state()
        except BusError:
            failed += 1
        took.append(clock.now() - start)
    found = (
        f"{1e3 * float(np.median(took)):.1f} ms a reading, longest {1e3 * max(took):.1f}; "
        f"{bus.rejected - rejected} of {CYCLES} asked again, {failed} failed"
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


def show(findings: Iterator[Finding], *, quiet: bool = False) -> list[Finding]:
    """All findings, printed as they come unless ``quiet``."""
    kept = []
    for finding in findings:
        kept.append(finding)
        if not quiet:
            print(f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<20} {finding.found}", flush=True)
    return kept


def ready(connection: Connection, question: str, *, yes: bool, quiet: bool = False) -> list[Finding]:
    """Preflight, then have the person confirm.

    Raises:
        RuntimeError: Something is wrong, or the person did not say yes.
    """
    findings = show(preflight(connection), quiet=quiet)
    wrong = [finding for finding in findings if not finding.ok]
    if wrong:
        raise RuntimeError(f"nothing moves: {wrong[0].what}: {wrong[0].found}")
    confirm(question, yes=yes)
    return findings


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


def check(cfg: CheckCfg) -> int:
    """Look, and print a table; 1 if something is wrong."""
    with connect(cfg) as connection:
        findings = show(preflight(connection), quiet=cfg.json)
        if cfg.range and all(finding.ok for finding in findings):
            confirm("Every joint will move slowly through its range.", yes=cfg.yes)
            limits = replace(SafetyCfg(), then="off")
            with SafeHand(connection.bus, connection.joints, connection.hand, limits) as safe:
                findings += show(sweep(connection, safe), quiet=cfg.json)
    right = all(finding.ok for finding in findings)
    if cfg.json:
        print(json.dumps({"ok": right, "findings": [asdict(finding) for finding in findings]}, indent=1))
    return 0 if right else 1
