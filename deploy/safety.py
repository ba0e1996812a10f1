"""Limits and a watchdog between whatever decides on goals and the motors; they hold whatever it decides.

    with SafeHand(bus, joints, hand, cfg) as safe:     # preflight has passed, the person has confirmed
        safe.arm()                                     # torque on where the hand is; watchdogs run from here
        while not done:
            state = safe.read()                        # joints' frame [rad]; checked
            goal = safe.command(target)                # limited, sent; what was sent
            safe.image_at(time_s)                      # of the newest image, where there is a camera
            safe.beat(missed=late)                     # once per control step, after its work

Whatever ends the block, the hand is brought to a hold where it is, and then, as configured, its torque is
switched off. A limit that is passed, a lost bus, a stale image, missed deadlines, Ctrl-C or the end of the
terminal raise :class:`StoppedError` with the reason at the next call; a thread has stopped the hand by then,
also if no call ever comes. Where the driver itself dies, the motors' bus watchdog stops them.

Angles and speeds are the joints', rad and rad/s; times of the monotonic clock.
"""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import FrameType
from typing import Any, Literal

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.deploy.bus import BusError, BusState, MotorBus
from vd.deploy.joints import Joints
from vd.paper import PAPER

PERIOD_S = 1.0 / PAPER.scene.control_hz
WATCH_S = 0.01
"""How often the watchdog looks."""
OFF_S = 1.0
"""How long switching off is tried on a bus that does not answer soundly."""
FINISHED = "finished"
"""Reason of the stop at the end of what was to be done."""
SIGNALS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "asked to end", signal.SIGHUP: "the terminal is gone"}
"""Signals that stop the hand; a second one ends at once."""


class StoppedError(RuntimeError):
    """The hand was stopped; the message says why."""


@dataclass(frozen=True)
class SafetyCfg:
    """Limits that hold whatever the policy asks for."""

    margin_rad: float = 0.0
    """Distance that goals keep from the ends of the joints' ranges [rad]."""
    step_rad: float = 0.35
    """Farthest goal from where a joint is [rad]: the policy asks for 3.5 rad/s / 12 Hz = 0.29 at most. It
    limits the torque as well, to stiffness times this."""
    velocity_share: float = 1.5
    """Speed over the joints' own limit at which the hand is stopped; it turns faster only when something
    else moves it."""
    current_share: float = 0.8
    """Current over the one for the joints' largest torque at which the hand is stopped, if it lasts; motors
    shut down by themselves near 1."""
    current_s: float = 0.5
    """How long [s] a current may be above that."""
    temperature_c: float = 70.0
    """Temperature [deg C] of a motor at which the hand is stopped; motors shut down at 80."""
    lost_s: float = 3.0 * PERIOD_S
    """Time [s] without a sound state after which the bus is lost; shorter gaps repeat the last state."""
    misses: int = 3
    """Deadlines missed in a row at which the hand is stopped; also this many periods without a beat."""
    stale_s: float = 3.0 * PERIOD_S
    """Age [s] of the newest image at which the hand is stopped, once there was one."""
    watchdog_s: float = 0.3
    """Silence [s] after which the motors stop by themselves; 0 for never. Above three control periods."""
    then: Literal["off", "hold"] = "off"
    """After the hold: torque off, or leave the hand holding."""
    hold_s: float = 1.0
    """How long [s] the hand holds before its torque goes off: time to support what it carries."""

    def __post_init__(self) -> None:
        """Refuse numbers that would switch a limit off by accident."""
        positive = ("step_rad", "velocity_share", "current_share", "current_s", "temperature_c", "lost_s")
        for name in (*positive, "misses", "stale_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"safety.{name} is {getattr(self, name)}; it has to be above 0")
        for name in ("margin_rad", "watchdog_s", "hold_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"safety.{name} is {getattr(self, name)}; it must not be negative")


@dataclass(frozen=True)
class JointState:
    """State of the joints at one reading; arrays of shape [D]."""

    time_s: float
    """When it was read [s], by the monotonic clock."""
    position: np.ndarray
    """Angles [rad]."""
    velocity: np.ndarray
    """Speeds [rad/s]."""
    current: np.ndarray
    """Currents of the motors, positive in the joint's direction [A]."""
    pwm: np.ndarray
    """Duty cycles of the motors, positive in the joint's direction, in [-1, 1]."""
    voltage: np.ndarray
    """Voltages at the motors [V]."""
    temperature: np.ndarray
    """Temperatures of the motors [deg C]."""

    @classmethod
    def of(cls, state: BusState, joints: Joints) -> "JointState":
        """In the joints' frame."""
        return cls(
            time_s=state.time_s,
            position=joints.to_joint(state.position),
            velocity=joints.sign * state.velocity,
            current=joints.sign * state.current,
            pwm=joints.sign * state.pwm,
            voltage=state.voltage,
            temperature=state.temperature,
        )


@dataclass(frozen=True)
class StopReport:
    """How a stop went."""

    reason: str
    """Why."""
    detected_s: float
    """When that was noticed [s]."""
    held_s: float | None = None
    """When the hand was told to hold where it is [s]; None if that could not be sent."""
    unreleased: dict[int, str] = field(default_factory=dict)
    """Motors of which it is not known that their torque is off, by ID."""


class SafeHand:
    """A hand whose goals are limited and that stops by itself.

    Args:
        bus: Its motors, configured.
        joints: Which motor turns which joint.
        hand: The hand; its limits are taken.
        cfg: Limits.
        say: Tells the person.
    """

    def __init__(
        self,
        bus: MotorBus,
        joints: Joints,
        hand: HandModel,
        cfg: SafetyCfg | None = None,
        say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
    ):
        """Nothing is sent before :meth:`arm`."""
        self.bus, self.joints, self.hand, self.cfg, self._say = bus, joints, hand, cfg or SafetyCfg(), say
        self.lower = hand.lower + self.cfg.margin_rad
        self.upper = hand.upper - self.cfg.margin_rad
        if (self.lower >= self.upper).any():
            raise ValueError(f"safety.margin_rad is {self.cfg.margin_rad}; some joint's range is no wider")
        strongest = bus.model.current_limit * bus.model.current_unit_a
        torque_current = np.minimum(hand.effort / bus.model.torque_nm_per_a, strongest)
        self._current_limit = self.cfg.current_share * torque_current
        self._velocity_limit = self.cfg.velocity_share * hand.velocity_limit
        self.limited = 0
        """Goals that were limited."""
        self.missed = 0
        """Deadlines missed, in all."""
        self.repeated = 0
        """Readings without a sound answer, for which the last state stood in."""
        self.report: StopReport | None = None
        """How the stop went, once there was one."""
        self._state: JointState | None = None
        self._goal: np.ndarray | None = None
        self._strained_since = np.full(len(joints.ids), np.inf)
        self._misses = 0
        self._beat_s = self._image_s = np.inf
        self._signal = ""
        self._armed = False
        self._on = np.ones(len(joints.ids), dtype=bool)
        self._stopping = threading.RLock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="safety", daemon=True)
        self._handlers: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "SafeHand":
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._on_signal) for number in SIGNALS}
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        try:
            if self._armed:
                self._hold(FINISHED if error is None else f"{kind.__name__ if kind else ''}: {error}")
                self._off()
        finally:
            self._end.set()
            self._thread.join()
            for number, handler in self._handlers.items():
                signal.signal(number, handler)

    def arm(self) -> JointState:
        """Switch the torque on where the hand is, and start the watchdogs.

        Raises:
            StoppedError: A motor does not switch on.
        """
        with self._stopping:
            try:
                self._state = state = self._read()
                self._goal = state.position
                self._armed = True  # from here on whatever happens ends with torque off
                self.bus.watch(self.cfg.watchdog_s)
                self.bus.write_goals(self.joints.to_motor(state.position))
                failed = self.bus.torque(True)
            except BusError as error:
                raise self._stop(f"could not switch on: {error}", lost=True) from error
            if failed:
                raise self._stop(f"could not switch on: {next(iter(failed.values()))}")
            self._beat_s = time.monotonic()
            return state

    def read(self) -> JointState:
        """Read the joints; for a short gap in the bus the last state once more, with its own time.

        Raises:
            StoppedError: The bus is lost, a limit was passed, a motor reports an error, or another stop.
        """
        self._check()
        try:
            state = self._read()
        except BusError as error:
            last = self._state
            if last is None or time.monotonic() - last.time_s > self.cfg.lost_s:
                raise self._stop(f"lost the bus: {error}", lost=True) from error
            self.repeated += 1
            self._check()
            return last
        self._state = state
        self._check()
        return state

    def command(self, target: np.ndarray) -> np.ndarray:
        """Send goals within the limits.

        Args:
            target: Wanted angles of the joints [rad], shape [D].

        Returns:
            The goals that were sent [rad], shape [D].

        Raises:
            StoppedError: The hand is stopped, the target is no number, or the bus is lost.
        """
        self._check()
        target = np.asarray(target, dtype=float)
        if self._state is None or not self._armed:
            raise RuntimeError("arm() has to come before command()")
        if target.shape != self.lower.shape or not np.isfinite(target).all():
            raise self._stop(f"the target is not {len(self.lower)} finite angles: {target}")
        here = self._state.position
        near = np.clip(target, here - self.cfg.step_rad, here + self.cfg.step_rad)
        goal = np.clip(near, self.lower, self.upper)
        self.limited += int((goal != target).any())
        with self._stopping:  # never after the hold
            self._check()
            try:
                self.bus.write_goals(self.joints.to_motor(goal))
            except BusError as error:
                raise self._stop(f"lost the bus: {error}", lost=True) from error
            self._goal = goal
        return goal

    def switch(self, on: np.ndarray) -> None:
        """Switch the torque of joints on or off; one that is switched on stays where it is.

        Args:
            on: Shape [D] bool.

        Raises:
            StoppedError: A motor does not switch.
        """
        self.command(self.read().position)
        for axis in np.flatnonzero(on != self._on):
            failed = self.bus.torque(bool(on[axis]), [self.joints.ids[axis]])
            if failed:
                raise self._stop(next(iter(failed.values())))
        self._on = np.array(on, dtype=bool)

    def beat(self, *, missed: bool = False) -> None:
        """A control step has ended: its goal is sent.

        Args:
            missed: Whether it ended after its deadline.

        Raises:
            StoppedError: Too many in a row.
        """
        self._check()
        self._beat_s = time.monotonic()
        self.missed += missed
        self._misses = self._misses + 1 if missed else 0
        if self._misses >= self.cfg.misses:
            raise self._stop(f"{self._misses} deadlines missed in a row")

    def image_at(self, time_s: float) -> None:
        """The newest image is of this time [s], by the monotonic clock."""
        self._image_s = time_s

    def stop(self, reason: str) -> None:
        """Stop for a reason of the caller's.

        Raises:
            StoppedError: Always.
        """
        raise self._stop(reason)

    def _read(self) -> JointState:
        raw = self.bus.read_state()
        state = JointState.of(raw, self.joints)
        if raw.alert.any():
            raise self._stop(self._errors(raw))
        self._compare(state)
        return state

    def _errors(self, raw: BusState) -> str:
        """What the motors with an alert report."""
        try:
            errors = self.bus.hardware_errors()
        except BusError:
            errors = {}
        alerted = [id for id, alert in zip(self.bus.ids, raw.alert, strict=True) if alert]
        return "; ".join(f"motor {id}: {errors.get(id, 'a hardware error')}" for id in alerted)

    def _compare(self, state: JointState) -> None:
        """Stop if a limit was passed."""
        fast = np.abs(state.velocity) > self._velocity_limit
        hot = state.temperature > self.cfg.temperature_c
        strained = np.abs(state.current) > self._current_limit
        self._strained_since = np.where(strained, np.minimum(self._strained_since, state.time_s), np.inf)
        long = state.time_s - self._strained_since > self.cfg.current_s
        for axis, id in enumerate(self.joints.ids):
            name = f"{self.joints.names[axis]}, motor {id}"
            if fast[axis]:
                raise self._stop(
                    f"{name}: {state.velocity[axis]:.1f} rad/s, over {self._velocity_limit[axis]:.1f}"
                )
            if hot[axis]:
                raise self._stop(
                    f"{name}: {state.temperature[axis]:.0f} deg C, over {self.cfg.temperature_c:g}"
                )
            if long[axis]:
                raise self._stop(
                    f"{name}: {state.current[axis]:.2f} A for {self.cfg.current_s:g} s; is it blocked?"
                )

    def _check(self) -> None:
        if self.report is not None:
            raise StoppedError(self.report.reason)
        due = self._due()
        if due:
            raise self._stop(due)

    def _due(self) -> str:
        """Why the hand has to stop now, whatever its motors say; empty if it has not."""
        now = time.monotonic()
        silent, age = now - self._beat_s, now - self._image_s
        if self._signal:
            return self._signal
        if silent > self.cfg.misses * PERIOD_S:
            return f"the loop stands: no step ended for {silent:.2f} s"
        if age > self.cfg.stale_s:
            return f"the newest image is {age:.2f} s old"
        return ""

    def _stop(self, reason: str, *, lost: bool = False) -> StoppedError:
        """Hold, and give what to raise.

        Args:
            reason: Why.
            lost: Whether the bus is not to be relied on.
        """
        self._hold(reason, lost=lost)
        assert self.report is not None
        return StoppedError(self.report.reason)

    def _hold(self, reason: str, *, lost: bool = False) -> None:
        """Have every joint stay where it is, once; what fails is told, not raised."""
        detected = time.monotonic()
        with self._stopping:
            if self.report is not None:
                return
            self.report = StopReport(reason, detected)
            if not self._armed:
                return
            where = self._expected() if lost else self._where()
            if where is not None:
                self._hold_at(where)

    def _where(self) -> np.ndarray | None:
        """Where the joints are now [rad]; asks once."""
        try:
            return JointState.of(self.bus.read_state(retries=0), self.joints).position
        except BusError:
            return self._expected()

    def _expected(self) -> np.ndarray | None:
        """Where the joints should be by now [rad], on their way to the last goals; asks nobody.

        A hand with one lost motor cannot be asked in the time that the others have.
        """
        if self._state is None or self._goal is None:
            return None
        lag = self.hand.kd / self.hand.kp
        to_go = np.exp(-(time.monotonic() - self._state.time_s) / lag)
        return self._goal + (self._state.position - self._goal) * to_go

    def _hold_at(self, where: np.ndarray) -> None:
        """Send angles of the joints [rad] as goals, whatever else is going on."""
        assert self.report is not None
        try:
            self.bus.write_goals(self.joints.to_motor(np.clip(where, self.lower, self.upper)))
        except BusError as error:
            self._say(f"could not be told to hold: {error}")
        else:
            self.report = replace(self.report, held_s=self.report.held_s or time.monotonic())

    def _off(self) -> None:
        """Settle where the hand came to rest, then torque off as configured."""
        assert self.report is not None
        with contextlib.suppress(BusError):
            self._hold_at(JointState.of(self.bus.read_state(), self.joints).position)
        why = "" if self.report.reason == FINISHED else f"stopped: {self.report.reason}; "
        if self.cfg.then == "hold":
            self._say(f"{why}the hand holds, its torque is on")
            return
        end = time.monotonic() + self.cfg.hold_s
        self._signal = ""
        while time.monotonic() < end and not self._signal:  # a signal: at once
            time.sleep(WATCH_S)
        left = self._release()
        self.report = replace(self.report, unreleased=left)
        self._say(f"{why}torque off")
        for id, why in left.items():
            self._say(f"motor {id} may still be on, cut its power: {why}")

    def _release(self) -> dict[int, str]:
        """Switch all motors off; those of which that is not known, with the reason."""
        end = time.monotonic() + OFF_S
        left: dict[int, str] = dict.fromkeys(self.bus.ids, "")
        while True:
            try:
                self.bus.release()  # one packet for all; each is asked afterwards
            except BusError as error:
                return dict.fromkeys(left, str(error))
            left = self.bus.torque(False, left)
            if not left:
                with contextlib.suppress(BusError):
                    self.bus.watch(0.0)  # what it guarded is off; other programs would find it in their way
            if not left or time.monotonic() > end:
                return left

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        """Note a signal; the watchdog acts on it. A second one is not caught any more."""
        self._signal = SIGNALS[signal.Signals(number)]
        if self.report is not None:
            signal.signal(number, signal.default_int_handler)

    def _watch(self) -> None:
        """Stop the hand when the loop does not."""
        while not self._end.wait(WATCH_S):
            if not self._armed or self.report is not None:
                continue
            due = self._due()
            if due:
                self._hold(due)
