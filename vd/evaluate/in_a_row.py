"""Goal after goal, each drawn once the last is reached.

Consecutive successes, and goals in the air.

Consecutive successes begin with start and goal of other evaluations. The paper's in-air test is
mostly won before the table goes. Here a policy has the table for 2 s, as there, and 1 s to hold the
object without it, and only then come the goals that count. What comes after a stop is simulated
apart, as in :mod:`vd.evaluate.trace`. K objects, M episodes; quaternions xyzw.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.evaluate.goals import AIR_GOALS, CONSECUTIVE, GoalSeries
from vd.evaluate.result import Agent, Consecutive, InAir, Protocol, Row, StoppedBy, row_of
from vd.evaluate.rollout import draw_goals, unit_quats
from vd.evaluate.statistics import (
    Unit,
    choose_unit,
    rate_intervals,
    rotation_angle,
    share_among,
    symmetric_error,
)
from vd.evaluate.trace import (
    Way,
    act_in,
    advance,
    air_table_steps,
    copy_motion,
    drawn_rounds,
    episodes_of,
    motion_of,
    out_of_hand,
)

ANY_ACTION = 100.0
"""Bound that no norm of an action exceeds: others who count consecutive successes ask for none."""


@dataclass(frozen=True)
class SeriesTrace:
    """What became of the episodes.

    Attributes:
        start_quat: Orientation of the object when the first goal was given; at the reset if it was
            lost before [K, M, 4].
        goal_quat: The first goal [K, M, 4].
        end_quat: Orientation at its stop, or at the end [K, M, 4].
        steps: Steps from there to there [K, M].
        stopped: Whether the policy was stopped, at the first goal or not, bool [K, M].
        held: Whether the object was still there when the first goal was given, bool [K, M].
        reached: Goals reached, one after the other, int [K, M].
        lost: Whether the object was lost, bool [K, M].
        failed: Whether the physics failed, which ends an episode, bool [K, M].
        let_go: Of objects with which the first goal was reached, whether they were lost while they
            were held: 0 or 1; NaN for the others [K, M].
    """

    start_quat: np.ndarray
    goal_quat: np.ndarray
    end_quat: np.ndarray
    steps: np.ndarray
    stopped: np.ndarray
    held: np.ndarray
    reached: np.ndarray
    lost: np.ndarray
    failed: np.ndarray
    let_go: np.ndarray

    def of(self, objects: Sequence[int]) -> "SeriesTrace":
        """The episodes of some objects."""
        return SeriesTrace(**{name: value[list(objects)] for name, value in vars(self).items()})


def draw_turns(
    names: Sequence[str], episodes: int, most: int, *, seed: int, max_goal_angle: float
) -> np.ndarray:
    """Rotations from where objects are to their goals [K, M, most, 4], by name, seed and episode."""
    turns = []
    for name in names:
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), most])
        at = np.tile([0.0, 0.0, 0.0, 1.0], (episodes * most, 1))
        turns.append(draw_goals(at, rng, max_goal_angle).reshape(episodes, most, 4))
    return np.stack(turns)


def record_series(
    env: Any,
    policy: Any,
    turns: np.ndarray,
    way: Way,
    series: GoalSeries,
    *,
    tolerance: float,
    starts: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    on_step: Callable[[], object] = lambda: None,
) -> SeriesTrace:
    """Run a policy and write down what becomes of its objects.

    Others as of :func:`vd.evaluate.trace.record`.

    It gets the first goal, and the next after each stop by ``way`` within ``tolerance`` [rad] of
    the true one, by ``turns`` of :func:`draw_turns`; ``goals`` are those of the start.
    """
    shape = turns.shape[:2]
    trace = SeriesTrace(
        start_quat=np.zeros((*shape, 4)),
        goal_quat=np.zeros((*shape, 4)),
        end_quat=np.zeros((*shape, 4)),
        steps=np.zeros(shape, dtype=int),
        stopped=np.zeros(shape, dtype=bool),
        held=np.zeros(shape, dtype=bool),
        reached=np.zeros(shape, dtype=int),
        lost=np.zeros(shape, dtype=bool),
        failed=np.zeros(shape, dtype=bool),
        let_go=np.full(shape, np.nan),
    )
    for numbers, state in drawn_rounds(env, shape[1], starts, goals):
        if series.first_s:
            env.sim.place_table(present=True)
        env.load_state_dict(state)
        _Round(env, trace, numbers, way, series, tolerance).run(policy, turns, on_step)
    if series.first_s:
        env.sim.place_table(present=True)
    return trace


def way_of(agent: Agent, series: GoalSeries, tolerance: float) -> tuple[StoppedBy, Way]:
    """How a policy is stopped within a tolerance [rad]: its own way.

    Consecutively, whatever its action.
    """
    stopped_by, (rule, by) = agent.own_way(tolerance)
    return stopped_by, (rule if series.first_s else replace(rule, action_norm=ANY_ACTION), by)


def judge_series(
    trace: SeriesTrace,
    protocol: Protocol,
    objects: list[Any],
    agent: Agent,
    *,
    group: str,
    condition: str = "",
) -> list[Row]:
    """The row of one policy from its episodes with the objects of one group, judged by their first goals."""
    stopped_by, (rule, _) = way_of(
        agent, AIR_GOALS if protocol.air_goals else CONSECUTIVE, protocol.stop_tolerance_rad
    )
    unit = choose_unit(len(objects))
    exact = rotation_angle(trace.end_quat, trace.goal_quat)
    pairs = zip(trace.end_quat, trace.goal_quat, objects, strict=True)
    error = np.stack([symmetric_error(end, goal, item.symmetry) for end, goal, item in pairs])
    episodes = episodes_of(
        start_quat=trace.start_quat,
        goal_quat=trace.goal_quat,
        start_error_rad=rotation_angle(trace.start_quat, trace.goal_quat),
        error_rad=error,
        exact_error_rad=exact,
        steps=trace.steps,
        stopped=trace.stopped,
        fell=trace.lost & ~trace.stopped,
    )
    near = trace.stopped & (error <= protocol.stop_tolerance_rad)
    row = row_of(
        episodes,
        protocol,
        objects,
        agent,
        trace.failed,
        group=group,
        condition=condition,
        stopped_by=stopped_by,
        rule=rule,
        symmetric=rate_intervals(near[None], unit)[0],
        in_air=_in_air(trace, unit) if protocol.air_goals else None,
        consecutive=() if protocol.air_goals else _consecutive(trace, objects),
    )
    return [row]


def _in_air(trace: SeriesTrace, unit: Unit) -> InAir:
    first = trace.reached > 0
    held, in_a_row = rate_intervals(np.stack([trace.held, trace.reached == AIR_GOALS.most]), unit)
    return InAir(
        held=held,
        first=share_among(first, trace.held),
        in_a_row=in_a_row,
        lost=share_among(trace.lost, trace.held),
        let_go=share_among(trace.let_go, first),
    )


def _consecutive(trace: SeriesTrace, objects: list[Any]) -> tuple[Consecutive, ...]:
    """Of all objects, and of each."""
    found = []
    parts = {"all": slice(None)} | {item.name: slice(k, k + 1) for k, item in enumerate(objects)}
    for name, part in parts.items():
        reached, full = trace.reached[part], trace.reached[part] == CONSECUTIVE.most
        found.append(
            Consecutive(
                name,
                mean=float(reached.mean()),
                median=float(np.median(reached)),
                goals=float(reached.sum() / (reached.sum() + (~full).sum())),
                lost=float((trace.lost[part] & ~full).mean()),
                full=float(full.mean()),
            )
        )
    return tuple(found)


class _Round:
    """One episode in every environment that has one.

    ``numbers`` [N], place among its object's, else -1.
    """

    def __init__(
        self,
        env: Any,
        trace: SeriesTrace,
        numbers: np.ndarray,
        way: Way,
        series: GoalSeries,
        tolerance: float,
    ) -> None:
        self._env, self._trace, self._way, self._tolerance = env, trace, way, tolerance
        self._series = series
        self._place = np.asarray(env.world_object), np.maximum(numbers, 0)
        self._envs = self._all = np.flatnonzero(numbers >= 0)
        # Steps since the present goal was given; -1: none that counts yet.
        self._age = np.full(env.num_envs, -1 if series.first_s else 0)
        self._kept = motion_of(env, copy=True)
        quat = unit_quats(env.object_pose()[self._all, 3:7])
        for array in (trace.start_quat, trace.goal_quat, trace.end_quat):
            array[self._of(self._all)] = quat
        if not series.first_s:
            trace.held[self._of(self._all)] = True
            trace.goal_quat[self._of(self._all)] = unit_quats(env.goal_quat.numpy()[self._all])

    def run(self, policy: Any, turns: np.ndarray, on_step: Callable[[], object]) -> None:
        """Go to the ends, then hold what reached its first goal."""
        env, trace, series = self._env, self._trace, self._series
        hz = env.cfg.sim.control_hz
        first, most = round(series.first_s * hz), round(series.goal_s * hz)
        for step in range(first + series.most * most):
            if first and step == air_table_steps(hz):
                env.sim.place_table(present=False)
            due = self._act(policy)
            on_step()
            self._age[self._age >= 0] += 1
            trace.lost[self._of(self._envs[env.fell.numpy()[self._envs] != 0])] = True
            trace.failed[self._of(self._envs)] = env.sim.failed.numpy()[self._envs] != 0
            self._go_on((env.done.numpy() == 0) & (trace.reached[self._place] < series.most))
            if step == first - 1:
                due = self._envs
                trace.held[self._of(due)] = True
            due = np.intersect1d(due, self._envs)
            if len(due):
                turn = Rotation.from_quat(turns[(*self._of(due), trace.reached[self._of(due)])])
                goal = turn * Rotation.from_quat(env.object_pose()[due, 3:7])
                env.give_goals(due, goal.as_quat())
                self._age[due] = 0
                if step == first - 1:
                    trace.start_quat[self._of(due)] = unit_quats(env.object_pose()[due, 3:7])
                    trace.goal_quat[self._of(due)] = goal.as_quat()
            self._go_on(self._age < most)
            if not len(self._envs):
                break
        if series.hold_s:
            self._hold()

    def _of(self, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Object and number of the episodes of environments."""
        return self._place[0][envs], self._place[1][envs]

    def _go_on(self, where: np.ndarray) -> None:
        """End the episodes that do not go on, ``where`` being [N]."""
        self._envs = self._envs[where[self._envs]]

    def _act(self, policy: Any) -> np.ndarray:
        """One control step; the environments whose goal was reached before it."""
        env, (rule, by) = self._env, self._way
        smoothed = wp.to_torch(env.smoothed)
        norm = smoothed.norm(dim=-1).cpu().numpy()
        quat = unit_quats(env.object_pose()[:, 3:7])
        true = rotation_angle(quat, unit_quats(env.goal_quat.numpy()))
        action = act_in(env, policy, self._envs)
        seen = policy.predicted.cpu().numpy() if by == "predicted" else true
        stops = rule.stops(seen, norm) & (self._age > 0)
        trace = self._trace
        first = self._envs[
            (self._age >= 0)[self._envs] & (trace.reached[self._of(self._envs)] == 0)
        ]
        trace.end_quat[self._of(first)], trace.steps[self._of(first)] = (
            quat[first],
            self._age[first],
        )
        trace.stopped[self._of(first)] = stops[first]
        self._go_on(~stops | (true <= self._tolerance))
        reached = self._envs[stops[self._envs]]
        trace.reached[self._of(reached)] += 1
        copy_motion(self._kept, motion_of(env), reached[trace.reached[self._of(reached)] == 1])
        advance(env, action)
        return reached

    def _hold(self) -> None:
        """Go on from where the first goals were reached, with the last targets."""
        env = self._env
        live = motion_of(env)
        copy_motion(live, self._kept, np.arange(env.num_envs))
        held = self._all[self._trace.reached[self._of(self._all)] > 0]
        lost = np.zeros(env.num_envs, dtype=bool)
        for _ in range(round(self._series.hold_s * env.cfg.sim.control_hz)):
            env.hold()
            away = out_of_hand(env)
            lost |= away
            copy_motion(
                live, self._kept, np.flatnonzero(away)
            )  # or it would fall for half a minute
        self._trace.let_go[self._of(held)] = lost[held]
