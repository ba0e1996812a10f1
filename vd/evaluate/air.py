"""In the air, goal after goal: the table goes, and only then come the goals that count.

The paper's in-air test is mostly won before the table goes. Here a policy has the table for 2 s, as there,
and 1 s to hold the object without it. Then it gets goals, each drawn once the last is reached. What comes
after a stop is simulated apart, as in :mod:`vd.evaluate.trace`. K objects, M episodes; quaternions xyzw.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.evaluate.goals import AIR_HOLD_S, ALONE_S, GOAL_S, IN_A_ROW
from vd.evaluate.result import Agent, InAir, Protocol, Row, row_of
from vd.evaluate.rollout import draw_goals, unit_quats
from vd.evaluate.statistics import choose_unit, rate_intervals, rotation_angle, share_among, symmetric_error
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


@dataclass(frozen=True)
class AirTrace:
    """What became of the episodes.

    Attributes:
        start_quat: Orientation of the object when the first goal was drawn; at the reset if it was lost
            before [K, M, 4].
        goal_quat: The first goal [K, M, 4].
        end_quat: Orientation at its stop, or at the end [K, M, 4].
        steps: Steps from there to there [K, M].
        stopped: Whether the policy was stopped, at the first goal or not, bool [K, M].
        held: Whether the object was still there when the first goal was drawn, bool [K, M].
        reached: Goals reached, one after the other, int [K, M].
        lost: Whether the object was lost, bool [K, M].
        let_go: Of objects with which the first goal was reached, whether they were lost within AIR_HOLD_S of
            holding: 0 or 1; NaN for the others [K, M].
    """

    start_quat: np.ndarray
    goal_quat: np.ndarray
    end_quat: np.ndarray
    steps: np.ndarray
    stopped: np.ndarray
    held: np.ndarray
    reached: np.ndarray
    lost: np.ndarray
    let_go: np.ndarray

    def of(self, objects: Sequence[int]) -> "AirTrace":
        """The episodes of some objects."""
        return AirTrace(**{name: value[list(objects)] for name, value in vars(self).items()})


def air_turns(names: Sequence[str], episodes: int, *, seed: int, max_goal_angle: float) -> np.ndarray:
    """Rotations from where objects are to their goals [K, M, IN_A_ROW, 4], by name, seed and episode."""
    turns = []
    for name in names:
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), IN_A_ROW])
        at = np.tile([0.0, 0.0, 0.0, 1.0], (episodes * IN_A_ROW, 1))
        turns.append(draw_goals(at, rng, max_goal_angle).reshape(episodes, IN_A_ROW, 4))
    return np.stack(turns)


def record_in_air(
    env: Any,
    policy: Any,
    turns: np.ndarray,
    way: Way,
    *,
    tolerance: float,
    starts: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    on_step: Callable[[], object] = lambda: None,
) -> AirTrace:
    """Run a policy and write down what becomes of its objects; others as of :func:`vd.evaluate.trace.record`.

    It gets the first goal, and the next after each stop by ``way`` within ``tolerance`` [rad] of the true
    one, by ``turns`` of :func:`air_turns`; ``goals`` are those while the table is there.
    """
    shape = turns.shape[:2]
    trace = AirTrace(
        start_quat=np.zeros((*shape, 4)),
        goal_quat=np.zeros((*shape, 4)),
        end_quat=np.zeros((*shape, 4)),
        steps=np.zeros(shape, dtype=int),
        stopped=np.zeros(shape, dtype=bool),
        held=np.zeros(shape, dtype=bool),
        reached=np.zeros(shape, dtype=int),
        lost=np.zeros(shape, dtype=bool),
        let_go=np.full(shape, np.nan),
    )
    for numbers, state in drawn_rounds(env, shape[1], starts, goals):
        env.sim.place_table(present=True)
        env.load_state_dict(state)
        _Flight(env, trace, numbers, way, tolerance).run(policy, turns, on_step)
    env.sim.place_table(present=True)
    return trace


def judge_in_air(
    trace: AirTrace, protocol: Protocol, objects: list[Any], agent: Agent, *, group: str, condition: str = ""
) -> list[Row]:
    """The row of one policy, stopped in its own way, from its episodes with the objects of one group."""
    stopped_by, (rule, _) = agent.own_way(protocol.stop_tolerance_rad)
    unit, first = choose_unit(len(objects)), trace.reached > 0
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
    held, symmetric, in_a_row = rate_intervals(np.stack([trace.held, near, trace.reached == IN_A_ROW]), unit)
    row = row_of(
        episodes,
        protocol,
        objects,
        agent,
        group=group,
        condition=condition,
        stopped_by=stopped_by,
        rule=rule,
        symmetric=symmetric,
        in_air=InAir(
            held=held,
            first=share_among(first, trace.held),
            in_a_row=in_a_row,
            lost=share_among(trace.lost, trace.held),
            let_go=share_among(trace.let_go, first),
        ),
    )
    return [row]


class _Flight:
    """One episode in every environment that has one: ``numbers`` [N], place among its object's, else -1."""

    def __init__(self, env: Any, trace: AirTrace, numbers: np.ndarray, way: Way, tolerance: float) -> None:
        self._env, self._trace, self._way, self._tolerance = env, trace, way, tolerance
        self._place = np.asarray(env.world_object), np.maximum(numbers, 0)
        self._envs = self._all = np.flatnonzero(numbers >= 0)
        # Steps since the present goal was given; -1: none of the air yet.
        self._age = np.full(env.num_envs, -1)
        self._kept = motion_of(env, copy=True)
        quat = unit_quats(env.object_pose()[self._all, 3:7])
        for array in (trace.start_quat, trace.goal_quat, trace.end_quat):
            array[self._of(self._all)] = quat

    def run(self, policy: Any, turns: np.ndarray, on_step: Callable[[], object]) -> None:
        """Go to the ends, then hold what reached its first goal."""
        env, trace = self._env, self._trace
        hz = env.cfg.sim.control_hz
        table, most = air_table_steps(hz), round(GOAL_S * hz)
        first = table + round(ALONE_S * hz)
        for step in range(first + IN_A_ROW * most):
            if step == table:
                env.sim.place_table(present=False)
            due = self._act(policy)
            on_step()
            self._age[self._age >= 0] += 1
            trace.lost[self._of(self._envs[env.fell.numpy()[self._envs] != 0])] = True
            self._go_on((env.done.numpy() == 0) & (trace.reached[self._place] < IN_A_ROW))
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
        first = self._envs[(self._age >= 0)[self._envs] & (trace.reached[self._of(self._envs)] == 0)]
        trace.end_quat[self._of(first)], trace.steps[self._of(first)] = quat[first], self._age[first]
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
        for _ in range(round(AIR_HOLD_S * env.cfg.sim.control_hz)):
            env.hold()
            away = out_of_hand(env)
            lost |= away
            copy_motion(live, self._kept, np.flatnonzero(away))  # or it would fall for half a minute
        self._trace.let_go[self._of(held)] = lost[held]
