"""Limits and a watchdog between whatever decides on goals and the motors.

They hold whatever it decides.

    with SafeHand(bus, joints, cfg) as safe:  # preflight has passed, the person has confirmed
        safe.arm()                            # torque on where the hand is; watchdogs run
        while not done:
            state = safe.read()               # joints' frame [rad]; checked
            goal = safe.command(target)       # limited, sent; what was sent
            safe.image_at(time_s)             # of the newest image, where there is a camera
            safe.beat(missed=late)            # once per control step, after its work

Whatever ends the block, the hand is brought to a hold where it is, and then, as configured, its
torque is switched off. A limit that is passed, a lost bus, a stale image, missed deadlines or a
signal raise :class:`StoppedError` with the reason at the next call; a thread has stopped the hand
by then, and switches it off and says so also if no call ever comes. No signal cuts that off. Where
the driver itself dies, the motors' bus watchdog stops them.

Angles and speeds are the joints', rad and rad/s; times of the monotonic clock.
"""

import contextlib
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vd.deploy.clock import from_future
from vd.deploy.finding import listed
from vd.deploy.hardware.answers import BusError, HandState, LateError, SilentError
from vd.deploy.hardware.joints import JointMotors
from vd.deploy.hardware.motors import Motors
from vd.deploy.safety.limits import PERIOD_S, Limits, SafetyCfg, out_of_range
from vd.deploy.safety.signals import REASONS, Signals
from vd.logs.log_format import FINISHED

MOVE_S = 0.04
"""Time between the goals of a slow movement."""
SETTLE_STEPS = 10
"""Steps at its end."""
WATCH_S = 0.01
"""How often the watchdog looks."""
TORQUE_S = PERIOD_S / 3.0
"""Age of what is known of the motors' torque from which it is asked for again, in a packet of its
own, since its register lies far from the state's: with each reading of a control loop, each third
of a recording.
"""
DEFAULTS = SafetyCfg()
TORQUE_GONE = "another program on the line switched it off, or it restarted"
TRIPPED = (
    "its bus watchdog stopped it, and it refuses goals: check its cable, and that watchdog_s is "
    "longer than the line may be silent"
)
OFF_S = 1.0
"""How long switching off is tried on a bus that does not answer soundly."""
SOFT_STEPS = 10
"""Steps of MOVE_S in which the motors come to their gain when they are switched on."""
SAY_S = 1.0
"""Longest wait for a terminal that takes no words, as after Ctrl-S."""
END_S = 1.0
"""Time that a program has to come to its end once its hand is off, if a signal asked for that."""
AHEAD_REMEDY = {
    "image": "then plug the camera in again",
    "pose": "and stamp a pose when its image is exposed",
}
"""What to do about images and poses from the future, beside the clocks."""
BLIND = {"image": "the camera is blind", "pose": "no pose is believed"}
"""How it is said that nothing new is known."""
LEFT_ON = "it holds, as --safety.then says"
"""Why the torque of each motor is on where the hand is left holding."""


class StoppedError(RuntimeError):
    """The hand was stopped.

    The message says why, ``signal`` which one asked for it, 0 for another reason.
    """

    def __init__(self, reason: str, number: int = 0):
        super().__init__(reason)
        self.signal = number


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
    signal: int = 0
    """Number of the signal that asked for it; 0 for another reason."""

    def __str__(self) -> str:
        """What is told of it: the reason, and each motor that may be on."""
        why = "" if self.reason == FINISHED else f"stopped: {self.reason}; "
        if LEFT_ON in self.unreleased.values():
            return f"{why}the hand holds, its torque is on"
        if not self.unreleased:
            return f"{why}torque off"
        motors = [
            f"motor {id} may still be on, cut its power: {reason}"
            for id, reason in self.unreleased.items()
        ]
        return "\n".join([f"{why}not every torque is off", *motors])


def unheard(error: BusError) -> str:
    """Why no state came: by this computer's fault, or the bus'."""
    return f"heard no motor: {error}" if isinstance(error, LateError) else f"lost the bus: {error}"


class SafeHand:
    """A hand whose goals are limited and that stops by itself.

    Once it is stopped, each method raises :class:`StoppedError` with the reason. Its bus has to be
    configured; ``say`` tells the person, and ``ended`` takes the report once the stop is complete,
    in whichever thread that happens.
    """

    def __init__(
        self,
        bus: Motors,
        joints: JointMotors,
        cfg: SafetyCfg = DEFAULTS,
        say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
        ended: Callable[[StopReport], None] = lambda report: None,
    ):
        """Nothing is sent before :meth:`arm`."""
        self.bus = bus
        self.joints = joints
        self.hand = joints.hand
        self.cfg = cfg
        self._say = say
        self._ended = ended
        self._names = [
            f"{name}, motor {id}" for name, id in zip(joints.names, joints.ids, strict=True)
        ]
        self.limits = Limits(joints, self._names, self.cfg)
        self.report: StopReport | None = None
        """How the stop went, once there was one."""
        self._state: HandState | None = None
        self._goal: np.ndarray | None = None
        self._misses = 0
        self._beat_s = self._image_s = np.inf
        self._image_fault = ""
        self._watched = "image"  # or pose: what _image_s is of
        self._torque_s = -np.inf
        self._armed = False
        self._on = np.zeros(len(joints.ids), dtype=bool)
        self._stopping = threading.RLock()
        self._ending = threading.RLock()
        self._off_s = np.inf  # when the stop was complete
        self._ends = False  # whether someone brings it to its end
        self._back = False  # whether the program has come to the end of the block
        self._unwatch: Callable[[], None] = lambda: None
        self._signals = Signals()

    def __enter__(self) -> "SafeHand":
        self._signals.__enter__()
        self._unwatch = self.bus.clock.every(WATCH_S, self._watch)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: object
    ) -> None:
        self._back = True
        try:
            if self._armed:
                why = FINISHED if error is None else f"{kind.__name__ if kind else ''}: {error}"
                try:
                    self._hold(why)
                finally:
                    self._off()
        finally:
            self._unwatch()
            self._signals.__exit__()

    def arm(self) -> HandState:
        """Switch the torque on where the hand is, softly, and start the watchdogs.

        Raises:
            StoppedError: A joint is out of its range, whatever the preflight found before somebody
                said yes; or the motors could not be switched on.
        """
        try:
            self._within(self._read())
            self._armed = True  # from here on whatever happens ends with torque off
            self.bus.watch(self.cfg.watchdog_s)
            self._state = state = self._within(self._read())
            goals = self.joints.to_motor(self.limits.goal(state.position, state.position))
            self.bus.write_goals(goals)
            self.bus.stiffen(1.0 / SOFT_STEPS)
            self._switch(True, self.joints.ids)
            self._on[:] = True
            for step in range(2, SOFT_STEPS + 1):
                self.bus.clock.sleep(MOVE_S)
                self.read()
                self.bus.write_goals(goals)  # a motor may forget them when it is switched on
                self.bus.stiffen(step / SOFT_STEPS)
        except BusError as error:
            raise self.stop(f"could not switch on: {error}", lost=True) from error
        self._beat_s = self.bus.clock.now()
        return state

    def _within(self, state: HandState) -> HandState:
        """A state whose joints are in their ranges: the motors' limits would have others jump."""
        if wrong := out_of_range(self.hand, state.position):
            raise self.stop(f"nothing moves: {listed(wrong)}")
        return state

    def _switch(self, on: bool, ids: Sequence[int]) -> None:
        """Switch the torque of motors, but not on again after a hold."""
        with self._stopping:
            self._check()
            failed = self.bus.torque(on, ids)
        if failed:
            raise self.stop(
                f"could not switch {'on' if on else 'off'}: {listed(list(failed.values()))}"
            )

    def read(self) -> HandState:
        """Read the joints.

        For a short gap in the bus the last state once more, with its own time.
        """
        self._check()
        try:
            state = self._read()
        except BusError as error:
            last = self._state
            if last is None or self.bus.clock.now() - last.time_s > self.cfg.lost_s:
                raise self.stop(unheard(error), lost=True) from error
            self._check()
            return last
        self._state = state
        self._check()
        return state

    def command(self, target: np.ndarray, *, with_state: bool = False) -> np.ndarray:
        """Send goals within the limits.

        Args:
            target: Wanted angles of the joints [rad], shape [D].
            with_state: Send them with the question of the next :meth:`read`.

        Returns:
            The goals that were sent [rad], shape [D].
        """
        self._check()
        target = np.asarray(target, dtype=float)
        if self._state is None or not self._armed:
            raise RuntimeError("arm() has to come before command()")
        if target.shape != self.limits.lower.shape or not np.isfinite(target).all():
            raise self.stop(f"the target is not {len(self.joints.ids)} finite angles: {target}")
        self._goal = goal = self.limits.goal(target, self._state.position)
        with self._stopping:  # never after the hold
            self._check()
            try:
                self.bus.write_goals(self.joints.to_motor(goal), with_state=with_state)
            except BusError as error:
                raise self.stop(unheard(error), lost=True) from error
        return goal

    def move(self, goal: np.ndarray, speed: float) -> None:
        """Move slowly in a straight line of joint angles, and wait for the hand to follow.

        Args:
            goal: Angles of the joints [rad], shape [D].
            speed: Of the joint that has farthest to go [rad/s].
        """
        start = self.read().position
        steps = max(1, math.ceil(float(np.abs(goal - start).max()) / (speed * MOVE_S)))
        clock = self.bus.clock
        begin = clock.now()
        for step in range(1, steps + SETTLE_STEPS + 1):
            target = start + (goal - start) * min(1.0, step / steps)
            self.command(target)
            clock.sleep(begin + step * MOVE_S - clock.now())
            self.read()
            self.beat()

    def switch(self, on: np.ndarray) -> None:
        """Switch the torque of joints on or off; one that is switched on stays where it is.

        Args:
            on: Shape [D] bool.
        """
        self.command(self.read().position)
        for axis in np.flatnonzero(on != self._on):
            self._switch(bool(on[axis]), [self.joints.ids[axis]])
        self._on = np.array(on, dtype=bool)

    def beat(self, *, missed: bool = False) -> None:
        """A control step has ended: its goal is sent.

        Args:
            missed: Whether it ended after its deadline.
        """
        self._check()
        self._beat_s = self.bus.clock.now()
        self._misses = self._misses + 1 if missed else 0
        if self._misses >= self.cfg.misses:
            raise self.stop(f"{self._misses} deadlines missed in a row")

    def image_at(self, time_s: float, fault: str = "") -> None:
        """The newest image is of this time [s], by the monotonic clock.

        Args:
            time_s: When it was exposed [s].
            fault: Why it shows nothing; then the one before it grows older.

        Raises:
            StoppedError: It is from the future, so its age is not known.
        """
        self._seen_at("image", time_s, fault)

    def pose_at(self, time_s: float, fault: str = "") -> None:
        """The newest pose of the object is of this time [s], in place of :meth:`image_at`.

        Args:
            time_s: When its image was exposed [s].
            fault: Why it is not believed; then the one before it grows older.

        Raises:
            StoppedError: It is from the future, so its age is not known.
        """
        self._seen_at("pose", time_s, fault)

    def _seen_at(self, what: str, time_s: float, fault: str) -> None:
        """The newest image or pose is of this time [s]."""
        if ahead := from_future(time_s, self.bus.clock.now()):
            raise self.stop(f"the newest {what} is {ahead}, {AHEAD_REMEDY[what]}")
        self._watched = what
        self._image_fault = fault
        if not fault or self._image_s == np.inf:
            self._image_s = time_s

    def _read(self) -> HandState:
        try:
            raw = self.bus.read_state()
        except (LateError, SilentError):
            raise  # they would not be heard either
        except BusError:
            self._check_torque()  # a motor that restarted answers, but no state of it is accepted
            raise
        state = self.joints.state(raw)
        if raw.alert.any():
            raise self.stop(self._errors(raw.alert, "a hardware error"))
        self._check_torque()
        away = np.zeros(len(state.position))
        if self._goal is not None:
            away = np.where(self._on, self._goal - state.position, 0.0)
        if passed := self.limits.passed(state, away):
            raise self.stop(passed)
        return state

    def _check_torque(self) -> None:
        """Stop where a motor that was switched on is so no more, or refuses goals.

        Every TORQUE_S once the hand is armed.
        """
        now = self.bus.clock.now()
        if not self._armed or now - self._torque_s < TORQUE_S:
            return
        gone = self._on & ~self.bus.read_torque()
        self._torque_s = now
        if gone.any():
            raise self.stop(f"torque went off: {self._errors(gone, TORQUE_GONE)}")
        if (tripped := self.bus.read_tripped()).any():
            raise self.stop(
                listed([f"{self._names[a]}: {TRIPPED}" for a in np.flatnonzero(tripped)])
            )

    def _errors(self, which: np.ndarray, otherwise: str) -> str:
        """What some motors [D] bool report as their errors, and otherwise what is said of them."""
        try:
            errors = self.bus.hardware_errors()
        except BusError:
            errors = {}
        axes = np.flatnonzero(which)
        return listed([f"{self._names[a]}: {errors.get(self.bus.ids[a], otherwise)}" for a in axes])

    def _check(self) -> None:
        if self.report is not None:
            raise self._error()
        due = self._due()
        if due:
            raise self.stop(due)

    def _due(self) -> str:
        """Why the hand has to stop now, whatever its motors say; empty if it has not."""
        now = self.bus.clock.now()
        silent = now - self._beat_s
        age = now - self._image_s
        if came := self._signals.came():
            return REASONS[signal.Signals(came[0])]
        if silent > self.cfg.misses * PERIOD_S:
            return f"the loop stands: no step ended for {silent:.2f} s"
        oldest = self.cfg.pose_stale_s if self._watched == "pose" else self.cfg.stale_s
        if age > oldest:
            if self._image_fault:
                return f"{BLIND[self._watched]} for {age:.2f} s: {self._image_fault}"
            return f"the newest {self._watched} is {age:.2f} s old"
        return ""

    def stop(self, reason: str, *, lost: bool = False) -> StoppedError:
        """Hold, without the states of a bus that is ``lost``, and give what to raise."""
        self._hold(reason, lost=lost)
        return self._error()

    def _error(self) -> StoppedError:
        """What to raise once the hand is stopped."""
        assert self.report is not None
        return StoppedError(self.report.reason, self.report.signal)

    def _hold(self, reason: str, *, lost: bool = False) -> None:
        """Have every joint stay where it is, once; what fails is told, not raised."""
        detected = self.bus.clock.now()
        with self._stopping:
            if self.report is not None:
                return
            asked = self._signals.came()[:1]
            self.report = StopReport(reason, detected, signal=asked[0] if asked else 0)
            if not self._armed:
                return
            try:
                if not lost:
                    self._hold_at(self.joints.state(self.bus.read_state(retries=0)).position)
            except BusError:
                lost = True
            if lost:  # nobody tells where the joints are, but the motors know
                self._tell(self.bus.freeze)

    def _hold_at(self, where: np.ndarray) -> None:
        """Send angles of the joints [rad] as goals, whatever else is going on."""
        goals = self.joints.to_motor(self.limits.goal(where, where))
        self._tell(lambda: self.bus.write_goals(goals))

    def _tell(self, send: Callable[[], None]) -> None:
        """Tell the motors to hold, and note when.

        A line that takes nothing is told of at the end.
        """
        assert self.report is not None
        with contextlib.suppress(BusError):
            send()
            self.report = replace(self.report, held_s=self.report.held_s or self.bus.clock.now())

    def _off(self) -> None:
        """Settle where the hand came to rest, then torque off as configured.

        The first caller does it.
        """
        with self._ending:
            if self._ends:
                return
            self._ends = True
            assert self.report is not None
            try:
                with contextlib.suppress(BusError):
                    self._hold_at(self.joints.state(self.bus.read_state()).position)
                while self.cfg.then == "off" and not self._held_long():
                    self.bus.clock.sleep(WATCH_S)
            finally:
                left = dict.fromkeys(self.bus.ids, LEFT_ON)
                if self.cfg.then == "off":
                    left = self._release()
                self.report = replace(self.report, unreleased=left)
                self._inform(str(self.report))
                self._off_s = self.bus.clock.now()
                self._ended(self.report)

    def _held_long(self) -> bool:
        """Whether the torque is to go off now: after its time, or as a further signal asks."""
        assert self.report is not None
        further = len(self._signals.came()) > bool(self.report.signal)
        held_s = self.bus.clock.now() - self.report.detected_s
        return further or held_s >= self.cfg.hold_s

    def _inform(self, text: str) -> None:
        """Tell the person; a terminal that is stopped or gone does not keep the hand on."""
        end = self.bus.clock.now() + SAY_S
        with contextlib.suppress(OSError, ValueError):
            said = self.bus.clock.beside(lambda: self._say(text))
            while not said() and self.bus.clock.now() < end:
                self.bus.clock.sleep(WATCH_S)

    def _release(self) -> dict[int, str]:
        """Switch all motors off; those of which that is not known, with the reason."""
        end = self.bus.clock.now() + OFF_S
        left: dict[int, str] = dict.fromkeys(self.bus.ids, "")
        while True:
            try:
                self.bus.release()  # one packet for all; each is asked afterwards
            except BusError as error:
                return dict.fromkeys(left, str(error))
            left = self.bus.torque(False, list(left))
            if not left:
                # What the watchdogs guarded is off, and they are in other programs' way.
                with contextlib.suppress(BusError):
                    self.bus.watch(0.0)
            if not left or self.bus.clock.now() > end:
                return left

    def _watch(self) -> None:
        """Stop the hand when the loop does not, and bring to its end what the loop does not."""
        if not self._armed or self._back:
            return
        if self.report is None:
            if due := self._due():
                self._hold(due)
                self._inform(f"stopping: {due}; the hand holds")
            return
        if not self._ends and self._held_long():
            with contextlib.suppress(OSError):  # of the log, whose end is not for this thread
                self._off()
        came = self._signals.came()
        if came and self.bus.clock.now() > self._off_s + END_S:
            self._inform("the program does not come to its end, and is ended")
            os._exit(128 + came[0])
