"""What happens when something goes wrong.

Each fault injected into a moving hand's twin, and how it ended.

``python -m vd.deploy.twin.faults`` prints a row for every fault. The twin runs in this process,
behind its pseudo-terminal, so that what its motors really did is known: who had torque, and who
pushed.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from vd.assets_usd.hands import called, load_hand
from vd.command.files import write_json
from vd.command.warp_quiet import quiet_warp
from vd.deploy.hardware.bus import MotorBus
from vd.deploy.hardware.check import preflight, write_settings
from vd.deploy.hardware.connect import Connection
from vd.deploy.hardware.control_table import WATCHDOG_FIRMWARE, WATCHDOG_TRIPPED, HardwareError
from vd.deploy.hardware.joints import Joints, read_joints
from vd.deploy.safety.limits import PERIOD_S, SafetyCfg
from vd.deploy.safety.safety import SafeHand, StoppedError
from vd.deploy.twin.line import Faults
from vd.deploy.twin.motor import Motor, make_motors
from vd.deploy.twin.newton_hand import NewtonHand
from vd.deploy.twin.plant import Drive, FirstOrderPlant, Plant
from vd.deploy.twin.twin import Twin
from vd.logs.log_format import FINISHED

PUSH_RAD = 0.29
"""Distance of the goals from the joints: what the policy asks for at most."""
TURN_S = 0.5
"""Time after which the loop pushes another way."""
BEFORE_S, AFTER_S = 1.0, 3.0
"""Time that the hand moves before the fault, and longest time after it."""
SAFE_RAD = 0.15
"""A motor this near to its goal carries its finger and pushes no more: gravity bends joints by 0.1
rad.
"""
REST_S = 0.6
"""Time after the end in which even a motor that hears nothing has to have stopped by itself."""

SETUP_RETRIES = 20
"""On a busy machine a twin may not run for longer than the SDK waits; before the start that is no
matter.
"""
START_S = 60.0
"""Longest start of a command."""


class Witness:
    """A plant that remembers what its motors did."""

    def __init__(self, plant: Plant, motors: Sequence[Motor]):
        self.plant, self._motors = plant, motors
        self.own: dict[int, float] = {}
        """When a motor stopped by its own watchdog [s], by its place."""
        self.times: list[float] = []
        """When it went on [s], by the monotonic clock."""
        self.pushes: list[np.ndarray] = []
        """How far each motor was from its goal then [rad], zero without torque, shape [D]."""

    def advance(self, seconds: float, drives: Sequence[Drive]) -> None:
        """Go on, and note it."""
        self.plant.advance(seconds, drives)
        where = self.plant.read()[0]
        goals = np.array([np.nan if drive.goal_rad is None else drive.goal_rad for drive in drives])
        self.times.append(time.monotonic())
        self.pushes.append(np.nan_to_num(np.abs(goals - where)))
        for axis, motor in enumerate(self._motors):
            if motor.get("bus_watchdog") == WATCHDOG_TRIPPED:
                self.own.setdefault(axis, self.times[-1])

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the plant reads."""
        return self.plant.read()

    def left(self) -> list[int]:
        """Places of the motors that have torque."""
        return [axis for axis, motor in enumerate(self._motors) if motor.get("torque_enable")]

    def safe_after(self, since: float) -> float:
        """Time from ``since`` until no motor that has been told pushed any more, for good [s].

        One that has torque now was not told; infinite if another still pushes.
        """
        told = np.setdiff1d(np.arange(len(self._motors)), self.left())
        pushes = np.array(self.pushes)[:, told]
        times = np.array(self.times[: len(pushes)])  # the twin goes on meanwhile
        pushing = (pushes > SAFE_RAD).any(axis=1)
        last = np.flatnonzero(pushing & (times >= since))
        if not len(last):
            return 0.0
        return float(times[last[-1] + 1] - since) if last[-1] + 1 < len(times) else float("inf")


@dataclass
class Scene:
    """A twin with a hand that moves, and what is to go wrong."""

    twin: Twin
    bus: MotorBus
    witness: Witness
    injected_s: float = float("inf")
    """When the fault came [s]."""
    camera: bool = False
    """Whether there is a camera whose newest image is always new."""
    blind: str = ""
    """Why its images show nothing."""
    pause_s: float = 0.0
    """Time that the loop wastes in each step."""
    error: Exception | None = None
    """What the loop raises."""

    def motor(self, axis: int) -> Motor:
        """The motor of a joint."""
        return self.twin.motors[axis]

    def axes(self) -> FirstOrderPlant:
        """The axes without mass that stand for the hand."""
        assert isinstance(self.witness.plant, FirstOrderPlant)
        return self.witness.plant


Inject = Callable[[Scene], None]


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong while the hand moves."""

    name: str
    inject: Inject
    stops: bool = True
    """Whether the hand has to stop; else it has to go on."""
    camera: bool = False
    """Whether there is a camera before."""
    cfg: SafetyCfg = field(default_factory=SafetyCfg)
    reach_rad: float = PUSH_RAD
    """Distance of the goals from the joints once it came."""
    blockable: bool = False
    """On axes without mass that can be blocked, in place of the hand."""


def _set(**values: object) -> Inject:
    """A fault that sets attributes of the scene."""
    return lambda scene: vars(scene).update(values)


def _line(**values: float) -> Inject:
    """Faults of the line."""
    return lambda scene: vars(scene.twin.faults).update(values)


def _put(item: str, value: int, axis: int) -> Inject:
    """An item of a joint's motor that is not as it should be."""
    return lambda scene: scene.motor(axis).put(item, value)


def _renamed(scene: Scene) -> None:
    """A motor with an ID that none has."""
    scene.motor(1).put("id", 1 + max(motor.id for motor in scene.twin.motors))


def _low(scene: Scene) -> None:
    """A fourth of the supply's voltage is lost in the wires."""
    for motor in scene.twin.motors:
        motor.put("present_input_voltage", round(7.5 * motor.model.supply_v))


def _block(scene: Scene) -> None:
    scene.axes().blocked[2] = True


def _at(axis: int, angle: float) -> Inject:
    """A motor at an angle [rad]."""
    return lambda scene: scene.axes().position.__setitem__(axis, angle)


def _twice(scene: Scene) -> None:
    """Two motors with one ID, at different angles as any two are."""
    scene.motor(2).put("id", scene.motor(1).id)
    _at(2, 0.4)(scene)


def _stubborn(scene: Scene) -> None:
    """A motor that does not keep a limit."""
    motor, item = scene.twin.motors[4], "max_position_limit"
    motor.put(item, 4000)
    accept = motor._accept
    motor._accept = lambda name, value: accept(name, 4000 if name == item else value)  # type: ignore[method-assign]


WIDE = SafetyCfg(step_rad=4.0)
"""Limits that let goals far away through."""
BRIEF = SafetyCfg(blocked_s=1.0)
"""Limits that let nothing be pressed for long."""
MOVING = (
    Fault("1 % of packets lost", _line(lose=0.01), stops=False),
    Fault("1 % of packets corrupted", _line(corrupt=0.01), stops=False),
    Fault("1 % of packets cut off", _line(truncate=0.01), stops=False),
    Fault("1 % of packets 0.1 s late", _line(late=0.01), stops=False),
    Fault("every packet lost", _line(lose=1.0)),
    Fault("every packet corrupted", _line(corrupt=1.0)),
    Fault("every packet 0.1 s late", _line(late=1.0)),
    Fault("cable of one motor loose", lambda s: s.twin.faults.cut_off.add(s.motor(1).id)),
    Fault(
        "cable of all motors loose",
        lambda s: s.twin.faults.cut_off.update(m.id for m in s.twin.motors),
    ),
    Fault("adapter unplugged", lambda s: s.bus.close()),
    Fault("a motor warms by 50 deg C/s", lambda s: setattr(s.motor(4), "heat_c_per_s", 50.0)),
    Fault("a motor shuts down, too hot", lambda s: setattr(s.motor(4), "heat_c_per_s", 5000.0)),
    Fault("a joint is blocked", _block, cfg=BRIEF, blockable=True),
    Fault("a joint is blocked, goals far away", _block, cfg=WIDE, reach_rad=2.0, blockable=True),
    Fault("a motor's bus watchdog trips", _put("bus_watchdog", WATCHDOG_TRIPPED, 3)),
    Fault("the supply sags", _low),
    Fault("a motor shuts down, overload", _put("hardware_error_status", HardwareError.OVERLOAD, 5)),
    Fault("a motor restarts", lambda s: s.motor(-1).reboot()),
    Fault("a motor takes another ID", _renamed),
    Fault("the camera stops", _set(camera=False), camera=True),
    Fault("the camera sees nothing", _set(blind="black"), camera=True),
    Fault("every step takes 0.15 s", _set(pause_s=0.15)),
    Fault("the loop stands", _set(pause_s=2.0)),
    Fault("an exception in the loop", _set(error=ArithmeticError("no such number"))),
    Fault("Ctrl-C", lambda s: os.kill(os.getpid(), signal.SIGINT)),
    Fault("the terminal closes", lambda s: os.kill(os.getpid(), signal.SIGHUP)),
)
"""Faults of a moving hand."""
BEFORE: dict[str, Inject] = {
    "a motor has a wrong ID": _renamed,
    "two motors have the same ID": _twice,
    "a motor does not keep its limit": _stubborn,
    "a motor's direction was reversed": _put("drive_mode", 1, 3),
    "a motor's firmware has no watchdog": _put("firmware_version", WATCHDOG_FIRMWARE - 1, 2),
    "a motor has an overload": _put("hardware_error_status", HardwareError.OVERLOAD, 5),
    "a motor is hot": lambda scene: setattr(scene.twin.motors[0], "temperature", 66.0),
    "the supply is low": _low,
    "a joint is out of its range": _at(5, 2.6),
    "a joint was turned round": _at(5, 2.0 * np.pi),
    "a cable is loose": lambda scene: scene.twin.faults.cut_off.add(scene.motor(-1).id),
}
"""What the preflight has to find."""
PROCESS = {
    "vd-deploy gets Ctrl-C": signal.SIGINT,
    "vd-deploy is asked to end": signal.SIGTERM,
    "vd-deploy is killed": signal.SIGKILL,
}
"""Signals to a command that moves the hand."""


@dataclass(frozen=True)
class Outcome:
    """How a fault ended."""

    fault: str
    happened: str
    detected_s: float | None = None
    """From the fault to its detection [s]; None if it was not to stop the hand."""
    safe_s: float | None = None
    """From its detection until the hand was told to hold, and no motor that heard it pushed any
    more [s].
    """
    own_s: float | None = None
    """From the fault until the last motor that could not be told had stopped by its own watchdog
    [s].
    """
    energised: tuple[int, ...] = ()
    """Motors with torque at the end."""
    pushing: tuple[int, ...] = ()
    """Of these, the ones that push."""
    right: bool = True
    """Whether it went as it has to."""

    def __str__(self) -> str:
        """In one line."""
        times = {
            "found after": self.detected_s,
            "safe after that": self.safe_s,
            "by themselves": self.own_s,
        }
        words = [
            f"{what} {1e3 * time_s:.0f} ms" for what, time_s in times.items() if time_s is not None
        ]
        left = f"{len(self.energised)} on, {len(self.pushing)} of them pushing"
        mark = "ok   " if self.right else "WRONG"
        return f"{mark}  {self.fault}: {self.happened} ({', '.join([*words, left])})"


@contextlib.contextmanager
def scene_of(joints: Joints, *, blockable: bool = False) -> Iterator[Scene]:
    """A twin that serves, and a configured bus to it."""
    plant: Plant = (
        FirstOrderPlant(len(joints.ids)) if blockable else NewtonHand(joints.hand, joints)
    )
    motors = make_motors(joints)
    witness = Witness(plant, motors)
    with (
        Twin(motors, witness, Faults(seed=1)) as twin,
        MotorBus(twin.path, joints.ids, joints.models) as bus,
    ):
        bus.retries = SETUP_RETRIES
        bus.configure(joints.settings())
        bus.retries = 1
        yield Scene(twin, bus, witness)


def _outcome(
    scene: Scene,
    name: str,
    happened: str,
    joints: Joints,
    *,
    right: bool,
    since_s: float = 0.0,
    **times: float | None,
) -> Outcome:
    """How it ended: a motor with torque at the end is right only where it has stopped by itself."""
    left, pushing = scene.witness.left(), np.flatnonzero(scene.witness.pushes[-1] > SAFE_RAD)
    own_s = max(
        (scene.witness.own.get(axis, float("inf")) - since_s for axis in left), default=None
    )
    return Outcome(
        name,
        happened,
        **times,
        own_s=own_s,
        energised=tuple(joints.ids[axis] for axis in left),
        pushing=tuple(joints.ids[axis] for axis in pushing),
        right=right and not len(pushing) and (own_s is None or own_s < float("inf")),
    )


def try_fault(fault: Fault, joints: Joints) -> Outcome:
    """Move the hand's twin, inject a fault, and see how it ends."""
    with scene_of(joints, blockable=fault.blockable) as scene:
        scene.camera = fault.camera
        with contextlib.suppress(StoppedError, ArithmeticError):
            with SafeHand(scene.bus, joints, fault.cfg, lambda text: None) as safe:
                safe.arm()
                _move(scene, safe, fault)
        time.sleep(REST_S)
        report = safe.report
        assert report is not None
        # At its largest current a motor whose mode keeps it may go on.
        if not fault.stops or (fault.cfg is WIDE and joints.capped.any()):
            right = report.reason == FINISHED
            happened = f"went on; {safe.repeated} readings repeated" if right else report.reason
            return _outcome(scene, fault.name, happened, joints, right=right)
        told_s = PERIOD_S if report.held_s is None else report.held_s - report.detected_s
        safe_s = max(told_s, scene.witness.safe_after(report.detected_s))
        left = f"; {len(report.unreleased)} motors may still be on" if report.unreleased else ""
        return _outcome(
            scene,
            fault.name,
            report.reason + left,
            joints,
            right=report.reason != FINISHED
            and report.detected_s >= scene.injected_s
            and safe_s <= PERIOD_S,
            since_s=scene.injected_s,
            detected_s=report.detected_s - scene.injected_s,
            safe_s=None if report.held_s is None else safe_s,
        )


def _move(scene: Scene, safe: SafeHand, fault: Fault) -> None:
    """A loop at the control rate that pushes every joint about, and in which the fault comes."""
    rng = np.random.default_rng(0)
    due = time.monotonic()
    way, reach = np.zeros(len(safe.limits.lower)), PUSH_RAD
    for step in range(round((BEFORE_S + AFTER_S) / PERIOD_S)):
        if step == round(BEFORE_S / PERIOD_S):
            scene.injected_s, reach = time.monotonic(), fault.reach_rad
            fault.inject(scene)
        if scene.error is not None:
            raise scene.error
        if step % round(TURN_S / PERIOD_S) == 0:
            way = rng.choice([-1.0, 1.0], len(way))
        if fault.blockable and step >= round(BEFORE_S / PERIOD_S):
            way = np.sign(safe.limits.lower + safe.limits.upper - 2.0 * safe.read().position)
        safe.command(safe.read().position + reach * way)
        if scene.camera:
            safe.image_at(time.monotonic(), scene.blind)
        time.sleep(scene.pause_s)
        due += PERIOD_S
        now = time.monotonic()
        safe.beat(missed=now > due)
        due = max(due, time.monotonic())  # not to hurry after it
        time.sleep(max(0.0, due - time.monotonic()))


def try_preflight(name: str, joints: Joints) -> Outcome:
    """Spoil something before the start; nothing may move."""
    with scene_of(joints, blockable=True) as scene:
        scene.bus.release()
        BEFORE[name](scene)
        time.sleep(0.1)
        connection = Connection(joints, scene.bus)
        wrong = [finding for finding in preflight(connection) if not finding.ok]
        if not wrong and not (written := write_settings(connection)).ok:
            wrong = [written]
        happened = f"nothing moves: {wrong[0].what}: {wrong[0].found}" if wrong else "was not found"
        right = bool(wrong) and not scene.witness.left()
        return _outcome(scene, name, happened, joints, right=right)


def try_process(name: str, joints: Joints) -> Outcome:
    """Send a signal to `vd-deploy home` while it moves the twin."""
    with scene_of(joints) as scene:
        scene.bus.close()  # one program at a time has the port
        command = [
            sys.executable,
            "-m",
            "vd.deploy.cli",
            "home",
            "--port",
            scene.twin.path,
            "--yes",
        ]
        command += ["--hand", called(joints.hand), "--speed", "0.2"]
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        end = time.monotonic() + START_S
        while (
            len(scene.witness.left()) < len(joints.ids)
            and process.poll() is None
            and time.monotonic() < end
        ):
            time.sleep(0.01)
        time.sleep(0.5)
        sent = time.monotonic()
        process.send_signal(PROCESS[name])
        _, words = process.communicate()
        time.sleep(REST_S)
        said = [line for line in words.splitlines() if line.startswith("stopped")]
        happened, right = (said or ["said nothing"])[-1], bool(said) and not scene.witness.left()
        if PROCESS[name] == signal.SIGKILL:
            happened, right = "the motors stop by themselves and hold", True
        safe_s = scene.witness.safe_after(sent)
        return _outcome(scene, name, happened, joints, right=right, since_s=sent, safe_s=safe_s)


@dataclass(frozen=True)
class FaultsCommand:
    """Inject every fault into the twin of a hand, and print what happened."""

    hand: str = "dclaw3"
    """dclaw3, dclaw4, an imported hand or a hand's USD."""
    only: str = ""
    """Only faults whose name holds this."""
    json: Path | None = None
    """Write the outcomes to this file."""

    def run(self) -> int:
        """Try all; 1 if one did not end as it has to."""
        quiet_warp()
        joints = read_joints(load_hand(self.hand))
        trials: dict[str, Callable[[], Outcome]] = {
            **{fault.name: partial(try_fault, fault, joints) for fault in MOVING},
            **{name: partial(try_preflight, name, joints) for name in BEFORE},
            **{name: partial(try_process, name, joints) for name in PROCESS},
        }
        outcomes = []
        for name, trial in trials.items():
            if self.only in name:
                outcomes.append(trial())
                print(outcomes[-1], flush=True)
        if self.json is not None:
            never = (float("inf"), float("-inf"))  # no number of JSON
            rows = [asdict(outcome).items() for outcome in outcomes]
            write_json(self.json, [{k: None if v in never else v for k, v in row} for row in rows])
        return 0 if all(outcome.right for outcome in outcomes) else 1


def main() -> int:
    """Entry point of ``python -m vd.deploy.twin.faults``."""
    from vd.command.line import parse

    return parse(FaultsCommand, prog="python -m vd.deploy.twin.faults", description=__doc__).run()


if __name__ == "__main__":
    sys.exit(main())
