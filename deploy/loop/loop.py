"""The control loop: one process, 12 Hz on a monotonic clock, from senses to goals, its lateness measured."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vd.deploy.camera.camera import DepthSource
from vd.deploy.clock import Pacer
from vd.deploy.hardware.answers import HandState
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.log import LogWriter
from vd.deploy.loop.observation import Sensed
from vd.deploy.loop.pilot import Pilot
from vd.deploy.safety.safety import SafeHand
from vd.deploy.twin.twin_link import TwinState
from vd.evaluate.statistics import symmetric_error
from vd.paper import PAPER

CAMERA_SHARE = 0.5
"""Share of a control period for which an image is waited for."""
STATUS_STEPS = 3
"""Control steps between two refreshes of the status line: four a second."""


class Truth(Protocol):
    """Somebody who knows the object's pose: a twin."""

    def state(self) -> TwinState:
        """The true state."""


@dataclass(frozen=True)
class LoopCfg:
    """How goals are pursued."""

    episode_s: float = PAPER.scene.episode_s
    """Time for each goal [s]."""
    hold_s: float = 1.0
    """How long the hand holds still after each stop [s], before it goes on."""
    images: bool = False
    """Keep the depth images in the log."""
    fall_m: float = PAPER.success.fall_m
    """Distance from the place of the goal at which the object counts as lost [m], where its pose is known."""


@dataclass(frozen=True)
class StepTimes:
    """Times of one control step [s], from when it was due."""

    late_s: float
    """When it began."""
    sensed_s: float
    """When the joints were read."""
    sent_s: float
    """When its goals were sent."""
    cpu_s: float
    """Processor time of this process."""


@dataclass(frozen=True)
class Moment:
    """What was known and done in one control step; D joints."""

    number: int
    """Number of the goal."""
    goal: np.ndarray
    """Wanted orientation [4]."""
    acting: bool
    """Whether the policy acts; else the hand holds still."""
    state: HandState
    """As measured."""
    object_pose: np.ndarray | None
    """The object's true pose [7]: a twin's only."""
    smoothed: np.ndarray
    """Moving average of the actions before [D]."""
    action: np.ndarray
    """The policy's action; zero where it does not act [D]."""
    sent: np.ndarray
    """Joint goals that were sent [rad] [D]."""
    distance: float | None
    """By which the policy is stopped [rad]; None where there is none."""


class ControlLoop:
    """Pursues goals, one after the other: acts until the policy says it has arrived, holds, and goes on.

    Args:
        safe: The hand, behind its limits, armed.
        pilot: The policy.
        actions: From its actions to joint goals.
        pacer: The grid of control steps.
        log: Takes every step.
        cfg: Times.
        camera: Depth camera; None: the policy needs none.
        truth: A twin; None on a real hand.
        symmetry: Rotations that map the object to itself [K, 4], for the true error.
        status: Shows the status line.
    """

    def __init__(
        self,
        safe: SafeHand,
        pilot: Pilot,
        actions: ActionFilter,
        pacer: Pacer,
        log: LogWriter,
        cfg: LoopCfg,
        *,
        camera: DepthSource | None = None,
        truth: Truth | None = None,
        symmetry: np.ndarray | None = None,
        status: Callable[[str], None] = lambda line: None,
    ):
        self._safe, self._pilot, self._actions, self._pacer, self._log = safe, pilot, actions, pacer, log
        self._cfg, self._camera, self._truth, self._status = cfg, camera, truth, status
        self._symmetry = np.array([[0.0, 0.0, 0.0, 1.0]]) if symmetry is None else symmetry
        self._target = safe.read().position
        self.times: list[StepTimes] = []

    def run(self, goals: Sequence[np.ndarray]) -> list[str]:
        """Pursue all goals [4]; the outcome of each.

        Raises:
            SafeStop: The hand was stopped.
            StaleCamera: There is no new image.
        """
        outcomes = []
        self._pilot.begin()
        if len(goals):
            self._look(np.asarray(goals[0], dtype=float))
        for number, goal in enumerate(goals):
            outcome, distance = self._pursue(number, np.asarray(goal, dtype=float))
            outcomes.append(outcome)
            self._log.event("stop", goal=number, outcome=outcome, distance=distance)
            if outcome == "lost":
                break
            for _ in range(round(self._cfg.hold_s / self._pacer.period_s)):
                self._step(number, goal, acting=False)
        return outcomes

    def _look(self, goal: np.ndarray) -> None:
        """See the object before the first deadline: to find it takes longer than to follow it."""
        self._safe.beat(missed=False)
        sensed, _ = self._sense(goal)
        self._pilot.decide(sensed)
        self._safe.beat(missed=False)

    def _pursue(self, number: int, goal: np.ndarray) -> tuple[str, float | None]:
        """Act until one goal is reached or given up: outcome, and the distance that was known then [rad]."""
        self._pilot.new_goal()
        self._actions.reset()
        self._log.event("goal", goal=number)
        distance: float | None = None
        for step in range(round(self._cfg.episode_s / self._pacer.period_s)):
            outcome, distance = self._step(number, goal, acting=True, first=step == 0)
            if outcome:
                return outcome, distance
        return "time limit", distance

    def _step(
        self, number: int, goal: np.ndarray, *, acting: bool, first: bool = False
    ) -> tuple[str, float | None]:
        """One control step; what ends the pursuit, if anything, and the distance [rad]."""
        late, busy = self._pacer.wait(), time.process_time()
        due = self._pacer.due_s
        sensed, state = self._sense(goal)
        smoothed, outcome = self._actions.smoothed, ""
        distance: float | None = None
        action = np.zeros_like(smoothed)
        if acting:
            decision = self._pilot.decide(sensed)
            distance = None if np.isnan(decision.distance) else decision.distance
            outcome = self._outcome(decision.distance, sensed, first=first)
            if not outcome:
                action = decision.action
                self._target = self._actions.goal(action, state.position)
        sent = self._safe.command(self._target)
        end = self._pacer.clock.now() - due
        missed = self._pacer.end()
        self._safe.beat(missed=missed)
        if sensed.depth is not None and self._cfg.images:
            self._log.image(len(self.times), sensed.depth)
        times = StepTimes(late, state.time_s - due, end, time.process_time() - busy)
        moment = Moment(number, goal, acting, state, sensed.object_pose, smoothed, action, sent, distance)
        self._note(moment, times)
        return outcome, distance

    def _sense(self, goal: np.ndarray) -> tuple[Sensed, HandState]:
        """Read the camera, then the joints: what the policy is told, and all that was measured.

        Raises:
            SafeStop: The hand was stopped.
            StaleCamera: There is no new image.
        """
        depth = None
        if self._camera is not None:
            image = self._camera.read(CAMERA_SHARE * self._pacer.period_s)
            self._safe.image_at(image.time_s)
            depth = image.depth_m
        known = self._truth.state() if self._truth is not None else None
        state = self._safe.read()
        sensed = Sensed(
            joint_q=state.position,
            joint_qd=state.velocity,
            smoothed=self._actions.smoothed,
            goal_quat=goal,
            depth=depth,
            object_pose=None if known is None else known.object_pose,
            object_velocity=None if known is None else known.object_velocity,
        )
        return sensed, state

    def _outcome(self, distance: float, sensed: Sensed, *, first: bool) -> str:
        """``stopped``, ``lost``, or nothing."""
        rule = self._pilot.rule
        near = distance < rule.distance_rad and float(np.linalg.norm(sensed.smoothed)) < rule.action_norm
        if near and not first:  # before the first action there is nothing to stop
            return "stopped"
        if sensed.object_pose is not None:
            away = np.linalg.norm(sensed.object_pose[:3] - np.array(PAPER.scene.goal_position_m))
            if away > self._cfg.fall_m:
                return "lost"
        return ""

    def _note(self, moment: Moment, times: StepTimes) -> None:
        """Log the step, keep its times, and refresh the status line."""
        truth: list[float] = []
        if moment.object_pose is not None:
            pose = moment.object_pose.astype(float)
            error = symmetric_error(pose[None, 3:], moment.goal[None], self._symmetry)
            truth = [*(float(value) for value in pose), float(error[0])]
        state, missed = moment.state, self._pacer.missed
        joints = {
            "command": moment.sent,
            "position": state.position,
            "velocity": state.velocity,
            "current": state.current,
            "temperature": state.temperature,
            "action": moment.action,
            "smoothed": moment.smoothed,
        }
        distance = np.nan if moment.distance is None else moment.distance
        values = [moment.number, moment.acting, distance, *vars(times).values(), missed]
        self._log.step(state.time_s, self._pacer.due_s + times.sent_s, joints, values, truth)
        self.times.append(times)
        if len(self.times) % STATUS_STEPS == 0:
            self._status(status_line(moment, times, missed, truth))


def status_line(moment: Moment, times: StepTimes, missed: int, truth: Sequence[float]) -> str:
    """Goal, distance, loop time, misses, temperature and current in one line."""
    parts = [
        f"goal {moment.number + 1}{'' if moment.acting else ', holding'}",
        "distance -" if moment.distance is None else f"distance {moment.distance:.2f} rad",
        *([f"true {truth[-1]:.2f}"] if truth else []),
        f"loop {1e3 * times.sent_s:.0f} ms",
        f"missed {missed}",
        f"{moment.state.temperature.max():.0f} deg C",
        f"{np.abs(moment.state.current).max():.2f} A",
    ]
    return " | ".join(parts)


def summary(times: Sequence[StepTimes]) -> dict[str, dict[str, float]]:
    """Median, 99th percentile and most of each of the times [ms]."""
    columns = {
        name: 1e3 * np.array([getattr(one, name) for one in times]) for name in vars(StepTimes(0, 0, 0, 0))
    }
    return {
        name.replace("_s", "_ms"): {
            "median": round(float(np.median(values)), 3),
            "p99": round(float(np.percentile(values, 99)), 3),
            "max": round(float(values.max()), 3),
        }
        for name, values in columns.items()
        if len(values)
    }
