"""The control loop: from senses to goals, 12 Hz on a monotonic clock, its lateness measured.

One step is :meth:`ControlLoop.step`: wait, sense, decide, filter, send, log.
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vd.deploy.camera.camera import ImageSource
from vd.deploy.camera.check_camera import SightWatch
from vd.deploy.clock import Pacer
from vd.deploy.hardware.answers import HandState
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.log import NOWHERE, LogWriter
from vd.deploy.loop.policy_runner import PolicyDecision, PolicyRunner, Sensed
from vd.deploy.pose.follower import PoseFollower
from vd.deploy.safety.safety import SafeHand
from vd.evaluate.statistics import symmetric_error
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.deploy.twin.twin import Twin

CAMERA_SHARE = 0.5
"""Share of a control period for which an image is waited for."""
LOOK_S = 10.0
"""Longest first look for an object, which takes 0.3 s where nothing else runs."""
STATUS_STEPS = 60
"""Control steps between two status lines: five seconds."""
NO_SYMMETRY = np.array([[0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class StepTimes:
    """Times of one control step [s], from when it was due."""

    late_s: float
    """When it began."""
    image_s: float
    """When its image was exposed, negative if before; NaN without a camera."""
    sensed_s: float
    """When the joints were read."""
    sent_s: float
    """When its goals were sent."""
    cpu_s: float
    """Processor time of this process."""


class ControlLoop:
    """Pursues goals, one after the other.

    Acts until the policy says it has arrived, holds, and goes on.

    Args:
        safe: The hand, armed, at its start.
        episode_s: Time for each goal [s].
        hold_s: How long the hand holds still after each stop [s], before it goes on.
        camera: Depth camera; None: the policy needs none.
        twin: Knows the object's true state; None on a real hand.
        follower: Knows it from outside; None: nobody tells poses.
        more: Whether more goals may come than there are; the hand is held until then.
        symmetry: Rotations that map the object to itself [K, 4], for the true error.
    """

    def __init__(
        self,
        safe: SafeHand,
        runner: PolicyRunner,
        actions: ActionFilter,
        pacer: Pacer,
        log: LogWriter,
        *,
        episode_s: float = PAPER.scene.episode_s,
        hold_s: float = 1.0,
        camera: ImageSource | None = None,
        twin: "Twin | None" = None,
        follower: PoseFollower | None = None,
        symmetry: np.ndarray = NO_SYMMETRY,
        more: Callable[[], bool] = lambda: False,
    ):
        self._safe = safe
        self._runner = runner
        self._actions = actions
        self._pacer = pacer
        self._log = log
        self._episode_s = episode_s
        self._hold_s = hold_s
        self._camera = camera
        self._twin = twin
        self._follower = follower
        self._symmetry = symmetry
        self._sight: SightWatch | None = None
        if runner.camera is not None:
            self._sight = SightWatch(runner.camera, safe.hand.goal_in_base)
        self._more = more
        self._target = safe.hand.start
        self.times: list[StepTimes] = []
        """Of every step so far."""

    def run(self, goals: Sequence[np.ndarray]) -> list[str]:
        """Pursue all goals [4], those too that are added meanwhile; the outcome of each.

        Raises:
            StoppedError: The hand was stopped.
            StaleCamera: There is no new image.
        """
        outcomes = []
        waited = True
        while not len(goals) and self._more():
            self.step(0, NO_SYMMETRY[0], acting=False)
        for number, goal in enumerate(goals):
            if waited:
                self._look(number, goal)
            outcome, distance = self._pursue(number, goal)
            outcomes.append(outcome)
            self._log.event("stop", goal=number, outcome=outcome, distance=distance)
            if outcome == "lost":
                break
            for _ in range(round(self._hold_s / self._pacer.period_s)):
                self.step(number, goal, acting=False)
            waited = False
            while len(goals) == number + 1 and self._more():
                self.step(number, goal, acting=False)
                waited = True
        return outcomes

    def _look(self, number: int, goal: np.ndarray) -> None:
        """Find the object anew, which takes longer than to follow it, and than a step may."""
        self._runner.begin()
        sensed, *_ = self._sense(goal)
        clock = self._pacer.clock
        decided = clock.beside(lambda: self._runner.decide(sensed))
        end = clock.now() + LOOK_S
        while not decided():
            if clock.now() > end:
                raise self._safe.stop(f"the policy has not decided for {LOOK_S:g} s")
            self.step(number, goal, acting=False)

    def _pursue(self, number: int, goal: np.ndarray) -> tuple[str, float | None]:
        """Act until one goal is reached or given up.

        Outcome, and the distance that was known then [rad].
        """
        self._runner.new_goal()
        self._actions.reset()
        self._log.goal(number, goal)
        distance = np.nan
        outcome = "time limit"
        for step in range(round(self._episode_s / self._pacer.period_s)):
            ended, distance = self.step(number, goal, first=step == 0)
            if ended:
                outcome = ended
                break
        return outcome, None if np.isnan(distance) else distance

    def step(
        self, number: int, goal: np.ndarray, *, acting: bool = True, first: bool = False
    ) -> tuple[str, float]:
        """One control step.

        Args:
            number: Of the goal.
            goal: Wanted orientation [4].
            acting: Whether the policy acts; else the hand holds still.
            first: Whether it is the first of its goal: before an action there is nothing to stop.

        Returns:
            What ends the pursuit, if anything does, and the distance to the goal [rad], NaN for
            none.
        """
        late_s = self._pacer.wait()
        busy_s = time.process_time()
        due_s = self._pacer.due_s
        sensed, state, image_s = self._sense(goal)
        decision = PolicyDecision(np.zeros_like(sensed.smoothed), np.nan)
        ended = ""
        if acting:
            decision = self._runner.decide(sensed)
            ended = self._ended(decision, sensed, first=first)
            if ended:
                decision = replace(decision, action=np.zeros_like(decision.action))
            else:
                self._target = self._actions.goal(decision.action, state.position)
        sent = self._safe.command(self._target)
        sent_s = self._pacer.clock.now() - due_s
        self._safe.beat(missed=self._pacer.end())
        busy_s = time.process_time() - busy_s
        times = StepTimes(late_s, image_s - due_s, state.time_s - due_s, sent_s, busy_s)
        self._note(number, sensed, state, decision, sent, acting, times)
        return ended, decision.distance

    def _sense(self, goal: np.ndarray) -> tuple[Sensed, HandState, float]:
        """Read the camera, then the joints, then what is told from outside.

        What the policy is told, all that was measured, the image's or pose's time.

        Raises:
            StoppedError: The hand was stopped.
            StaleCamera: There is no new image.
        """
        depth = None
        image_s = np.nan
        if self._camera is not None:
            frame = self._camera.read(CAMERA_SHARE * self._pacer.period_s)
            depth = frame.image
            image_s = frame.time_s
        truth = None if self._twin is None else self._twin.object_state()
        state = self._safe.read()
        if depth is not None:
            fault = "" if self._sight is None else self._sight.fault(depth, state.position)
            self._safe.image_at(image_s, fault)
        object_state = truth
        if self._follower is not None:
            followed = self._follower.look()
            object_state = followed.state
            image_s = followed.time_s
            self._safe.pose_at(followed.time_s, followed.fault)
        joints = state.position, state.velocity, self._actions.smoothed
        return Sensed(*joints, goal, depth, truth, object_state), state, image_s

    def _ended(self, decision: PolicyDecision, sensed: Sensed, *, first: bool) -> str:
        """``stopped``, ``lost``, or nothing."""
        sight = self._sight
        voxels = decision.voxels
        if sight is not None and voxels is not None and sight.loses(voxels):
            return "lost"
        rule = self._runner.rule
        distance = np.array(decision.distance)
        if rule.stops(distance, np.array(np.linalg.norm(sensed.smoothed))) and not first:
            return "stopped"
        workspace = self._safe.hand.workspace
        for known in (sensed.truth, sensed.object_state):
            if known is None:
                continue
            if np.linalg.norm(known[:3] - np.array(workspace.goal_m)) > workspace.fall_m:
                return "lost"
        return ""

    def _note(
        self,
        number: int,
        sensed: Sensed,
        state: HandState,
        decision: PolicyDecision,
        sent: np.ndarray,
        acting: bool,
        times: StepTimes,
    ) -> None:
        """Log the step, keep its times, and now and then say how it goes."""
        truth: list[float] = []
        if sensed.truth is not None:
            true = sensed.truth[:7].astype(float)
            error = symmetric_error(true[None, 3:], sensed.goal_quat[None], self._symmetry)
            truth = [*true.tolist(), float(error[0])]
        joints = {
            "command": sent,
            "position": state.position,
            "velocity": state.velocity,
            "current": state.current,
            "temperature": state.temperature,
            "action": decision.action,
            "smoothed": sensed.smoothed,
        }
        values = [number, acting, decision.distance, *vars(times).values(), self._pacer.missed]
        pose = decision.found
        if self._follower is not None and sensed.object_state is not None:
            pose = sensed.object_state[:7]
        found_pose = NOWHERE if pose is None else pose.tolist()
        sent_s = self._pacer.due_s + times.sent_s
        self._log.step(state.time_s, sent_s, joints, values, truth, found_pose)
        self.times.append(times)
        if len(self.times) % STATUS_STEPS == 0:
            doing = "holding"
            if acting and np.isnan(decision.distance):
                doing = "acting"
            elif acting:
                doing = f"distance {decision.distance:.2f} rad"
            if truth:
                doing += f", true {truth[-1]:.2f}"
            parts = [
                f"goal {number + 1}",
                doing,
                f"loop {1e3 * times.sent_s:.0f} ms",
                f"missed {self._pacer.missed}",
            ]
            if np.isfinite(state.temperature).all():
                parts.append(f"{state.temperature.max():.0f} deg C")
                parts.append(f"{np.abs(state.current).max():.2f} A")
            print(" | ".join(parts), file=sys.stderr, flush=True)


def summary(times: Sequence[StepTimes]) -> dict[str, dict[str, float]]:
    """Median, 99th percentile and most of each time [ms], and of the two latencies of training.

    ``observation_latency_ms`` is how old the image is when the joints are read,
    ``command_delay_ms`` how much later goals are sent (``randomisation.observation_latency_s``;
    ``command_delay.delay_s`` has the motors' own delay besides). What no step has is left out.
    """
    values = {
        name: np.array([getattr(step, name) for step in times])
        for name in StepTimes.__annotations__
    }
    values["observation_latency_s"] = values["sensed_s"] - values["image_s"]
    values["command_delay_s"] = values["sent_s"] - values["sensed_s"]
    table = {}
    for name, seconds in values.items():
        ms = 1e3 * seconds[np.isfinite(seconds)]
        if len(ms):
            figures = {"median": np.median(ms), "p99": np.percentile(ms, 99), "max": ms.max()}
            table[name.replace("_s", "_ms")] = {
                key: round(float(value), 3) for key, value in figures.items()
            }
    return table
